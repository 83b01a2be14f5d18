"""Scores: shares of tracks and subsets that break no rule, and the consistency of a subset.

After Punzo, Borzacchiello and Ciuffo (2011), who judge trajectories by feasibility (jerk), internal consistency
(recorded speeds and accelerations against positions) and platoon consistency (spacing between vehicles), and Coifman
and Li (2017).
"""

import math
from collections.abc import Mapping, Sequence
from typing import cast

import polars as pl

from tracklake.quality_reports.rules.registry import Rule
from tracklake.schemas import SUBSET_SCORES, VEHICLE_SCORES
from tracklake.schemas.arrays import divide_sum, sum_exactly

COLUMNS_SCORED = (
    "speed_mps", "speed_10hz_mps", "accel_mps2", "accel_10hz_mps2", "jerk_mps3", "jerk_reversals", "jerk_reverses",
    "recorded_gap_m", "gap_m", "leader_ahead_m", "fragment_m",
)  # fmt: skip
"""Columns of prepared entries that `score_subset` compares where they are present."""


def tally_vehicles(entries: pl.DataFrame, rules: Sequence[Rule], limits: Mapping[str, float]) -> pl.DataFrame:
    """Count each vehicle's entries, those without error and warning, those with a jerk, and its reversals.

    The entries are prepared ones of ONE subset, or of a slice of it.
    """
    error, warning = (
        pl.any_horizontal(pl.lit(value=False), *(rule.broken(limits) for rule in rules if rule.severity == severity))
        for severity in ("error", "warning")
    )
    reverses = pl.col("jerk_reverses") if "jerk_reverses" in entries.columns else pl.lit(None, pl.Boolean)
    return (
        entries.lazy()
        .select("vehicle_id", error=error, either=error | warning, reverses=reverses)
        .group_by("vehicle_id")
        .agg(
            entries=pl.len(),
            without_error=(~pl.col("error")).sum(),
            without_warning=(~pl.col("either")).sum(),
            jerks=pl.col("reverses").count(),
            reversals=pl.col("reverses").sum(),
        )
        .collect()
    )


def score_vehicles(tallies: Sequence[pl.DataFrame], place: Mapping[str, str]) -> pl.DataFrame:
    """Return `vehicle_scores`: each vehicle's shares of entries without error and warning, and of reversals of jerk.

    Args:
        tallies: what `tally_vehicles` counted in the slices of a subset.
        place: dataset and subset.
    """
    scores = (
        pl.concat(tallies)
        .lazy()
        .group_by("vehicle_id")
        .agg(pl.all().sum())
        .sort("vehicle_id")
        .select(
            *(pl.lit(value).alias(name) for name, value in place.items()),
            "vehicle_id",
            "entries",
            share_without_error=pl.col("without_error") / pl.col("entries"),
            share_without_warning=pl.col("without_warning") / pl.col("entries"),
            jerk_reversal_share=pl.when(pl.col("jerks") > 0).then(pl.col("reversals") / pl.col("jerks")),
        )
    )
    return VEHICLE_SCORES.conform(scores).collect()


SQUARES = {
    "speed_rms_mps": ("speed_mps", "speed_10hz_mps"),
    "accel_rms_mps2": ("accel_mps2", "accel_10hz_mps2"),
    "spacing_rms_m": ("recorded_gap_m", "gap_m"),
}
"""Columns of the subset's scores that are root mean squares of differences, and of which columns."""


def tally_subset(entries: pl.DataFrame, limits: Mapping[str, float]) -> dict[str, int | float | None]:
    """Count and add up what `score_subset` compares; what cannot be compared is None.

    The entries are prepared ones of ONE subset, or of a slice of it, with those of COLUMNS_SCORED that its source has.
    """
    jerk, has_jerk = pl.col("jerk_mps3").abs(), pl.col("jerk_mps3").is_not_null()
    counted = {
        "jerks": has_jerk.sum(),
        "high_jerks": (jerk > limits["high_jerk_mps3"]).sum(),
        "worst_jerk_mps3": jerk.max(),
        "jerk_flickers": (pl.col("jerk_reversals") > limits["jerk_flicker_changes"]).filter(has_jerk).sum(),
        "signed_jerks": pl.col("jerk_reverses").count(),
        "jerk_reversals": pl.col("jerk_reverses").sum(),
        "fragments": (pl.col("fragment_m") > limits["track_fragment_m"]).sum(),
    }
    present = {*entries.columns}
    found: dict[str, int | float | None] = entries.select(
        value.alias(name) if present.issuperset(value.meta.root_names()) else pl.lit(None).alias(name)
        for name, value in counted.items()
    ).row(0, named=True)
    for name, columns in SQUARES.items():
        reads = [*columns, "leader_ahead_m"] if name == "spacing_rms_m" else columns
        if present.issuperset(reads):
            first, second = (pl.col(column).cast(pl.Float64) for column in columns)
            known = entries.lazy().drop_nulls(reads)
            squares = known.select((first - second) ** 2).collect().to_series()
            found |= {name: sum_exactly(squares.to_numpy()), f"{name}_count": len(squares)}
    return found


def score_subset(
    tallies: Sequence[Mapping[str, int | float | None]],
    vehicle_scores: pl.DataFrame,
    place: Mapping[str, str],
    unchecked: Sequence[Rule] = (),
    cross_sections: Sequence[Mapping[str, float | int | None]] | None = None,
) -> pl.DataFrame:
    """Return `subset_scores`: one row.

    Sums are exact and rounded once, so that they are the same of a whole subset and of its slices.

    Args:
        tallies: what `tally_subset` found in the slices of a subset.
        vehicle_scores: the subset's.
        place: dataset and subset.
        unchecked: rules that need a column which the source lacks.
        cross_sections: see `quality_reports.rules.cross_sections.balance_sections`; None where they are unknown.
    """
    shares = pl.col("share_without_error", "share_without_warning")
    feasible = vehicle_scores.select(
        (shares * pl.col("entries")).sum() / pl.col("entries").sum(),
        vehicles_without_error=(pl.col("share_without_error") == 1).mean(),
        vehicles_without_warning=(pl.col("share_without_warning") == 1).mean(),
    )

    def add(name: str) -> int | None:
        values = [tally.get(name) for tally in tallies]
        return None if None in values else sum(cast("list[int]", values))

    def divide(part: str, whole: str) -> float | None:
        count, total = add(part), add(whole)
        return count / total if count is not None and total else None

    def root(name: str) -> float | None:
        total, count = add(name), add(f"{name}_count")
        return math.sqrt(divide_sum(total, count)) if total is not None and count else None

    fragments, jerks = add("fragments"), [tally["worst_jerk_mps3"] for tally in tallies]
    row = {
        **place,
        "entries": vehicle_scores["entries"].sum(),
        "rules_unchecked": [rule.name for rule in unchecked],
        **feasible.row(0, named=True),
        **{name: root(name) for name in SQUARES},
        "high_jerk_share": divide("high_jerks", "jerks"),
        "worst_jerk_mps3": max((jerk for jerk in jerks if jerk is not None), default=None),
        "jerk_flicker_share": divide("jerk_flickers", "jerks"),
        "jerk_reversal_share": divide("jerk_reversals", "signed_jerks"),
        "fragments_per_1000_vehicles": None if fragments is None else fragments * (1000 / vehicle_scores.height),
        "cross_sections": cross_sections,
        "spacings": add("spacing_rms_m_count") or 0,
    }
    return pl.DataFrame([row], schema=SUBSET_SCORES.dtypes)
