"""Subsets cut into blocks of time with a purge between them, for lakes of few recordings.

No history, future or neighbor crosses a block's border. A vehicle may be on the road in two blocks; if these are in
different parts, it is left out of val and eval and listed.
"""

import polars as pl

from tracklake.schemas.columns import PARTS
from tracklake.schemas.splits import SPLIT_LEFT_OUT

_BLOCK: dict[str, pl.DataType | type[pl.DataType]] = {"dataset": pl.String, "subset": pl.String, "block": pl.Int32}
BLOCKS = {**_BLOCK, "first_frame": pl.Int32, "last_frame": pl.Int32}
"""Columns of `cut_blocks`."""
VISITS = {**_BLOCK, "vehicle_id": pl.Int32, "entries": pl.Int64}
"""Columns of `find_visits`."""
WEIGHTS = {**_BLOCK, "vehicle_id": pl.Int32, "weight": pl.Int64}
"""Columns of `count_samples`."""
ROUNDING_FRAMES = 1e-6
"""Tolerance of frame numbers, since positions between frames are floating-point."""


def cut_blocks(subsets: pl.DataFrame, *, block_s: float, purge_s: float) -> pl.DataFrame:
    """Cut each subset into blocks with at least `purge_s` between the last entry of one and the first of the next.

    All blocks last `block_s` except the last one, which ends with the subset: the rest after the last whole block is a
    block of its own if, after the purge, at least half a block is left; else it extends the last whole block. A subset
    shorter than a block is one block.

    `subsets` have dataset, subset, first_frame, last_frame, frame_rate_hz. Returns a row per block, sorted by BLOCKS.
    """
    block = (block_s * pl.col("frame_rate_hz") - ROUNDING_FRAMES).ceil().cast(pl.Int64)
    purge = (purge_s * pl.col("frame_rate_hz") - ROUNDING_FRAMES).ceil().cast(pl.Int64)
    length = pl.col("last_frame").cast(pl.Int64) - pl.col("first_frame") + 1
    whole = (length + purge) // (block + purge)
    left = length - whole * (block + purge)
    start = pl.col("first_frame").cast(pl.Int64) + pl.col("block") * (block + purge)
    is_last = pl.col("block") == pl.col("blocks") - 1
    return (
        subsets.with_columns(blocks=pl.max_horizontal(whole + (2 * left >= block).cast(pl.Int64), 1))
        .with_columns(block=pl.int_ranges(0, pl.col("blocks")))
        .explode("block", empty_as_null=False)
        .with_columns(
            first_frame=start,
            last_frame=pl.when(is_last).then(pl.col("last_frame").cast(pl.Int64)).otherwise(start + block - 1),
        )
        .select(pl.col(name).cast(dtype) for name, dtype in BLOCKS.items())
        .sort("dataset", "subset", "block")
    )


def find_visits(entries: pl.DataFrame, blocks: pl.DataFrame) -> pl.DataFrame:
    """Count the entries (vehicle_id, frame) of each vehicle in each block of one subset, VISITS sorted by key."""
    return (
        entries.select(pl.col("vehicle_id"), pl.col("frame").cast(pl.Int32))
        .sort("frame")
        .join_asof(blocks.sort("first_frame"), left_on="frame", right_on="first_frame", strategy="backward")
        .filter(pl.col("frame") <= pl.col("last_frame"))
        .group_by("dataset", "subset", "block", "vehicle_id")
        .agg(entries=pl.len())
        .select(pl.col(name).cast(dtype) for name, dtype in VISITS.items())
        .sort("dataset", "subset", "block", "vehicle_id")
    )


def count_samples(
    samples: pl.DataFrame, blocks: pl.DataFrame, *, stride: float, first_frame: int, history: float, future: float
) -> pl.DataFrame:
    """Count each vehicle's samples in each block that holds their history and least future, WEIGHTS sorted by key.

    `samples` have vehicle_id and tick of one subset; `stride` source frames make a tick, and tick 0 is at
    `first_frame`. History and least future are in source frames.
    """
    at = first_frame + pl.col("tick") * stride
    return (
        samples.select("vehicle_id", begins=at - history + ROUNDING_FRAMES, ends=at + future - ROUNDING_FRAMES)
        .sort("begins")
        .join_asof(
            blocks.with_columns(pl.col("first_frame").cast(pl.Float64)).sort("first_frame"),
            left_on="begins",
            right_on="first_frame",
            strategy="backward",
        )
        .filter(pl.col("ends") <= pl.col("last_frame"))
        .group_by("dataset", "subset", "block", "vehicle_id")
        .agg(weight=pl.len())
        .select(pl.col(name).cast(dtype) for name, dtype in WEIGHTS.items())
        .sort("dataset", "subset", "block", "vehicle_id")
    )


