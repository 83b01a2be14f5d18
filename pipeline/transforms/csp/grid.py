"""The 13 x 3 grid, as convolutional social pooling's script fills it or with collisions resolved."""

from collections.abc import Iterator

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries
from tracklake.pipeline.transforms.csp.parts import Parts
from tracklake.pipeline.transforms.resample import join_key
from tracklake.pipeline.transforms.samples.neighbors import find_neighbors
from tracklake.schemas.arrays import Flags, Integers, Singles
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.samples import CELLS

ROWS = 13
"""Cells in a column of the grid."""
REACH_FT = np.float32(90)
"""Distance along the road within which vehicles are neighbors, in ft."""
CELL_FT = np.float32(15)
"""Length of a cell, in ft."""
COLUMNS = (-1, 0, 1)
"""Lanes of the grid's columns, relative to the own lane: left, own, right."""
CHUNK_ROWS = 1 << 14
"""Origins whose grids are filled at once; their arrays stay in the processor's cache."""
Rows = NDArray[np.int32]


class OverwritingGrid:
    """The script's grid, in which later rows overwrite earlier ones.

    The entries of a subset are sorted by frame, lane and position, so that an origin's neighbors are next to it.

    Raises:
        TracklakeError: frames and lanes do not fit 31 bits.
    """

    def __init__(self, entries: CspEntries) -> None:
        self.overwritten = 0
        """Neighbors that a later row of the same cell overwrote, in all grids filled so far."""
        self._id = np.append(entries.track_id, 0).astype(np.float32)  # the last stands for none
        self._y_ft = entries.y_ft + np.float32(0)  # turns -0 into 0
        self._group = _group_by_lane(entries)
        key = (self._group.astype(np.int64) << 32) | _rank_singles(self._y_ft)
        order = np.argsort(key)
        key = key[order]
        one_lane = np.int64(1) << 32
        # One more element of no group at either end, so that a walk along a lane always ends.
        self._sorted_group = np.concatenate(([-9], self._group[order], [-9])).astype(np.int32)
        self._sorted_y_ft = np.concatenate(([0], self._y_ft[order], [0])).astype(np.float32)
        self._sorted_row = np.concatenate(([-1], order, [-1])).astype(np.int32)
        position = np.empty(order.size, np.int32)
        position[order] = np.arange(1, order.size + 1, dtype=np.int32)
        starts = []
        for lane in COLUMNS:
            first = np.empty(order.size, np.int32)
            first[order] = np.searchsorted(key, key + lane * one_lane) + 1
            starts.append(position if lane == 0 else first)
        self._starts = tuple(starts)

    def fill_grids(self, origins: Integers) -> Singles:
        """Fill the grids of (B,) origin rows with the ids of neighbors, (B, 39), 0 = none.

        As in preprocess_data.m, 'Get grid locations': a neighbor has an entry in the same frame, in lane - 1, lane or
        lane + 1, with abs(dy) < 90 ft, and with dy other than 0 in the own lane. Its cell is
        13 * column + round((dy + 90) / 15), halves away from zero, in single precision. If several share a cell, the
        last row of the file, that of the highest id, fills it.
        """
        ids = np.empty((origins.size, CELLS), np.float32)
        for start in range(0, origins.size, CHUNK_ROWS):
            chunk = slice(start, start + CHUNK_ROWS)
            ids[chunk] = self._id[self._find_rows(origins[chunk])].reshape(-1, CELLS)
        return ids

    def _find_rows(self, origins: Integers) -> Rows:
        """Find the rows of the neighbors, (B * 39,), -1 = none."""
        grid = np.full(origins.size * CELLS, -1, np.int32)
        own = self._group[origins]
        y_ft = self._y_ft[origins]
        for column, lane in enumerate(COLUMNS):
            start = self._starts[column][origins]
            for step, first in ((1, start + (lane == 0)), (-1, start - 1)):
                for origin, other, dy in self._walk_lane(own + np.int32(lane), y_ft, first, step):
                    # Double precision, since in single precision adding a half rounds 0.49999997 up to 1.
                    steps = np.floor(((dy + REACH_FT) / CELL_FT).astype(np.float64) + 0.5).astype(np.int64)
                    cell = origin * CELLS + (column * ROWS + steps)
                    if lane == 0:
                        apart = dy != 0
                        cell, other = cell[apart], other[apart]
                    earlier = grid[cell]
                    self.overwritten += int((earlier >= 0).sum())
                    grid[cell] = np.maximum(earlier, self._sorted_row[other])
        return grid

    def _walk_lane(
        self, target: Rows, y_ft: Singles, first: Rows, step: int
    ) -> Iterator[tuple[Integers, Rows, Singles]]:
        """Walk from each origin along a lane, one vehicle per step, until no origin has another within reach.

        Yields the index of the origin in target, the position of the neighbor in the sorted arrays, and its dy.
        """
        origin, other = np.arange(target.size), first
        while origin.size:
            dy = self._sorted_y_ft[other] - y_ft[origin]
            near = (self._sorted_group[other] == target[origin]) & (np.abs(dy) < REACH_FT)
            origin, other, dy = origin[near], other[near], dy[near]
            yield origin, other, dy
            other = other + np.int32(step)


