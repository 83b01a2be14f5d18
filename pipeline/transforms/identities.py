"""One id, one vehicle: source ids that stand for several vehicles are told apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

INT32_MAX = 2**31 - 1


@dataclass(frozen=True)
class Identified:
    """Entries with a vehicle_id that is unique within the subset.

    Args:
        entries: as given, plus vehicle_id, leader_id and follower_id (null = none), sorted by vehicle_id, frame.
        ids_split: source ids that stood for more than one vehicle.
    """

    entries: pl.DataFrame
    ids_split: int


def identify_vehicles(entries: pl.DataFrame, *, constants: Sequence[str]) -> Identified:
    """Give every vehicle of a subset an id of its own.

    A source id stands for as many vehicles as it has different sets of constants (frames announced, length, width,
    class: the same in all rows of one vehicle). Rows that still share id and frame are two vehicles as well, told apart
    by their order along the road. The vehicle seen first keeps the source's id; the others get ids beyond the highest.

    A leader or follower is the vehicle of that source id that has an entry in the same frame (and lane, where several
    have); an id that no vehicle of the subset carries is left as recorded.

    Args:
        entries: source_id, frame, x_m, lane, leader_source_id, follower_source_id (0 or null = none) and the constants.
        constants: columns that are the same in all entries of one vehicle.
    """
    rest = [name for name in entries.columns if name not in ("source_id", "frame", "x_m", *constants)]
    entries = entries.sort("source_id", "frame", *constants, "x_m", *rest)
    per_id = entries.group_by("source_id", *constants, maintain_order=True).agg(
        rows=pl.len(), frames=pl.col("frame").n_unique(), first=pl.col("frame").min()
    )
    if per_id["source_id"].is_unique().all() and (per_id["rows"] == per_id["frames"]).all():
        same = entries.with_columns(
            vehicle_id="source_id",
            leader_id=_none_if_zero("leader_source_id"),
            follower_id=_none_if_zero("follower_source_id"),
        )
        return Identified(same, 0)
    key = ["source_id", *constants]
    entries = entries.with_columns(twin=pl.int_range(pl.len(), dtype=pl.Int32).over([*key, "frame"]))
    vehicles = (
        entries.group_by(*key, "twin")
        .agg(first=pl.col("frame").min())
        .sort("source_id", "first", *constants, "twin")
        .with_columns(extra=pl.col("source_id").is_duplicated() & ~pl.col("source_id").is_first_distinct())
    )
    extra = vehicles.filter("extra")
    vehicles = pl.concat(
        [
            vehicles.filter(~pl.col("extra")).with_columns(vehicle_id=pl.col("source_id").cast(pl.Int32)),
            extra.with_columns(_unused_ids(entries, extra.height).alias("vehicle_id")),
        ]
    )
    named = vehicles.select(*key, "twin", "vehicle_id")
    entries = entries.join(named, on=[*key, "twin"], nulls_equal=True, maintain_order="left")
    split = extra["source_id"].unique()
    for role in ("leader", "follower"):
        entries = _follow_split(entries, role, split)
    return Identified(entries.drop("twin").sort("vehicle_id", "frame"), split.len())


def _none_if_zero(column: str) -> pl.Expr:
    return pl.when(pl.col(column) != 0).then(pl.col(column))


def _unused_ids(entries: pl.DataFrame, count: int) -> pl.Series:
    used = np.concatenate(
        [
            entries[name].drop_nulls().unique().to_numpy()
            for name in ("source_id", "leader_source_id", "follower_source_id")
        ]
    )
    highest = int(used.max())
    if highest + count <= INT32_MAX:
        return pl.Series(np.arange(highest + 1, highest + 1 + count, dtype=np.int32))
    return pl.Series(np.setdiff1d(np.arange(1, used.size + count + 1), used)[:count].astype(np.int32))


def _follow_split(entries: pl.DataFrame, role: str, split: pl.Series) -> pl.DataFrame:
    """Point a role's ids at vehicles where the source id they name was split."""
    source = f"{role}_source_id"
    present = entries.filter(pl.col("source_id").is_in(split.implode())).select(
        "frame", "lane", pl.col("source_id").alias(source), pl.col("vehicle_id").alias("named")
    )
    in_lane = present.unique(subset=["frame", "lane", source], keep="first", maintain_order=True)
    anywhere = present.unique(subset=["frame", source], keep="first", maintain_order=True).drop("lane")
    return (
        entries.join(in_lane, on=["frame", "lane", source], how="left", nulls_equal=True, maintain_order="left")
        .join(anywhere, on=["frame", source], how="left", suffix="_anywhere", maintain_order="left")
        .with_columns(pl.coalesce("named", "named_anywhere", _none_if_zero(source)).cast(pl.Int32).alias(f"{role}_id"))
        .drop("named", "named_anywhere")
    )