def describe_blocks(
    blocks: pl.DataFrame, subsets: pl.DataFrame, visits: pl.DataFrame, weights: pl.DataFrame
) -> pl.DataFrame:
    """Describe each block for the allocation: the columns of `splits.tables.COLUMNS` and `block`.

    `vehicles_per_lane_s` is the block's own: vehicles with an entry in it / lanes / its length in s.

    `subsets` have dataset, subset, site, direction, lanes, frame_rate_hz; visits and weights are those of all subsets.
    """
    key = ["dataset", "subset", "block"]
    seconds = (pl.col("last_frame") - pl.col("first_frame") + 1) / pl.col("frame_rate_hz")
    return (
        blocks.join(
            subsets.select("dataset", "subset", "site", "direction", "lanes", "frame_rate_hz"), on=["dataset", "subset"]
        )
        .pipe(_add_counts, visits, weights)
        .with_columns(vehicles_per_lane_s=pl.col("vehicles") / pl.col("lanes") / seconds)
        .drop("lanes", "frame_rate_hz")
        .sort(key)
    )


def _add_counts(units: pl.DataFrame, visits: pl.DataFrame, weights: pl.DataFrame) -> pl.DataFrame:
    key = list(_BLOCK)
    counts = visits.group_by(key).agg(vehicles=pl.len().cast(pl.Int64))
    counted = units.join(counts, on=key, how="left")
    counted = counted.join(weights.group_by(key).agg(pl.col("weight").sum()), on=key, how="left")
    return counted.with_columns(pl.col("vehicles", "weight").fill_null(0))


def find_left_out(visits: pl.DataFrame, splits: pl.DataFrame) -> pl.DataFrame:
    """Find the vehicles that have entries in two parts, as rows of `schemas.splits.SPLIT_LEFT_OUT`.

    A vehicle in train and another part stays in train; one in val and eval is left out of both.

    From `find_visits` of all subsets, and the rows of SPLITS of one split, whose blocks are those of the visits.
    """
    elsewhere = pl.col("entries").filter(pl.col("part") != PARTS[0]).sum()
    return (
        visits.join(splits.select("split", "dataset", "subset", "block", "part"), on=["dataset", "subset", "block"])
        .group_by("split", "dataset", "subset", "vehicle_id")
        .agg(
            parts=pl.col("part").unique().sort_by(pl.col("part").unique().replace_strict(list(PARTS), range(3))),
            entries=elsewhere,
        )
        .filter(pl.col("parts").list.len() > 1)
        .with_columns(pl.col("parts").list.join(", "))
        .select(pl.col(name).cast(dtype) for name, dtype in SPLIT_LEFT_OUT.dtypes.items())
        .sort(SPLIT_LEFT_OUT.key)
    )


def recount_blocks(
    units: pl.DataFrame, splits: pl.DataFrame, left_out: pl.DataFrame, visits: pl.DataFrame, weights: pl.DataFrame
) -> pl.DataFrame:
    """Add `part` to the units, and count their vehicles and samples again without vehicles that are left out.

    A vehicle counts in the first of its blocks in a part, so that sums over blocks count none twice.

    `units` are rows of `describe_blocks`, `splits` of SPLITS (one per block), `left_out` of `find_left_out`; visits and
    weights are those of all subsets.
    """
    vehicle, key = ["dataset", "subset", "vehicle_id"], ["dataset", "subset", "block"]
    parts = splits.select(*key, "part")
    removed = left_out.select(*vehicle, removed=True)

    def drop_removed(counted: pl.DataFrame) -> pl.DataFrame:
        known = counted.join(parts, on=key).join(removed, on=vehicle, how="left")
        return known.filter((pl.col("part") == PARTS[0]) | pl.col("removed").is_null())

    present = drop_removed(visits).group_by(*vehicle, "part").agg(pl.col("block").min())
    return (
        units.drop("vehicles", "weight").join(parts, on=key).pipe(_add_counts, present, drop_removed(weights)).sort(key)
    )
