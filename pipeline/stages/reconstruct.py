"""Reconstruct: physically possible tracks near the recorded ones, how far they moved, and what could not be kept."""

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.reconstruction import reconstruct
from tracklake.schemas import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    TRACKS,
    UNKEPT_BOUNDS,
    VEHICLES,
    Table,
)
from tracklake.schemas.extras import require_extras

TRACK_COLUMNS = ("vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "leader_id")
VEHICLE_COLUMNS = ("vehicle_id", "class", "length_m", "width_m")
"""Columns of `vehicles` that are read; those above are of `tracks`."""


def build(reader: SubsetReader, settings: Settings) -> dict[Table, pl.DataFrame]:
    """Reconstruct the tracks of a subset."""
    require_extras("`tracklake reconstruct`", "reconstruct")
    config = ReconstructionConfig(
        noise_x_m=settings.reconstruct_noise_m,
        noise_y_m=settings.reconstruct_lateral_noise_m,
        max_gap_s=settings.reconstruct_max_gap_s,
    )
    made = reconstruct(
        reader.table(TRACKS, *TRACK_COLUMNS), reader.table(VEHICLES, *VEHICLE_COLUMNS), reader.facts, config
    )
    return {
        RECONSTRUCTED: made.entries,
        RECONSTRUCTION_QUALITY: made.quality,
        RECONSTRUCTION_SKIPS: made.skips,
        UNKEPT_BOUNDS: made.unkept,
    }


STAGE = Stage(
    name=RECONSTRUCTION,
    meaning="Reconstruct physically possible tracks near the recorded ones, and check them against the rules.",
    scope="recording",
    after=(INGEST,),
    settings=("reconstruct_noise_m", "reconstruct_lateral_noise_m", "reconstruct_max_gap_s"),
    version=5,
    bytes_per_entry=800,
    build=build,
)
