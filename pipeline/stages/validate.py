"""Validate: findings of every rule, scores, and which subsets are excluded."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.quality_reports.rules.evaluate import Judgement, judge, judge_slices, tracks_needed
from tracklake.quality_reports.rules.findings import judge_subset
from tracklake.quality_reports.rules.registry import RULES, resolve, select_thresholds
from tracklake.quality_reports.rules.scene import SUBSET_COLUMNS, VEHICLE_COLUMNS, Scene, Whole, find_lacking
from tracklake.quality_reports.rules.surveys import survey
from tracklake.schemas import FINDINGS, SUBSET_SCORES, SUBSET_STATUS, SUBSETS, VEHICLE_SCORES, VEHICLES
from tracklake.schemas.protocols import RECORDED, TracksFrom

LONGEST_WINDOW_S = 2.0
"""Time before and after an entry on which rules depend, in s, besides the stay of `lane_flicker`: reversals of jerk
look back 1.1 s."""
SHARE = 2
"""A slice has half of the entries that a worker holds at once: rules take about 700 bytes for each."""


def describe_rules(settings: Settings) -> dict[str, Any]:
    """Return the rules over tracks and their thresholds, on which findings depend."""
    return {"rules": [rule.name for rule in RULES], "thresholds": resolve(RULES, _select(settings))}


def _select(settings: Settings) -> dict[str, float]:
    """Select the set thresholds that rules over tracks have."""
    return select_thresholds(RULES, settings.thresholds)


def open_scene(reader: SubsetReader, tracks: pl.DataFrame) -> tuple[Scene, frozenset[str]]:
    """Return a subset's tracks as what rules are checked on, and the columns that its source does not have."""
    vehicles = reader.table(VEHICLES, "vehicle_id", *VEHICLE_COLUMNS)
    facts = reader.table(SUBSETS, *SUBSET_COLUMNS, "columns_missing")
    return Scene(tracks, vehicles, *facts.select(SUBSET_COLUMNS).row(0)), find_lacking(vehicles, facts)


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Find what breaks rules in a subset, score its vehicles, and judge the subset."""
    speeds, judged = judge_tracks(reader, settings, RECORDED)
    status = judge_subset(speeds, max_backward_share=settings.max_backward_share)
    # No NGSIM recording has these, and no arterial a section, so a note about each of them would tell nothing.
    usual = {"lane_markings_m", "length_range_m", "heading_error_rad", *([] if reader.facts["freeway"] else ["lanes"])}
    lacking = [rule.name for rule in judged.unchecked if not usual & {*rule.columns, *rule.reads}]
    reasons = status.filter(pl.col("excluded"))["excluded_reason"].to_list()
    unchecked = f"{reader.subset}: rules not checked, since the files lack what they read: {', '.join(lacking)}"
    return StageResult(
        {
            FINDINGS: judged.findings,
            VEHICLE_SCORES: judged.vehicle_scores,
            SUBSET_SCORES: judged.subset_scores,
            SUBSET_STATUS: status,
        },
        notes=[unchecked] * bool(lacking)
        + [f"{reader.subset} is excluded from samples and splits: {reason}" for reason in reasons],
    )


def judge_tracks(
    reader: SubsetReader, settings: Settings, tracks_from: TracksFrom, ignored: frozenset[str] = frozenset()
) -> tuple[pl.DataFrame, Judgement]:
    """Judge a subset's tracks by the rules that need none of the ignored columns, a long subset's slice by slice.

    Also returns a speed for each entry, or of a long subset the least one of each vehicle.
    """
    limits = _select(settings)
    context_s = LONGEST_WINDOW_S + resolve(RULES, limits)["lane_flicker_s"]
    slices = list(reader.cut(settings, context_s, tracks_from=tracks_from, share=SHARE))
    if slices[0].slice is not None:
        return _judge_slices(slices, tracks_from, ignored, limits)
    tracks = reader.read_tracks_from(tracks_from, *tracks_needed())
    scene, lacking = open_scene(reader, tracks)
    return tracks, judge(scene, lacking | ignored, limits)


def _judge_slices(
    slices: list[SubsetReader], tracks_from: TracksFrom, ignored: frozenset[str], limits: dict[str, float]
) -> tuple[pl.DataFrame, Judgement]:
    """Judge a subset slice by slice, after a look at all of them; also return the least speed of each vehicle."""

    def read(each: SubsetReader, *, context: bool) -> pl.DataFrame:
        assert each.slice is not None
        own = each if context else replace(each, slice=replace(each.slice, context=0))
        return own.read_tracks_from(tracks_from, *tracks_needed())

    def open_one(tracks: pl.DataFrame) -> Scene:
        return open_scene(slices[0], tracks)[0]

    assert slices[0].slice is not None
    whole = survey((read(each, context=False) for each in slices), open_one, slices[0].slice.context)
    lacking = ignored | open_scene(slices[0], whole.anchors)[1]
    lacking |= {"heading_error_rad"} if not whole.has_headings else set()

    def open_all() -> Iterator[Scene]:
        for each in slices:
            assert each.slice is not None
            known = Whole((each.slice.first_frame, each.slice.end_frame), whole.shared_frames, whole.ends_at_bumpers)
            elsewhere = whole.anchors.filter(~each.slice.is_read(pl.col("frame")))
            tracks = pl.concat([read(each, context=True), elsewhere]).sort("vehicle_id", "frame")
            yield replace(open_one(tracks), whole=known)

    return whole.least_speeds, judge_slices(open_all(), lacking, limits)


STAGE = Stage(
    name="validate",
    meaning="Check every entry of recordings from above against the rules; `tracklake run` also checks drives.",
    scope="recording",
    after=(INGEST,),
    settings=(describe_rules, "max_backward_share"),
    version=4,
    build=build,
)
