"""The 13 x 3 grid: as convolutional social pooling's script fills it, and with collisions resolved."""

from collections.abc import Iterator

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries, Ints, Singles
from tracklake.pipeline.transforms.csp.parts import Parts
from tracklake.pipeline.transforms.samples.neighbors import find_neighbors
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.samples import CELLS

ROWS = 13
REACH_FT = np.float32(90)
CELL_FT = np.float32(15)
COLUMNS = (-1, 0, 1)
"""The left, the own and the right lane, by number."""
CHUNK_ROWS = 1 << 14
"""Origins whose grids are filled at a time, so that these stay in the processor's cache."""

Rows = NDArray[np.int32]


class OverwritingGrid:
    """The script's: later rows overwrite earlier ones.

    All entries of a subset stand sorted by frame, lane and place, so that an origin's neighbors stand beside it.

    Args:
        entries: of one subset.

    Raises:
        TracklakeError: frames and lanes span more than 31 bits hold.
    """

    def __init__(self, entries: CspEntries) -> None:
        self.overwritten = 0
        """Neighbors that a later row of the same cell overwrote, around the origins asked for so far."""
        self._id = np.append(entries.track_id, 0).astype(np.float32)  # the last is nobody's
        self._y_ft = entries.y_ft + np.float32(0)  # -0 becomes 0, and sorts where 0 does
        self._group = _group_by_lane(entries)
        key = (self._group.astype(np.int64) << 32) | _ordered(self._y_ft)
        order = np.argsort(key)
        key = key[order]
        one_lane = np.int64(1) << 32
        # One place more at either end, of no group, so that a walk along a lane always ends.
        self._there = np.concatenate(([-9], self._group[order], [-9])).astype(np.int32)
        self._there_y_ft = np.concatenate(([0], self._y_ft[order], [0])).astype(np.float32)
        self._there_row = np.concatenate(([-1], order, [-1])).astype(np.int32)
        place = np.empty(order.size, np.int32)
        place[order] = np.arange(1, order.size + 1, dtype=np.int32)
        starts = []
        for lane in COLUMNS:
            first = np.empty(order.size, np.int32)
            first[order] = np.searchsorted(key, key + lane * one_lane) + 1
            starts.append(place if lane == 0 else first)
        self._starts = tuple(starts)

    def fill(self, origins: Ints) -> Singles:
        """Fill the grids of some origins (preprocess_data.m, 'Get grid locations').

        A neighbor has an entry in the same frame, in lane - 1, lane or lane + 1, with abs(dy) < 90 ft; in the own lane
        dy is not 0 either. It stands in cell 13 * column + round((dy + 90) / 15), halves away from zero, single
        precision. Of several in one cell the last row of the file, which is that of the highest id, is there.

        Args:
            origins: (B,) rows.

        Returns:
            (B, 39) ids of the neighbors, 0 = nobody.
        """
        ids = np.empty((origins.size, CELLS), np.float32)
        for start in range(0, origins.size, CHUNK_ROWS):
            chunk = slice(start, start + CHUNK_ROWS)
            ids[chunk] = self._id[self._find_rows(origins[chunk])].reshape(-1, CELLS)
        return ids

    def _find_rows(self, origins: Ints) -> Rows:
        """(B * 39,) rows of the neighbors, -1 = nobody."""
        grid = np.full(origins.size * CELLS, -1, np.int32)
        own = self._group[origins]
        y_ft = self._y_ft[origins]
        for column, lane in enumerate(COLUMNS):
            start = self._starts[column][origins]
            for step, first in ((1, start + (lane == 0)), (-1, start - 1)):
                for origin, other, dy in self._walk(own + np.int32(lane), y_ft, first, step):
                    # In double precision, where adding a half does not round 0.49999997 up to 1.
                    steps = np.floor(((dy + REACH_FT) / CELL_FT).astype(np.float64) + 0.5).astype(np.int64)
                    cell = origin * CELLS + (column * ROWS + steps)
                    if lane == 0:
                        apart = dy != 0
                        cell, other = cell[apart], other[apart]
                    earlier = grid[cell]
                    self.overwritten += int((earlier >= 0).sum())
                    grid[cell] = np.maximum(earlier, self._there_row[other])
        return grid

    def _walk(self, target: Rows, y_ft: Singles, first: Rows, step: int) -> Iterator[tuple[Ints, Rows, Singles]]:
        """Walk from each origin along a lane, one vehicle at a time, until nobody has another one within reach.

        Yields:
            origin (index into target), place of the other, its dy.
        """
        origin, other = np.arange(target.size), first
        while origin.size:
            dy = self._there_y_ft[other] - y_ft[origin]
            near = (self._there[other] == target[origin]) & (np.abs(dy) < REACH_FT)
            origin, other, dy = origin[near], other[near], dy[near]
            yield origin, other, dy
            other = other + np.int32(step)


