"""Assess: how good the estimates of missing starts are, measured on whole tracks that are cut on purpose."""

from collections.abc import Iterator

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage
from tracklake.pipeline.transforms.starts.assessment import assess_starts, keep_beginnings
from tracklake.schemas import START_ASSESSMENTS, START_CUTOFFS, VEHICLE_STARTS, Table


def build(reader: SubsetReader, settings: Settings) -> dict[Table, pl.DataFrame]:
    """Cut the fully tracked vehicles' tracks and compare the estimates with what was cut off."""

    def read_tracks() -> Iterator[pl.DataFrame]:
        return reader.read_whole_tracks(settings, "vehicle_id", "frame", "x_m", "lane", "speed_mps")

    starts, cutoff_m = reader.table(VEHICLE_STARTS), reader.table(START_CUTOFFS)["cutoff_m"][0]
    if reader.is_long(settings):
        tracks, totals = keep_beginnings(read_tracks, starts, cutoff_m=cutoff_m)
    else:
        (tracks,), totals = read_tracks(), None
    assessed = assess_starts(tracks, starts, cutoff_m=cutoff_m, totals=totals, **reader.partition, **reader.clock)
    return {START_ASSESSMENTS: assessed}


STAGE = Stage(
    name="assess",
    meaning="Measure the estimates on tracks cut on purpose.",
    scope="freeway recording",
    after=(INGEST, "repair"),
    version=2,
    build=build,
)
