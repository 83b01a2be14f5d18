"""The tables of a split: the part of each unit, and a comparison of the parts.

A unit is assigned as a whole: a subset, a block of one, or a range of its vehicles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.schemas.splits import SPLIT_BALANCE, SPLITS

COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "dataset": pl.String,
    "subset": pl.String,
    "site": pl.String,
    "direction": pl.String,
    "vehicles": pl.Int64,
    "weight": pl.Int64,
    "vehicles_per_lane_s": pl.Float64,
    "first_frame": pl.Int32,
    "last_frame": pl.Int32,
}
"""Columns of a unit: counts, vehicles per lane and second, and frames."""

WHOLE: dict[str, pl.Expr] = {
    "block": pl.lit(0, pl.Int32),
    "first_vehicle_id": pl.lit(None, pl.Int32),
    "last_vehicle_id": pl.lit(None, pl.Int32),
}
"""Columns that identify a unit within its subset, with their defaults for a whole subset."""


@dataclass(frozen=True)
class Allocation:
    """A split and the balance of its parts: rows of SPLITS and SPLIT_BALANCE; a part without subsets has zeros."""

    splits: pl.DataFrame
    balance: pl.DataFrame

    @property
    def relaxations(self) -> dict[str, str]:
        """Constraints that could not be met, and by how much, by dataset."""
        relaxed = self.balance.filter(pl.col("relaxed")).unique("dataset", maintain_order=True)
        return dict(relaxed.select("dataset", "relaxed_reason").iter_rows())


def tabulate_units(
    units: pl.DataFrame, *, split: str, parts: Sequence[str], reasons: Mapping[str, str | None] | None = None
) -> Allocation:
    """Build the tables of a split from its units: COLUMNS, `part`, and those of WHOLE if they are no whole subsets.

    `parts` are the names of all parts, in order; `reasons` describe broken constraints by dataset.
    """
    # Sorted, so that the same units give the same sums to the last digit.
    units = add_defaults(units).sort("dataset", "subset", "block", "part")
    balances = [SPLIT_BALANCE.empty()]
    for (dataset,), rows in units.group_by("dataset"):
        balances.append(_compare_parts(rows, split, parts, (reasons or {}).get(str(dataset))))
    return Allocation(
        splits=SPLITS.conform(units.lazy().with_columns(split=pl.lit(split, pl.String))).collect().sort(SPLITS.key),
        balance=pl.concat(balances).sort(SPLIT_BALANCE.key),
    )


def add_defaults(units: pl.DataFrame) -> pl.DataFrame:
    """Add the columns of WHOLE that are missing."""
    missing = [value.alias(name) for name, value in WHOLE.items() if name not in units.columns]
    return units.with_columns(missing)


def _compare_parts(rows: pl.DataFrame, split: str, parts: Sequence[str], reason: str | None) -> pl.DataFrame:
    """Build one dataset's rows of `split_balance`: one per part, also without units."""
    total = max(1, int(rows["vehicles"].sum()))
    balance: list[dict[str, object]] = []
    for part in parts:
        members = rows.filter(pl.col("part") == part)
        mean, std = _compute_moments(members)
        balance.append(
            {
                "split": split,
                "dataset": rows["dataset"][0],
                "part": part,
                "subsets": members["subset"].n_unique(),
                "vehicles": members["vehicles"].sum(),
                "vehicle_share": members["vehicles"].sum() / total,
                "samples": members["weight"].sum(),
                "vehicles_per_lane_s_mean": mean,
                "vehicles_per_lane_s_std": std,
                "relaxed": reason is not None,
                "relaxed_reason": reason,
            }
        )
    return pl.DataFrame(balance, schema=SPLIT_BALANCE.dtypes)


def _compute_moments(members: pl.DataFrame) -> tuple[float, float] | tuple[None, None]:
    """Compute the weighted mean and population standard deviation of vehicles_per_lane_s, in two passes."""
    known = members.filter(pl.col("vehicles_per_lane_s").is_not_null())
    weight, values = known["weight"].to_numpy().astype(np.float64), known["vehicles_per_lane_s"].to_numpy()
    if weight.sum() == 0:
        return None, None
    mean = float(np.average(values, weights=weight))
    return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))
