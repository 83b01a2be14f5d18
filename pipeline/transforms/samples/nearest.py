"""The k nearest vehicles of the whole scene, in any lane and without a grid."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tracklake.pipeline.transforms.resample import cut_runs, join_key
from tracklake.pipeline.transforms.samples.neighbors import UNITS_PER_M
from tracklake.pipeline.transforms.samples.threads import map_in_threads
from tracklake.schemas.arrays import Flags, Floats, Integers

BLOCK_ROWS = 1 << 13
"""Entries searched at once, in whole ticks; their arrays stay in the processor's cache."""
NO_VEHICLE = np.iinfo(np.int64).max
"""Key that sorts after every vehicle's."""


@dataclass(frozen=True)
class _Block:
    """The entries of some whole ticks, (E,) each, sorted by tick and x.

    Positions are in whole units.

    Args:
        rank: number of vehicles of the tick with a smaller id.
        first: index of the tick's first vehicle in `vehicle_id`.
        vehicle_id: vehicles sorted by tick and id; a vehicle's index is its tick's first plus its rank.
    """

    tick: NDArray[np.int32]
    x: Floats
    y: Floats
    rank: Integers
    first: Integers
    vehicle_id: NDArray[np.int32]
    row: NDArray[np.int32]


def find_nearest(clock: pl.DataFrame, k: int, origins: Flags | None = None) -> pl.Series:
    """Find the k >= 1 nearest vehicles around each origin, the nearest first (DESIGN section 7).

    The distance is sqrt(dx^2 + dy^2) between front centres at the same tick, in any lane or none; of two equally near
    vehicles the one with the smaller id comes first. Positions are compared to a tenth of a micrometre, distances to a
    billionth of a metre. If fewer than k other vehicles are on the road, all of them are listed.

    The clock has vehicle_id, tick, x_m, y_m: one row per (vehicle, tick), in any order. `origins` are (N,) flags, None
    = all; every row can be a neighbor. Returns `nearest`, a list of vehicle ids (Int32) per origin, in the order of
    their rows.
    """
    if k < 1:
        raise ValueError(f"cannot list the {k} nearest: expected at least 1")
    wanted = np.ones(clock.height, np.bool_) if origins is None else origins
    number = np.cumsum(wanted, dtype=np.int32) - np.int32(1)
    nearest = np.full((int(wanted.sum()), k), -1, np.int32)
    x_m, y_m = clock["x_m"].to_numpy(), clock["y_m"].to_numpy()
    vehicle_id, tick = clock["vehicle_id"].to_numpy(), clock["tick"].to_numpy()
    order = np.argsort(join_key(tick, vehicle_id)).astype(np.int32)

    def search_block(bounds: tuple[int, int]) -> None:
        row = order[slice(*bounds)]
        block = _build_block(row, x_m[row], y_m[row], vehicle_id[row], tick[row])
        rows = np.flatnonzero(wanted[block.row])
        nearest[number[block.row[rows]]] = _choose_nearest(block, rows, k)

    map_in_threads(search_block, cut_runs(tick[order], BLOCK_ROWS))
    every = range(0, len(nearest), BLOCK_ROWS) if len(nearest) else (0,)
    return pl.concat([_to_lists(nearest[start : start + BLOCK_ROWS]) for start in every])


def _to_lists(nearest: NDArray[np.int32]) -> pl.Series:
    """Turn (S, k) ids into lists without the -1 at their ends."""
    lists = pl.Series("nearest", nearest).arr.to_list()
    if (nearest[:, -1] >= 0).all():
        return lists
    found = pl.Series("found", (nearest >= 0).sum(axis=1))
    return pl.DataFrame((lists, found)).select(pl.col("nearest").list.head("found")).to_series()


def _build_block(
    row: NDArray[np.int32], x_m: Floats, y_m: Floats, vehicle_id: NDArray[np.int32], tick: NDArray[np.int32]
) -> _Block:
    """Build the block of (E,) entries that are sorted by tick and id."""
    first = np.maximum.accumulate(np.where(np.diff(tick, prepend=-1), np.arange(row.size), 0))
    x, y = np.rint(x_m * UNITS_PER_M), np.rint(y_m * UNITS_PER_M)
    by_x = np.argsort(first * (int(x.max() - x.min()) + 1) + (x - x.min()).astype(np.int64))
    rank = np.arange(row.size) - first
    return _Block(tick[by_x], x[by_x], y[by_x], rank[by_x], first[by_x], vehicle_id, row[by_x])


def _choose_nearest(block: _Block, rows: Integers, k: int) -> NDArray[np.int32]:
    """Choose the (B, k) ids of the nearest to (B,) rows of a block; -1 = none.

    Compares the k entries behind (by x) and the k ahead, and twice as many again for origins around which an entry
    farther along the road could still be nearer than the last one chosen.
    """
    chosen = np.full((rows.size, k), -1, np.int32)
    unsure, width = np.arange(rows.size), k
    while unsure.size:
        own = rows[unsure]
        keys, beyond = _compute_keys(block, own, width)
        keys.sort(axis=1)
        keys = keys[:, :k]
        known = keys < NO_VEHICLE
        rank = (keys & _mask_ranks(block))[known]
        at = np.broadcast_to(block.first[own, None], keys.shape)[known] + rank
        found = np.full(keys.shape, -1, np.int32)
        found[known] = block.vehicle_id[at]
        chosen[unsure] = found
        unsure, width = unsure[(beyond <= keys[:, -1]) & (beyond < NO_VEHICLE)], 2 * width
    return chosen


def _mask_ranks(block: _Block) -> int:
    """Return the mask of the low bits that hold a rank."""
    return (1 << int(block.rank.max()).bit_length()) - 1


def _compute_keys(block: _Block, own: Integers, width: int) -> tuple[Integers, Integers]:
    """Compute numbers that sort the entries next to each origin by distance and id.

    The bits of a non-negative float sort as the float does; the lowest bits of the squared distance are replaced by
    the id's rank.

    Returns (B, 2 * width + 1) keys of the entries from `width` behind to `width` ahead, and (B,) a lower bound of the
    keys of entries farther behind or ahead, NO_VEHICLE if there are none.
    """
    rank_mask = _mask_ranks(block)
    squared = _gather_windows(block.x, own, width)
    squared -= block.x[own, None]
    squared *= squared
    edges = squared[:, [0, -1]].view(np.int64) & ~rank_mask
    across = _gather_windows(block.y, own, width)
    across -= block.y[own, None]
    across *= across
    squared += across
    keys: Integers = squared.view(np.int64)
    keys &= ~rank_mask
    keys |= _gather_windows(block.rank, own, width)
    absent = _gather_windows(block.tick, own, width) != block.tick[own, None]
    keys[absent] = NO_VEHICLE
    keys[:, width] = NO_VEHICLE  # the origin itself
    edges[absent[:, [0, -1]]] = NO_VEHICLE
    return keys, edges.min(axis=1)


def _gather_windows(values: NDArray[Any], own: Integers, width: int) -> NDArray[Any]:
    """Gather the (B, 2 * width + 1) values around (B,) indices."""
    return sliding_window_view(np.pad(values, width, constant_values=-1), 2 * width + 1)[own]
