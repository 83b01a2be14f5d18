"""Revalidate: findings and scores of the reconstructed tracks, by the rules that check the recorded ones."""

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage
from tracklake.pipeline.stages.validate import describe_rules, judge_tracks
from tracklake.schemas import RECONSTRUCTED_FINDINGS, RECONSTRUCTED_SUBSET_SCORES, Table
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS

UNCHANGED = frozenset({"headway_recorded_m", "length_range_m", "heading_error_rad", "double_track_s"})
"""Columns that say nothing about reconstructed positions; rules that read them are not checked again. A vehicle with
two tracks keeps both: that the bounds of platoons move these apart does not mend it."""


def build(reader: SubsetReader, settings: Settings) -> dict[Table, pl.DataFrame]:
    """Find what breaks rules in a subset's reconstructed tracks; tracks that were left out are as recorded."""
    _, judged = judge_tracks(reader, settings, RECONSTRUCTED_TRACKS, UNCHANGED)
    return {RECONSTRUCTED_FINDINGS: judged.findings, RECONSTRUCTED_SUBSET_SCORES: judged.subset_scores}


STAGE = Stage(
    name="revalidate",
    meaning="Check the reconstructed tracks against the rules.",
    scope="recording",
    after=(INGEST, RECONSTRUCTION),
    settings=(describe_rules,),
    version=3,
    build=build,
    command=RECONSTRUCTION,
)
