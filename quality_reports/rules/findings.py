"""Findings: runs of entries that break a rule, and the exclusion of subsets."""

from collections.abc import Mapping, Sequence

import polars as pl

from tracklake.quality_reports.rules.registry import RULES, Rule, resolve
from tracklake.schemas import FINDINGS, SUBSET_STATUS
from tracklake.schemas.columns import key_increases

MAX_BACKWARD_SHARE = 0.01
"""Greatest share of vehicles with an entry of negative speed in a subset that is kept (DESIGN section 5)."""


class SubsetOrderError(ValueError):
    """A frame does not hold one subset's tracks sorted by vehicle_id, frame."""


def find(
    tracks: pl.DataFrame, rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None
) -> pl.DataFrame:
    """Find every run of consecutive entries of one vehicle that breaks one rule.

    Entries are consecutive when their frames differ by exactly 1; a frame gap ends a run. The tracks are ONE subset's
    entries, sorted by vehicle_id, frame, with the columns that the rules name. Returns `findings`, sorted by rule,
    vehicle_id, first_frame; `worst` is the extreme of the rule's value.

    Raises:
        SubsetOrderError: more than one subset, or not sorted.
        ThresholdError: see `quality_reports.rules.registry.resolve`.
    """
    limits = resolve(rules, thresholds)
    require_one_sorted_subset(tracks)
    if not rules or tracks.is_empty():
        return FINDINGS.empty()
    runs = [_find_runs(tracks.lazy(), rule, limits) for rule in rules]
    return FINDINGS.conform(pl.concat(runs)).sort(FINDINGS.key).collect()


def _find_runs(tracks: pl.LazyFrame, rule: Rule, limits: Mapping[str, float]) -> pl.LazyFrame:
    """Find the runs that break one rule.

    Among breaking entries alone, neighbours of one vehicle with adjacent frames are consecutive in the track too, so
    the runs are found after the filter, on the few rows that are left.
    """
    begins = (pl.col("vehicle_id") != pl.col("vehicle_id").shift(1)) | (pl.col("frame") - pl.col("frame").shift(1) != 1)
    value = pl.col("value")
    return (
        tracks.filter(rule.broken(limits))
        .select("dataset", "subset", "vehicle_id", "frame", value=rule.measure(limits).cast(pl.Float64))
        .with_columns(run=begins.fill_null(value=True).cum_sum())
        .group_by("run")
        .agg(
            pl.col("dataset", "subset", "vehicle_id").first(),
            first_frame=pl.col("frame").first(),
            last_frame=pl.col("frame").last(),
            entries=pl.len(),
            worst=value.min() if rule.extreme == "min" else value.max(),
        )
        .with_columns(rule=pl.lit(rule.name), severity=pl.lit(rule.severity))
    )


def join_runs(findings: pl.DataFrame) -> pl.DataFrame:
    """Join the runs of one rule and vehicle that follow one another without a frame between them.

    The findings are those of the slices of one subset, in any order; see `find`.
    """
    extremes = [rule.name for rule in RULES if rule.extreme == "min"]
    same = [pl.col(name) == pl.col(name).shift(1) for name in ("rule", "vehicle_id")]
    goes_on = pl.all_horizontal(*same, pl.col("first_frame") == pl.col("last_frame").shift(1) + 1)
    worst = pl.col("worst")
    runs = (
        findings.lazy()
        .sort(FINDINGS.key)
        .with_columns(run=(~goes_on.fill_null(value=False)).cum_sum())
        .group_by("run")
        .agg(
            pl.col("dataset", "subset", "vehicle_id", "rule", "severity", "first_frame").first(),
            pl.col("last_frame").last(),
            pl.col("entries").sum(),
            pl.when(pl.col("rule").first().is_in(extremes)).then(worst.min()).otherwise(worst.max()),
        )
    )
    return FINDINGS.conform(runs).sort(FINDINGS.key).collect()


def judge_subset(tracks: pl.DataFrame, *, max_backward_share: float = MAX_BACKWARD_SHARE) -> pl.DataFrame:
    """Decide whether a subset is excluded from samples and splits because its vehicles drive backwards.

    It is when MORE than `max_backward_share` of the vehicles have any entry with speed_mps < 0 (DESIGN section 5),
    whatever the threshold of the rule `backward`. The tracks are ONE subset's entries: dataset, subset, vehicle_id,
    speed_mps, sorted by vehicle_id, frame; without entries there is no row.

    Raises:
        SubsetOrderError: more than one subset, or not sorted.
        ValueError: the share is outside 0 to 1.
    """
    if not 0 <= max_backward_share <= 1:
        raise ValueError(f"max_backward_share must be between 0 and 1, got {max_backward_share}")
    require_one_sorted_subset(tracks)
    if tracks.is_empty():
        return SUBSET_STATUS.empty()
    vehicles = tracks["vehicle_id"].n_unique()
    backward = tracks.filter(pl.col("speed_mps") < 0)["vehicle_id"].n_unique()
    # Divided, not multiplied: 3 / 300 is the double nearest 0.01, as the setting is; 0.07 * 100 is not 7.
    share = backward / vehicles
    excluded = share > max_backward_share
    reason = (
        f"{backward} of {vehicles} vehicles ({100 * share:.2f} %) have entries of negative speed; "
        f"at most {100 * max_backward_share:g} % may"
    )
    row = {
        "dataset": [tracks["dataset"][0]],
        "subset": [tracks["subset"][0]],
        "backward_vehicles": [backward],
        "excluded": [excluded],
        "excluded_reason": [reason if excluded else None],
    }
    return pl.DataFrame(row, schema=SUBSET_STATUS.dtypes)


def require_one_sorted_subset(tracks: pl.DataFrame) -> None:
    """Refuse tracks of more than one subset, or not sorted by vehicle_id, frame, each pair once.

    Raises:
        SubsetOrderError: saying which.
    """
    if tracks.is_empty():
        return
    another, in_order = tracks.select(
        another=(pl.col("dataset") != pl.col("dataset").first()).any()
        | (pl.col("subset") != pl.col("subset").first()).any(),
        in_order=key_increases(("vehicle_id", "frame")).all(),
    ).row(0)
    if another:
        some = tracks.select("dataset", "subset").unique(maintain_order=True).head(3).rows()
        raise SubsetOrderError(f"expected the tracks of one subset, got {some}; call once per subset")
    if not in_order:
        subset = tracks["subset"][0]
        raise SubsetOrderError(f"{subset}: tracks must be sorted by vehicle_id, frame, each pair once; sort them first")
