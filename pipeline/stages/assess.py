"""Assess: how good the estimates of missing starts are, measured on whole tracks that are cut on purpose."""

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage
from tracklake.pipeline.transforms.starts.assessment import assess_starts
from tracklake.schemas import START_ASSESSMENTS, START_CUTOFFS, TRACKS, VEHICLE_STARTS, Table


def build(reader: SubsetReader, _settings: Settings) -> dict[Table, pl.DataFrame]:
    """Cut the fully tracked vehicles' tracks and compare the estimates with what was cut off."""
    assessed = assess_starts(
        reader.table(TRACKS, "vehicle_id", "frame", "x_m", "lane", "speed_mps"),
        reader.table(VEHICLE_STARTS),
        cutoff_m=reader.table(START_CUTOFFS)["cutoff_m"][0],
        **reader.partition,
        **reader.clock,
    )
    return {START_ASSESSMENTS: assessed}


STAGE = Stage(
    name="assess",
    meaning="Measure the estimates on tracks cut on purpose.",
    scope="freeway recording",
    after=(INGEST, "repair"),
    version=2,
    build=build,
)
