"""Subsets cut into blocks of time with a purge between them, for lakes of few recordings.

No history, future or neighbor crosses a block's border. A vehicle may still be on the road in two blocks; where these
stand in different parts it gives nothing to val and eval, and is listed.
"""

import polars as pl

from tracklake.schemas.columns import PARTS
from tracklake.schemas.splits import SPLIT_LEFT_OUT

BLOCKS: dict[str, pl.DataType | type[pl.DataType]] = {
    "dataset": pl.String,
    "subset": pl.String,
    "block": pl.Int32,
    "first_frame": pl.Int32,
    "last_frame": pl.Int32,
}
"""What `cut_blocks` returns."""

VISITS: dict[str, pl.DataType | type[pl.DataType]] = {
    "dataset": pl.String,
    "subset": pl.String,
    "block": pl.Int32,
    "vehicle_id": pl.Int32,
    "entries": pl.Int64,
}
"""What `find_visits` returns."""

WEIGHTS: dict[str, pl.DataType | type[pl.DataType]] = {
    "dataset": pl.String,
    "subset": pl.String,
    "block": pl.Int32,
    "vehicle_id": pl.Int32,
    "weight": pl.Int64,
}
"""What `count_samples` returns."""

SMALLEST = 1e-6
"""Of a frame: positions between frames are floating-point."""


def cut_blocks(subsets: pl.DataFrame, *, block_s: float, purge_s: float) -> pl.DataFrame:
    """Cut each subset into blocks with at least `purge_s` between the last entry of one and the first of the next.

    All blocks last `block_s` but the last one, which ends with the subset: what remains after the last whole block is a
    block of its own where, after the purge, at least half a block is left; else the last whole block is the longer. A
    subset shorter than a block is one.

    Args:
        subsets: dataset, subset, first_frame, last_frame, frame_rate_hz.
        block_s: length of a block, above 0.
        purge_s: between two.

    Returns:
        One row per block, the columns of `BLOCKS`, sorted by them.
    """
    block = (block_s * pl.col("frame_rate_hz") - SMALLEST).ceil().cast(pl.Int64)
    purge = (purge_s * pl.col("frame_rate_hz") - SMALLEST).ceil().cast(pl.Int64)
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
    """Count the entries of every vehicle in every block in which it has any.

    Args:
        entries: vehicle_id and frame of one subset, in any order.
        blocks: its rows of `cut_blocks`.

    Returns:
        The columns of `VISITS`, sorted by them.
    """
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
    """Count the samples of every vehicle in every block whose history and least future lie within it.

    Args:
        samples: vehicle_id and tick of one subset's samples.
        blocks: its rows of `cut_blocks`.
        stride: source frames per tick.
        first_frame: where tick 0 lies.
        history: what a sample needs before it, in source frames.
        future: what it needs after it, likewise.

    Returns:
        The columns of `WEIGHTS`, sorted by them; blocks without samples are not there.
    """
    at = first_frame + pl.col("tick") * stride
    return (
        samples.select("vehicle_id", begins=at - history + SMALLEST, ends=at + future - SMALLEST)
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
    """Put together what the allocation needs to know of each block.

    Args:
        blocks: of `cut_blocks`.
        subsets: dataset, subset, site, direction, lanes, frame_rate_hz.
        visits: of `find_visits`, of all subsets.
        weights: of `count_samples`, of all subsets.

    Returns:
        One row per block: the columns of `split_tables.COLUMNS` and `block`. Flow is that of the block alone: vehicles
        with an entry in it / lanes / its length in s.
    """
    key = ["dataset", "subset", "block"]
    seconds = (pl.col("last_frame") - pl.col("first_frame") + 1) / pl.col("frame_rate_hz")
    return (
        blocks.join(
            subsets.select("dataset", "subset", "site", "direction", "lanes", "frame_rate_hz"), on=["dataset", "subset"]
        )
        .join(visits.group_by(key).agg(vehicles=pl.len().cast(pl.Int64)), on=key, how="left")
        .join(weights.group_by(key).agg(pl.col("weight").sum()), on=key, how="left")
        .with_columns(pl.col("vehicles", "weight").fill_null(0))
        .with_columns(flow=pl.col("vehicles") / pl.col("lanes") / seconds)
        .drop("lanes", "frame_rate_hz")
        .sort(key)
    )


def find_left_out(visits: pl.DataFrame, splits: pl.DataFrame) -> pl.DataFrame:
    """Find the vehicles that have entries in two parts.

    Args:
        visits: of `find_visits`, of all subsets.
        splits: rows of `schemas.splits.SPLITS` of one split, in whose blocks the visits were counted.

    Returns:
        Rows of `schemas.splits.SPLIT_LEFT_OUT`. A vehicle in train and another part stays in train; one in val and eval
        goes into neither.
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
    """Count what each block gives to its part once vehicles are left out.

    Args:
        units: of `describe_blocks`.
        splits: rows of `schemas.splits.SPLITS` of one split, one per block.
        left_out: of `find_left_out`, of this split.
        visits: of `find_visits`, of all subsets.
        weights: of `count_samples`, of all subsets.

    Returns:
        `units` with `part`, and both counts anew: weight, the samples without those of vehicles left out of the part;
        vehicles, those that give entries to the part, each in its first block there, so that sums over blocks count
        none twice.
    """
    vehicle, key = ["dataset", "subset", "vehicle_id"], ["dataset", "subset", "block"]
    parts = splits.select(*key, "part")
    gone = left_out.select(*vehicle, gone=True)

    def stay(counted: pl.DataFrame) -> pl.DataFrame:
        known = counted.join(parts, on=key).join(gone, on=vehicle, how="left")
        return known.filter((pl.col("part") == PARTS[0]) | pl.col("gone").is_null())

    present = stay(visits).group_by(*vehicle, "part").agg(pl.col("block").min())
    return (
        units.drop("vehicles", "weight")
        .join(parts, on=key)
        .join(present.group_by(key).agg(vehicles=pl.len().cast(pl.Int64)), on=key, how="left")
        .join(stay(weights).group_by(key).agg(pl.col("weight").sum()), on=key, how="left")
        .with_columns(pl.col("vehicles", "weight").fill_null(0))
        .sort(key)
    )
