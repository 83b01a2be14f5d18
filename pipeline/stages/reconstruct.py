"""Reconstruct: physically possible tracks near the recorded ones, how far they moved, and what could not be kept."""

from collections.abc import Iterator
from dataclasses import replace

import polars as pl

from tracklake.pipeline.lake.scratch import open_scratch
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageResult
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.reconstruction import (
    Reconstruction,
    reconstruct,
    reconstruct_shares,
)
from tracklake.schemas import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    TRACKS,
    UNKEPT_BOUNDS,
    VEHICLES,
)
from tracklake.schemas.extras import require_extras

TRACK_COLUMNS = ("vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "leader_id")
VEHICLE_COLUMNS = ("vehicle_id", "class", "length_m", "width_m")
"""Columns of `vehicles` that are read; those above are of `tracks`."""


SHARE = 4
"""A share of a long subset has a fourth of the entries that a worker holds: each takes about 800 bytes."""


def build(reader: SubsetReader, settings: Settings) -> Iterator[StageResult]:
    """Reconstruct the tracks of a subset; the entries of a long one are written some vehicles at a time."""
    require_extras("`tracklake reconstruct`", "reconstruct")
    config = ReconstructionConfig(
        noise_x_m=settings.reconstruct_noise_m,
        noise_y_m=settings.reconstruct_lateral_noise_m,
        max_gap_s=settings.reconstruct_max_gap_s,
    )
    vehicles = reader.table(VEHICLES, *VEHICLE_COLUMNS)
    if not reader.is_long(settings):
        made = reconstruct(reader.table(TRACKS, *TRACK_COLUMNS), vehicles, reader.facts, config)
        yield _gather(made)
        return
    at_once = max(1, settings.slice_entries // SHARE)
    with open_scratch(reader.root) as make_store:
        shares = reconstruct_shares(
            lambda: reader.read_whole_tracks(settings, *TRACK_COLUMNS, share=SHARE),
            vehicles,
            reader.facts,
            config,
            make_store,
            at_once,
        )
        for made in shares:
            yield replace(_gather(made), part=_name_share(made.entries))


def _name_share(entries: pl.DataFrame) -> str:
    """Return the name of a share's files; nothing for what is of the whole subset.

    The first and the last vehicle tell what is in a share, whose number does not: how many entries it has is a setting
    on which the fingerprint does not depend. Names in order are shares in order of vehicles.
    """
    if entries.is_empty():
        return ""
    first, last = entries.select(first=pl.col("vehicle_id").min(), last=pl.col("vehicle_id").max()).row(0)
    return f"{first:010d}-{last:010d}"


def _gather(made: Reconstruction) -> StageResult:
    return StageResult(
        {
            RECONSTRUCTED: made.entries,
            RECONSTRUCTION_QUALITY: made.quality,
            RECONSTRUCTION_SKIPS: made.skips,
            UNKEPT_BOUNDS: made.unkept,
        }
    )


STAGE = Stage(
    name=RECONSTRUCTION,
    meaning="Reconstruct physically possible tracks near the recorded ones, and check them against the rules.",
    scope="recording",
    after=(INGEST,),
    settings=("reconstruct_noise_m", "reconstruct_lateral_noise_m", "reconstruct_max_gap_s"),
    version=5,
    build=build,
)
