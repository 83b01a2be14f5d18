"""Who is nearest to a vehicle: the k nearest of the whole scene, whatever their lanes, with nobody lost to a grid."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tracklake.pipeline.transforms.resample import cut_runs
from tracklake.pipeline.transforms.samples.neighbors import UNITS_PER_M
from tracklake.pipeline.transforms.samples.threads import map_in_threads

BLOCK_ROWS = 1 << 13
"""Entries looked at together, in whole ticks: what is made of them stays in the processor's cache."""
NOBODY = np.iinfo(np.int64).max

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class _Block:
    """Some whole ticks, by tick and, within a tick, by x."""

    tick: NDArray[np.int32]
    x: Floats
    """(E,) in units, whole numbers; like y."""
    y: Floats
    rank: Ints
    """(E,) how many vehicles of the tick have a smaller id."""
    first: Ints
    """(E,) where in `vehicle_id` the tick's vehicles begin."""
    vehicle_id: NDArray[np.int32]
    """(E,) by tick and id: the one of a rank stands so far after its tick's first."""
    row: NDArray[np.int32]
    """(E,) of the clock."""


def find_nearest(clock: pl.DataFrame, k: int, origins: NDArray[np.bool_] | None = None) -> pl.Series:
    """List the k nearest vehicles around each origin, the nearest first (DESIGN section 7).

    The distance is sqrt(dx^2 + dy^2) between front centres, at the same tick, in any lane or none; of two equally far
    the smaller id comes first. Positions are compared to a tenth of a micrometre, distances to a billionth of a metre.
    A vehicle is not near itself. Where fewer than k others are on the road, all of them are listed.

    Args:
        clock: vehicle_id, tick, x_m, y_m: one row per (vehicle, tick), in any order.
        k: how many, at least 1.
        origins: (N,) rows of the clock whose nearest are wanted; None = all. Every row can be among them.

    Returns:
        `nearest`, a list of vehicle ids (Int32) per origin, in the order of their rows.

    Raises:
        ValueError: k is less than 1.
    """
    if k < 1:
        raise ValueError(f"cannot list the {k} nearest: expected at least 1")
    wanted = np.ones(clock.height, np.bool_) if origins is None else origins
    number = np.cumsum(wanted, dtype=np.int32) - np.int32(1)
    nearest = np.full((int(wanted.sum()), k), -1, np.int32)
    x_m, y_m = clock["x_m"].to_numpy(), clock["y_m"].to_numpy()
    vehicle_id, tick = clock["vehicle_id"].to_numpy(), clock["tick"].to_numpy()
    order = np.argsort((tick.astype(np.int64) << 32) + vehicle_id).astype(np.int32)

    def look_around(bounds: tuple[int, int]) -> None:
        row = order[slice(*bounds)]
        block = _lay_out(row, x_m[row], y_m[row], vehicle_id[row], tick[row])
        rows = np.flatnonzero(wanted[block.row])
        nearest[number[block.row[rows]]] = _choose(block, rows, k)

    map_in_threads(look_around, cut_runs(tick[order], BLOCK_ROWS))
    every = range(0, len(nearest), BLOCK_ROWS) if len(nearest) else (0,)
    return pl.concat([_list(nearest[start : start + BLOCK_ROWS]) for start in every])


def _list(nearest: NDArray[np.int32]) -> pl.Series:
    """(S, k) ids as lists, less the -1 at their ends; where there are none, the array itself, seen as lists."""
    lists = pl.Series("nearest", nearest).arr.to_list()
    if (nearest[:, -1] >= 0).all():
        return lists
    found = pl.Series("found", (nearest >= 0).sum(axis=1))
    return pl.DataFrame((lists, found)).select(pl.col("nearest").list.head("found")).to_series()


def _lay_out(
    row: NDArray[np.int32], x_m: Floats, y_m: Floats, vehicle_id: NDArray[np.int32], tick: NDArray[np.int32]
) -> _Block:
    """The block of (E,) entries that come by tick and id."""
    first = np.maximum.accumulate(np.where(np.diff(tick, prepend=-1), np.arange(row.size), 0))
    x, y = np.rint(x_m * UNITS_PER_M), np.rint(y_m * UNITS_PER_M)
    by_x = np.argsort(first * (int(x.max() - x.min()) + 1) + (x - x.min()).astype(np.int64))
    rank = np.arange(row.size) - first
    return _Block(tick[by_x], x[by_x], y[by_x], rank[by_x], first[by_x], vehicle_id, row[by_x])


def _choose(block: _Block, rows: Ints, k: int) -> NDArray[np.int32]:
    """(B, k) ids of the nearest to (B,) rows of a block; -1 where there is nobody left.

    Compares k entries behind (by x) and k ahead, which mostly hold them all, and twice as many again for those origins
    around which one farther along the road could still be nearer than the last one chosen.
    """
    chosen = np.full((rows.size, k), -1, np.int32)
    unsure, width = np.arange(rows.size), k
    while unsure.size:
        own = rows[unsure]
        keys, beyond = _compare(block, own, width)
        keys.sort(axis=1)
        keys = keys[:, :k]
        known = keys < NOBODY
        rank = (keys & _rank_bits(block))[known]
        at = np.broadcast_to(block.first[own, None], keys.shape)[known] + rank
        found = np.full(keys.shape, -1, np.int32)
        found[known] = block.vehicle_id[at]
        chosen[unsure] = found
        unsure, width = unsure[(beyond <= keys[:, -1]) & (beyond < NOBODY)], 2 * width
    return chosen


def _rank_bits(block: _Block) -> int:
    """A mask of the low bits that hold any rank."""
    return (1 << int(block.rank.max()).bit_length()) - 1


def _compare(block: _Block, own: Ints, width: int) -> tuple[Ints, Ints]:
    """Distances and ids of those next to each origin, as numbers that sort by both.

    The bits of a float that is not negative sort as it does; the lowest of its squared distance give way to the rank
    of the id. NOBODY is farther than anybody.

    Returns:
        (B, 2 * width + 1) of the entries from `width` behind to `width` ahead; (B,) a number that nobody's is under who
        stands farther behind or ahead, NOBODY where nobody does.
    """
    rank_bits = _rank_bits(block)
    squared = _around(block.x, own, width)
    squared -= block.x[own, None]
    squared *= squared
    edges = squared[:, [0, -1]].view(np.int64) & ~rank_bits
    across = _around(block.y, own, width)
    across -= block.y[own, None]
    across *= across
    squared += across
    keys: Ints = squared.view(np.int64)
    keys &= ~rank_bits
    keys |= _around(block.rank, own, width)
    absent = _around(block.tick, own, width) != block.tick[own, None]
    keys[absent] = NOBODY
    keys[:, width] = NOBODY  # itself
    edges[absent[:, [0, -1]]] = NOBODY
    return keys, edges.min(axis=1)


def _around(values: NDArray[Any], own: Ints, width: int) -> NDArray[Any]:
    """(B, 2 * width + 1) values around those at (B,) places."""
    return sliding_window_view(np.pad(values, width, constant_values=-1), 2 * width + 1)[own]
