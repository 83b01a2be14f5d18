"""An allocation as tables: which unit stands in which part, and how the parts compare.

A unit is what a split moves as a whole: a subset, a block of one, or a range of its vehicles.
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
    "flow": pl.Float64,
    "first_frame": pl.Int32,
    "last_frame": pl.Int32,
}
"""What is known of a unit: counts, flow and frames."""

WHOLE: dict[str, pl.Expr] = {
    "block": pl.lit(0, pl.Int32),
    "first_vehicle_id": pl.lit(None, pl.Int32),
    "last_vehicle_id": pl.lit(None, pl.Int32),
}
"""Which unit of its subset it is; these, where nothing is said, of one that is its whole subset."""


@dataclass(frozen=True)
class Allocation:
    """A split and how alike its parts are.

    Args:
        splits: rows of `schemas.splits.SPLITS`.
        balance: rows of `schemas.splits.SPLIT_BALANCE`; a part without subsets stands there with zeros.
    """

    splits: pl.DataFrame
    balance: pl.DataFrame

    @property
    def relaxations(self) -> dict[str, str]:
        """By dataset: which constraints could not be met, and by how much."""
        relaxed = self.balance.filter(pl.col("relaxed")).unique("dataset", maintain_order=True)
        return dict(relaxed.select("dataset", "relaxed_reason").iter_rows())


def tabulate(
    units: pl.DataFrame, *, split: str, parts: Sequence[str], reasons: Mapping[str, str | None] | None = None
) -> Allocation:
    """Write an allocation up.

    Args:
        units: the columns of `COLUMNS`, those of `WHOLE` where units are no whole subsets, and `part`.
        split: the name to write into the tables.
        parts: all that there are, in order.
        reasons: by dataset, which constraints are broken; None: none.
    """
    # Sorted, so that the same units give the same sums, to the last digit.
    units = complete(units).sort("dataset", "subset", "block", "part")
    balances = [SPLIT_BALANCE.empty()]
    for (dataset,), rows in units.group_by("dataset"):
        balances.append(_compare(rows, split, parts, (reasons or {}).get(str(dataset))))
    return Allocation(
        splits=SPLITS.conform(units.lazy().with_columns(split=pl.lit(split, pl.String))).collect().sort(SPLITS.key),
        balance=pl.concat(balances).sort(SPLIT_BALANCE.key),
    )


def complete(units: pl.DataFrame) -> pl.DataFrame:
    """The units with the columns of `WHOLE`."""
    missing = [value.alias(name) for name, value in WHOLE.items() if name not in units.columns]
    return units.with_columns(missing)


def _compare(rows: pl.DataFrame, split: str, parts: Sequence[str], reason: str | None) -> pl.DataFrame:
    """Rows of `split_balance` of one dataset: one per part, those without units included."""
    total = max(1, int(rows["vehicles"].sum()))
    balance: list[dict[str, object]] = []
    for part in parts:
        members = rows.filter(pl.col("part") == part)
        mean, std = _moments(members)
        balance.append(
            {
                "split": split,
                "dataset": rows["dataset"][0],
                "part": part,
                "subsets": members["subset"].n_unique(),
                "vehicles": members["vehicles"].sum(),
                "vehicle_share": members["vehicles"].sum() / total,
                "samples": members["weight"].sum(),
                "flow_mean": mean,
                "flow_std": std,
                "relaxed": reason is not None,
                "relaxed_reason": reason,
            }
        )
    return pl.DataFrame(balance, schema=SPLIT_BALANCE.dtypes)


def _moments(members: pl.DataFrame) -> tuple[float, float] | tuple[None, None]:
    """Weighted mean and population standard deviation of flow, in two passes (these are the figures published)."""
    known = members.filter(pl.col("flow").is_not_null())
    weight, flow = known["weight"].to_numpy().astype(np.float64), known["flow"].to_numpy()
    if weight.sum() == 0:
        return None, None
    mean = float(np.average(flow, weights=weight))
    return mean, float(np.sqrt(np.average((flow - mean) ** 2, weights=weight)))