class ResolvedGrid:
    """The lake's grid, in which the nearest vehicle keeps a shared cell and the others move to the nearest free one.

    `positions` have track_id, tick, x_m, lane of one subset, sorted by the first two; (N,) `kept` are origins whose
    grids can be filled; only rows of one (N,) part are neighbors.
    """

    def __init__(self, positions: pl.DataFrame, kept: Flags, part: Parts) -> None:
        self.collisions, self.crowded_out = 0, 0
        origins, cells, ids = [np.zeros(0, np.int64)], [np.zeros(0, np.int8)], [np.zeros(0, np.int32)]
        for code in np.unique(part):
            inside = part == code
            clock = positions.filter(inside).rename({"track_id": "vehicle_id"})
            found = find_neighbors(clock, kept[inside])
            origins.append(_find_origins(found.neighbors, clock, np.flatnonzero(inside)))
            cells.append(found.neighbors["cell"].to_numpy())
            ids.append(found.neighbors["neighbor_id"].to_numpy())
            self.collisions += found.collisions
            self.crowded_out += found.crowded_out
        origin = np.concatenate(origins)
        order = np.argsort(origin, kind="stable")
        self._origin, self._cell = origin[order], np.concatenate(cells)[order]
        self._id = np.concatenate(ids)[order].astype(np.float32)

    def fill_grids(self, origins: Integers) -> Singles:
        """Fill the grids of (B,) increasing rows among those kept with ids of neighbors, (B, 39), 0 = none."""
        grids = np.zeros((origins.size, CELLS), np.float32)
        if origins.size:
            begin, end = np.searchsorted(self._origin, (origins[0], origins[-1] + 1))
            index = np.searchsorted(origins, self._origin[begin:end])
            wanted = origins[index] == self._origin[begin:end]
            grids[index[wanted], self._cell[begin:end][wanted]] = self._id[begin:end][wanted]
        return grids


def _find_origins(neighbors: pl.DataFrame, clock: pl.DataFrame, rows: Integers) -> Integers:
    """Find the row of each neighbor's origin, (M,), among the (N,) rows of a clock's sorted entries."""
    origin_key, clock_key = (
        join_key(frame["vehicle_id"].to_numpy(), frame["tick"].to_numpy()) for frame in (neighbors, clock)
    )
    begins = np.diff(origin_key, prepend=-1) != 0
    found: Integers = rows[np.searchsorted(clock_key, origin_key[begins])][np.cumsum(begins) - 1]
    return found


def _group_by_lane(entries: CspEntries) -> NDArray[np.int32]:
    """Number each (frame, lane): adjacent lanes of a frame have adjacent numbers, lanes of two frames never."""
    if not entries.height:
        return np.zeros(0, np.int32)
    frame, lane = entries.frame.astype(np.int64), entries.lane.astype(np.int64)
    lanes = int(lane.max() - lane.min()) + 2
    group = (frame - frame.min()) * lanes + (lane - lane.min())
    if int(group.max()) >= (1 << 31) - 2:
        raise TracklakeError(
            f"frames {frame.min()} to {frame.max()} and lanes {lane.min()} to {lane.max()} are too wide a span to "
            "search for neighbors; correct this recording, or leave it out"
        )
    return np.asarray(group, np.int32)


def _rank_singles(values: Singles) -> Integers:
    """Map singles (none of them -0) to 32-bit whole numbers of the same order."""
    bits = values.view(np.uint32).astype(np.int64)
    return np.where(bits < 1 << 31, bits + (1 << 31), (1 << 32) - 1 - bits)