class ResolvedGrid:
    """The lake's: of several in one cell the nearest keeps it, the others move to the nearest free one.

    Args:
        positions: track_id, tick, x_m, lane of one subset, sorted by track_id, tick.
        kept: (N,) the origins that will be asked for.
        part: (N,) those of other parts are nobody's neighbors.
    """

    def __init__(self, positions: pl.DataFrame, kept: NDArray[np.bool_], part: Parts) -> None:
        self.collisions, self.crowded_out = 0, 0
        origins, cells, ids = [np.zeros(0, np.int64)], [np.zeros(0, np.int8)], [np.zeros(0, np.int32)]
        for code in np.unique(part):
            mine = part == code
            clock = positions.filter(mine).rename({"track_id": "vehicle_id"})
            around = find_neighbors(clock, kept[mine])
            origins.append(_find_origins(around.neighbors, clock, np.flatnonzero(mine)))
            cells.append(around.neighbors["cell"].to_numpy())
            ids.append(around.neighbors["neighbor_id"].to_numpy())
            self.collisions += around.collisions
            self.crowded_out += around.crowded_out
        origin = np.concatenate(origins)
        order = np.argsort(origin, kind="stable")
        self._origin, self._cell = origin[order], np.concatenate(cells)[order]
        self._id = np.concatenate(ids)[order].astype(np.float32)

    def fill(self, origins: Ints) -> Singles:
        """Fill the grids of some origins (`pipeline.transforms.samples.neighbors`).

        Args:
            origins: (B,) rows, increasing, of those kept; others may lie between them.

        Returns:
            (B, 39) ids of the neighbors, 0 = nobody.
        """
        grids = np.zeros((origins.size, CELLS), np.float32)
        if origins.size:
            begin, end = np.searchsorted(self._origin, (origins[0], origins[-1] + 1))
            place = np.searchsorted(origins, self._origin[begin:end])
            asked = origins[place] == self._origin[begin:end]
            grids[place[asked], self._cell[begin:end][asked]] = self._id[begin:end][asked]
        return grids


def _find_origins(neighbors: pl.DataFrame, clock: pl.DataFrame, rows: Ints) -> Ints:
    """(M,) the row of each neighbor's origin.

    Args:
        neighbors: vehicle_id, tick: the origin; those of one origin stand together.
        clock: vehicle_id, tick, sorted.
        rows: (N,) of the clock's entries.
    """
    there, here = (
        (frame["vehicle_id"].to_numpy().astype(np.int64) << 32) | frame["tick"].to_numpy()
        for frame in (neighbors, clock)
    )
    begins = np.diff(there, prepend=-1) != 0
    found: Ints = rows[np.searchsorted(here, there[begins])][np.cumsum(begins) - 1]
    return found


def _group_by_lane(entries: CspEntries) -> NDArray[np.int32]:
    """One number per (frame, lane): neighbouring lanes have neighbouring numbers, those of two frames never."""
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


def _ordered(values: Singles) -> Ints:
    """Whole numbers of 32 bits in the order of the values (none of them -0)."""
    bits = values.view(np.uint32).astype(np.int64)
    return np.where(bits < 1 << 31, bits + (1 << 31), (1 << 32) - 1 - bits)
