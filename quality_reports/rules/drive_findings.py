"""Findings of a drive: runs of a station's messages, or of a vehicle's ticks, that break a rule."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from tracklake.quality_reports.rules.along_messages import prepare_messages, prepare_ticks
from tracklake.quality_reports.rules.registry import DRIVE_RULES, Rule, resolve
from tracklake.schemas.perception import DRIVE_CHECKS, DRIVE_FINDINGS

TICK_COLUMNS = ("dataset", "subset", "vehicle_id", "tick", "box_x_m", "box_y_m", "from_lidar")
"""Columns of `surrounding` that the rules over ticks need."""


@dataclass(frozen=True)
class Drive:
    """What the rules read of one drive: its rows of `bsm`, of `surrounding` (TICK_COLUMNS) and of `ego_states`."""

    messages: pl.DataFrame
    surrounding: pl.DataFrame
    ego_states: pl.DataFrame


def judge_drive(
    drive: Drive, thresholds: Mapping[str, float] | None = None, rules: Sequence[Rule] = DRIVE_RULES
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return the rows of `drive_findings` and of `drive_checks` of a drive.

    Raises:
        ThresholdError: see `quality_reports.rules.registry.resolve`.
    """
    limits = resolve(rules, thresholds)
    prepared = {
        "messages": prepare_messages(drive.messages),
        "ticks": prepare_ticks(drive.surrounding, drive.messages, drive.ego_states),
    }
    found = [find_runs(prepared[rule.over], rule, limits) for rule in rules]
    findings = pl.concat(found) if found else DRIVE_FINDINGS.empty()
    checks = [_count(prepared[rule.over], own, rule, limits) for rule, own in zip(rules, found, strict=True)]
    return findings.sort(DRIVE_FINDINGS.key), pl.concat(checks).sort("rule")


def find_runs(rows: pl.DataFrame, rule: Rule, limits: Mapping[str, float]) -> pl.DataFrame:
    """Find the runs of rows that break one rule: messages in a row, or of adjacent ticks.

    Args:
        rows: prepared messages or ticks, sorted by vehicle_id and time, with `number` within the vehicle.
        rule: what they break.
        limits: thresholds by name.
    """
    apart = [pl.col(name) - pl.col(name).shift(1) > 1 for name in ("number", "tick")]
    begins = (pl.col("vehicle_id") != pl.col("vehicle_id").shift(1)) | (apart[0] & apart[1])
    value = pl.col("value")
    runs = (
        rows.lazy()
        .filter(rule.broken(limits))
        .select("dataset", "subset", "vehicle_id", "tick", "number", value=rule.measure(limits).cast(pl.Float64))
        .with_columns(run=begins.fill_null(value=True).cum_sum())
        .group_by("run")
        .agg(
            pl.col("dataset", "subset", "vehicle_id").first(),
            first_tick=pl.col("tick").first(),
            last_tick=pl.col("tick").last(),
            entries=pl.len(),
            worst=value.min() if rule.extreme == "min" else value.max(),
        )
        .with_columns(rule=pl.lit(rule.name), severity=pl.lit(rule.severity))
    )
    return DRIVE_FINDINGS.conform(runs).sort("vehicle_id", "first_tick").collect()


def _count(rows: pl.DataFrame, runs: pl.DataFrame, rule: Rule, limits: Mapping[str, float]) -> pl.DataFrame:
    """Return a rule's row of `drive_checks`; none where the drive has nothing of what it judges."""
    if rows.is_empty():
        return DRIVE_CHECKS.empty()
    place = rows.select(pl.col("dataset", "subset").first(), checked=rule.measure(limits).count())
    counted = runs.select(
        entries=pl.col("entries").sum(),
        vehicles=pl.col("vehicle_id").n_unique(),
        runs=pl.len(),
        worst=pl.col("worst").min() if rule.extreme == "min" else pl.col("worst").max(),
    )
    row = pl.concat([place, counted], how="horizontal")
    return DRIVE_CHECKS.conform(
        row.lazy().with_columns(rule=pl.lit(rule.name), severity=pl.lit(rule.severity))
    ).collect()
