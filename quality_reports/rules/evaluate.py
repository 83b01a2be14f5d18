"""Evaluation of the rules on one subset: its findings and scores."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from tracklake.quality_reports.rules.cross_sections import balance_sections
from tracklake.quality_reports.rules.derived import ENDS, prepare, trace
from tracklake.quality_reports.rules.findings import find, require_one_sorted_subset
from tracklake.quality_reports.rules.registry import (
    RULES,
    Rule,
    checkable,
    columns_needed,
    columns_read,
    resolve,
    select_broken,
)
from tracklake.quality_reports.rules.scene import SUBSET_COLUMNS, VEHICLE_COLUMNS, Scene
from tracklake.quality_reports.rules.scores import COLUMNS_SCORED, score_subset, score_vehicles


@dataclass(frozen=True)
class Judgement:
    """Rows of `findings`, `vehicle_scores` and `subset_scores` (one), and rules that need a column the source lacks."""

    findings: pl.DataFrame
    vehicle_scores: pl.DataFrame
    subset_scores: pl.DataFrame
    unchecked: tuple[Rule, ...]


def judge(
    scene: Scene,
    lacking: Collection[str] = (),
    thresholds: Mapping[str, float] | None = None,
    rules: Sequence[Rule] = RULES,
) -> Judgement:
    """Judge a subset by the rules.

    The scene has the columns of `tracks_needed`; `lacking` are columns that its source does not have; thresholds
    override by name.

    Raises:
        SubsetOrderError: see `quality_reports.rules.findings.find`.
        ThresholdError: see `quality_reports.rules.registry.resolve`.
    """
    limits = resolve(rules, thresholds)
    require_one_sorted_subset(scene.tracks)
    if scene.tracks["heading_rad"].null_count() == scene.height:
        # Other rules do without headings: to them, bodies without one lie along the road.
        lacking = {*lacking, "heading_error_rad"}
    checked = checkable(rules, lacking)
    unchecked = tuple(rule for rule in rules if rule not in checked)
    scored = [name for name in COLUMNS_SCORED if not set(trace([name])) & set(lacking)]
    entries = prepare(scene, [*columns_read(checked), *scored])
    broken = select_broken(entries, checked, _select_limits(checked, limits))
    vehicle_scores = score_vehicles(entries, broken, _select_limits(broken, limits))
    return Judgement(
        findings=find(entries, broken, _select_limits(broken, limits)),
        vehicle_scores=vehicle_scores,
        subset_scores=score_subset(
            entries.drop(set(lacking), strict=False),
            vehicle_scores,
            unchecked,
            limits,
            None if set(ENDS) & set(lacking) else balance_sections(scene),
        ),
        unchecked=unchecked,
    )


def tracks_needed(rules: Sequence[Rule] = RULES) -> tuple[str, ...]:
    """Return the columns of `tracks` that `judge` needs for these rules."""
    elsewhere = {*VEHICLE_COLUMNS, *SUBSET_COLUMNS}
    names = ["dataset", "subset", "vehicle_id", "frame", *columns_needed(rules), *trace(COLUMNS_SCORED)]
    return tuple(name for name in dict.fromkeys(names) if name not in elsewhere)


def _select_limits(rules: Sequence[Rule], limits: Mapping[str, float]) -> dict[str, float]:
    """Select the thresholds of some rules."""
    return {name: limits[name] for rule in rules for name in rule.defaults}
