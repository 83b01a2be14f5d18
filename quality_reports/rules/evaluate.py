"""Evaluation of the rules on one subset: its findings and scores."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from tracklake.quality_reports.rules.cross_sections import balance_sections
from tracklake.quality_reports.rules.derived import ENDS, prepare, trace
from tracklake.quality_reports.rules.findings import find, join_runs, require_one_sorted_subset
from tracklake.quality_reports.rules.registry import (
    RULES,
    Rule,
    columns_needed,
    columns_read,
    resolve,
    select_broken,
    select_checkable,
)
from tracklake.quality_reports.rules.scene import SUBSET_COLUMNS, VEHICLE_COLUMNS, Scene
from tracklake.quality_reports.rules.scores import (
    COLUMNS_SCORED,
    score_subset,
    score_vehicles,
    tally_subset,
    tally_vehicles,
)
from tracklake.schemas import FINDINGS, SUBSET_SCORES, VEHICLE_SCORES


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
    if scene.tracks["heading_rad"].null_count() == scene.height:
        # Other rules do without headings: to them, bodies without one lie along the road.
        lacking = {*lacking, "heading_error_rad"}
    return judge_slices([scene], lacking, thresholds, rules)


def judge_slices(
    scenes: Iterable[Scene],
    lacking: Collection[str] = (),
    thresholds: Mapping[str, float] | None = None,
    rules: Sequence[Rule] = RULES,
) -> Judgement:
    """Judge a subset that is given in slices, one after the other; arguments and errors are those of `judge`.

    Every entry is judged in the slice that owns its frame; runs that go on in the next slice are joined.
    """
    limits = resolve(rules, thresholds)
    all_limits = resolve(RULES, limits)  # scores need some whatever the rules are
    checked = select_checkable(rules, lacking)
    unchecked = tuple(rule for rule in rules if rule not in checked)
    scored = [name for name in COLUMNS_SCORED if not set(trace([name])) & set(lacking)]
    found, vehicles, tallies = [], [], []
    place: dict[str, str] = {}
    sections: list[dict[str, float | int | None]] | None = None
    for scene in scenes:
        require_one_sorted_subset(scene.tracks)
        entries = prepare(scene, [*columns_read(checked), *scored])
        if scene.whole is not None:
            first, end = scene.whole.own_frames
            entries = entries.filter(pl.col("frame").is_between(first, end - 1))
        broken = select_broken(entries, checked, _select_limits(checked, limits))
        own_limits = _select_limits(broken, limits)
        found.append(find(entries, broken, own_limits))
        vehicles.append(tally_vehicles(entries, broken, own_limits))
        tallies.append(tally_subset(entries.drop(set(lacking), strict=False), all_limits))
        if not place and entries.height:
            place = entries.select("dataset", "subset").row(0, named=True)
            # Of the ends of tracks, which all slices have.
            sections = None if set(ENDS) & set(lacking) else balance_sections(scene)
    if not place:
        return Judgement(FINDINGS.empty(), VEHICLE_SCORES.empty(), SUBSET_SCORES.empty(), unchecked)
    vehicle_scores = score_vehicles(vehicles, place)
    return Judgement(
        findings=found[0] if len(found) == 1 else join_runs(pl.concat(found)),
        vehicle_scores=vehicle_scores,
        subset_scores=score_subset(tallies, vehicle_scores, place, unchecked, sections),
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
