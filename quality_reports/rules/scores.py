"""Scores: shares of tracks and subsets that break no rule, and the consistency of a subset.

After Punzo, Borzacchiello and Ciuffo (2011), who judge trajectories by feasibility (jerk), internal consistency
(recorded speeds and accelerations against positions) and platoon consistency (spacing between vehicles), and Coifman
and Li (2017).
"""

from collections.abc import Mapping, Sequence

import polars as pl

from tracklake.quality_reports.rules.registry import RULES, Rule, resolve
from tracklake.schemas import SUBSET_SCORES, VEHICLE_SCORES

COLUMNS_SCORED = (
    "speed_mps", "speed_10hz_mps", "accel_mps2", "accel_10hz_mps2", "jerk_mps3", "jerk_reversals", "jerk_reverses",
    "recorded_gap_m", "gap_m", "leader_ahead_m", "fragment_m",
)  # fmt: skip
"""Columns of prepared entries that `score_subset` compares where they are present."""


def score_vehicles(
    entries: pl.DataFrame, rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None
) -> pl.DataFrame:
    """Return `vehicle_scores`: each vehicle's shares of entries without error and warning, and of reversals of jerk.

    The entries are ONE subset's prepared ones, sorted by vehicle_id, frame; thresholds override by name.

    Raises:
        ThresholdError: see `quality_reports.rules.registry.resolve`.
    """
    limits = resolve(rules, thresholds)
    if entries.is_empty():
        return VEHICLE_SCORES.empty()
    error, warning = (
        pl.any_horizontal(pl.lit(value=False), *(rule.broken(limits) for rule in rules if rule.severity == severity))
        for severity in ("error", "warning")
    )
    reverses = pl.col("jerk_reverses") if "jerk_reverses" in entries.columns else pl.lit(None, pl.Boolean)
    scores = (
        entries.lazy()
        .select("dataset", "subset", "vehicle_id", error=error, either=error | warning, reverses=reverses)
        .group_by("vehicle_id", maintain_order=True)
        .agg(
            pl.col("dataset", "subset").first(),
            entries=pl.len(),
            share_without_error=(~pl.col("error")).mean(),
            share_without_warning=(~pl.col("either")).mean(),
            jerk_reversal_share=pl.col("reverses").mean(),
        )
    )
    return VEHICLE_SCORES.conform(scores).collect()


def score_subset(
    entries: pl.DataFrame,
    vehicle_scores: pl.DataFrame,
    unchecked: Sequence[Rule] = (),
    thresholds: Mapping[str, float] | None = None,
    cross_sections: Sequence[Mapping[str, float | int | None]] | None = None,
) -> pl.DataFrame:
    """Return `subset_scores`: one row, or none where there are no entries.

    The entries are ONE subset's prepared ones, with those of COLUMNS_SCORED that its source has; of the thresholds,
    high_jerk_mps3, jerk_flicker_changes and track_fragment_m count here. For the cross sections see
    `quality_reports.rules.cross_sections.balance_sections`; None where they are unknown.

    Raises:
        ThresholdError: see `quality_reports.rules.registry.resolve`.
    """
    limits = resolve(RULES, thresholds)
    if entries.is_empty():
        return SUBSET_SCORES.empty()
    shares = pl.col("share_without_error", "share_without_warning")
    feasible = vehicle_scores.select(
        (shares * pl.col("entries")).sum() / pl.col("entries").sum(),
        vehicles_without_error=(pl.col("share_without_error") == 1).mean(),
        vehicles_without_warning=(pl.col("share_without_warning") == 1).mean(),
    )
    has_jerk = pl.col("jerk_mps3").is_not_null()
    spacing = _difference("recorded_gap_m", "gap_m").filter(pl.col("leader_ahead_m").is_not_null())
    compared = {
        "speed_rms_mps": _root_mean_square(_difference("speed_mps", "speed_10hz_mps")),
        "accel_rms_mps2": _root_mean_square(_difference("accel_mps2", "accel_10hz_mps2")),
        "high_jerk_share": (pl.col("jerk_mps3").abs() > limits["high_jerk_mps3"]).mean(),
        "worst_jerk_mps3": pl.col("jerk_mps3").abs().max(),
        "jerk_flicker_share": (pl.col("jerk_reversals") > limits["jerk_flicker_changes"]).filter(has_jerk).mean(),
        "jerk_reversal_share": pl.col("jerk_reverses").mean(),
        "fragments_per_1000_vehicles": (pl.col("fragment_m") > limits["track_fragment_m"]).sum()
        * (1000 / vehicle_scores.height),
        "spacing_rms_m": _root_mean_square(spacing),
        "spacings": spacing.count(),
    }
    row = entries.select(
        value.alias(name) if set(value.meta.root_names()) <= set(entries.columns) else pl.lit(None).alias(name)
        for name, value in compared.items()
    )
    facts = {
        "dataset": [entries["dataset"][0]],
        "subset": [entries["subset"][0]],
        "entries": [entries.height],
        "rules_unchecked": [[rule.name for rule in unchecked]],
        "cross_sections": [cross_sections],
    }
    types = {name: SUBSET_SCORES.dtypes[name] for name in ("rules_unchecked", "cross_sections")}
    scores = pl.concat([pl.DataFrame(facts, schema_overrides=types), feasible, row], how="horizontal").with_columns(
        pl.col("spacings").fill_null(0)
    )
    return SUBSET_SCORES.conform(scores.lazy()).collect()


def _difference(first: str, second: str) -> pl.Expr:
    """Return the difference of two columns."""
    return pl.col(first).cast(pl.Float64) - pl.col(second).cast(pl.Float64)


def _root_mean_square(values: pl.Expr) -> pl.Expr:
    """Return the root of the mean square."""
    return (values**2).mean().sqrt()
