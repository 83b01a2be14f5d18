"""Repair: where tracks should begin, which begin late, and the frames that are missing of those."""

from collections.abc import Iterator

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage
from tracklake.pipeline.transforms.starts.late_starts import classify_starts, estimate_missing_starts
from tracklake.schemas import MISSING_STARTS, START_CUTOFFS, VEHICLE_STARTS, VEHICLES, Table


def build(reader: SubsetReader, settings: Settings) -> dict[Table, pl.DataFrame]:
    """Judge every vehicle's start and estimate what is missing of the late ones."""
    on_ramps = settings.on_ramp_lanes.get(reader.facts["site"], reader.facts["on_ramp_lanes"])
    known = {**reader.partition, **reader.clock}
    starts, cutoffs = classify_starts(reader.table(VEHICLES), on_ramp_lanes=tuple(on_ramps), **known)

    def read_tracks() -> Iterator[pl.DataFrame]:
        return reader.read_whole_tracks(settings, "vehicle_id", "frame", "x_m", "lane", "speed_mps")

    missing = estimate_missing_starts(read_tracks, starts, cutoff_m=cutoffs["cutoff_m"][0], **known)
    return {VEHICLE_STARTS: starts, START_CUTOFFS: cutoffs, MISSING_STARTS: missing}


STAGE = Stage(
    name="repair",
    meaning="Find late starts and estimate what is missing of them.",
    scope="freeway recording",
    after=(INGEST,),
    settings=("on_ramp_lanes",),
    version=2,
    build=build,
)
