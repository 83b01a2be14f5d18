"""Neighbors of a vehicle in the 13 x 3 grid, without silent overwriting."""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.samples.threads import map_in_threads
from tracklake.schemas.arrays import Flags, Integers, find_run_starts
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import GRID_CELL_M
from tracklake.schemas.samples import CELLS

ROWS = 13
"""Cells of a column, from behind to ahead; row 6 is alongside."""
COLUMNS = CELLS // ROWS
"""Columns of the grid: lane - 1, lane and lane + 1."""
UNITS_PER_M = 10_000_000
"""Units of position per m. A millimetre and a thousandth of a foot are whole numbers of units, so that 'exclusive' and
'half away from zero' are exact."""
CHUNK_ROWS = 1 << 15
"""Origins whose pairs are made at once; their arrays stay in the processor's cache."""

NEIGHBOR_DTYPES: dict[str, pl.DataType] = {
    "vehicle_id": pl.Int32(),
    "tick": pl.Int32(),
    "cell": pl.Int8(),
    "neighbor_id": pl.Int32(),
    "dx_m": pl.Float32(),
}
"""Columns of neighbors; vehicle_id and tick are the origin's."""


@dataclass(frozen=True)
class Neighborhood:
    """The neighbors of all origins (NEIGHBOR_DTYPES), in the order of the origins' rows and then by cell.

    Args:
        collisions: number of vehicles whose cell is taken by a nearer one; all but `crowded_out` move to another cell.
        crowded_out: number of vehicles dropped since their column has no free cell.
    """

    neighbors: pl.DataFrame
    collisions: int
    crowded_out: int


@dataclass(frozen=True)
class _Line:
    """All entries on one line of integers, on which one comparison tests tick, lane and distance.

    Each (tick, lane) is a stretch of `stretch` units, and the lanes of a tick follow one another; entries of different
    stretches are never within reach. The left lane is one stretch back and the right lane one ahead, with an empty
    stretch on either side of a tick's lanes.

    Args:
        cell: length of a cell of the grid in units.
        position: (N,) index on the line of each row of the clock.
        beside: (N, 2) index of the first entry within reach in the left and in the right lane.
        within: (N, 4) number of entries within reach: in the left lane, behind, ahead, in the right lane.
    """

    cell: int
    stretch: int
    location: Integers
    vehicle_id: NDArray[np.int32]
    position: NDArray[np.int32]
    beside: NDArray[np.int32]
    within: NDArray[np.unsignedinteger]


def find_neighbors(clock: pl.DataFrame, origins: Flags | None = None, *, cell_m: float = GRID_CELL_M) -> Neighborhood:
    """Find the neighbors of each origin and their cells in its 13 x 3 grid (DESIGN section 7).

    A neighbor has an entry at the same tick, in the same or an adjacent lane, nearer than six cells (27.432 m, 90 ft,
    where `cell_m` is 4.572 m; exclusive) along the road. row = round(dx / cell_m) + 6, halves away from zero;
    cell = 13 * column + row, columns left, own, right; row 12 is ahead. Of the vehicles in one cell, the nearest by
    abs(dx), then by id, keeps it. Then the others, again the nearest first, move to the nearest free cell of their
    column; of two equally near cells to the one towards which their dx points (ahead for dx = 0).

    The clock has vehicle_id, tick, x_m, lane: one row per (vehicle, tick), in any order. Entries without a lane neither
    are nor have neighbors. `origins` are (N,) flags, None = all; every row can be a neighbor.

    Raises:
        TracklakeError: ticks, lanes and positions do not fit 64 bits.
    """
    has_lane = clock["lane"].is_not_null()
    if not has_lane.all():
        wanted = has_lane.to_numpy() if origins is None else origins & has_lane.to_numpy()
        return find_neighbors(clock.filter(has_lane), wanted[has_lane.to_numpy()], cell_m=cell_m)
    rows = np.arange(clock.height) if origins is None else np.flatnonzero(origins)
    if not rows.size:
        return Neighborhood(pl.DataFrame(schema=NEIGHBOR_DTYPES), collisions=0, crowded_out=0)

    line = _build_line(clock, cell_m)
    vehicle_id, tick = clock["vehicle_id"].to_numpy(), clock["tick"].to_numpy()

    def search_chunk(start: int) -> Neighborhood:
        chunk = rows[start : start + CHUNK_ROWS]
        pairs = _find_pairs(line, line.position[chunk])
        contested = _find_contested(pairs)
        collisions = _resolve_collisions(pairs, contested, line.vehicle_id) if contested.size else 0
        placed = pairs.select_placed()
        table = pl.DataFrame(
            {
                "vehicle_id": vehicle_id[chunk][placed.origin],
                "tick": tick[chunk][placed.origin],
                "cell": placed.row + ROWS * placed.column,
                "neighbor_id": line.vehicle_id[placed.other],
                "dx_m": (placed.dx / UNITS_PER_M).astype(np.float32),
            },
            schema=NEIGHBOR_DTYPES,
        )
        return Neighborhood(table, collisions, crowded_out=pairs.row.size - placed.row.size)

    chunks = map_in_threads(search_chunk, range(0, rows.size, CHUNK_ROWS))
    return Neighborhood(
        neighbors=pl.concat(chunk.neighbors for chunk in chunks),
        collisions=sum(chunk.collisions for chunk in chunks),
        crowded_out=sum(chunk.crowded_out for chunk in chunks),
    )


def count_collisions(clock: pl.DataFrame, origins: Flags | None = None) -> int:
    """Count the vehicles whose cell is taken by a nearer one, in the grids of all origins, as published of 4.572 m.

    The clock has vehicle_id, tick, x_m, lane (without nulls): one row per (vehicle, tick), in any order. `origins` are
    (N,) flags, None = all.
    """
    if clock.is_empty():
        return 0
    line = _build_line(clock, GRID_CELL_M)
    at = np.arange(clock.height, dtype=np.int32) if origins is None else line.position[origins]

    def count_chunk(start: int) -> int:
        return int(_find_repeats(_find_pairs(line, at[start : start + CHUNK_ROWS])).sum())

    return sum(map_in_threads(count_chunk, range(0, at.size, CHUNK_ROWS)))


def _build_line(clock: pl.DataFrame, cell_m: float) -> _Line:
    """Sort the entries by (tick, lane, x) and find which others each can reach."""
    lane, tick = clock["lane"].to_numpy(), clock["tick"].to_numpy()
    # Rounded before the least one is taken away, so that distances do not depend on vehicles elsewhere.
    x = np.rint(clock["x_m"].to_numpy() * UNITS_PER_M).astype(np.int64)
    lanes = int(lane.max()) - int(lane.min()) + 3
    cell = round(cell_m * UNITS_PER_M)
    reach = ROWS // 2 * cell
    stretch = int(x.max()) - int(x.min()) + reach + 2
    if (int(tick.max()) - int(tick.min()) + 1) * lanes * stretch >= 1 << 62:
        least_m, most_m = x.min() / UNITS_PER_M, x.max() / UNITS_PER_M
        raise TracklakeError(
            f"ticks {tick.min()} to {tick.max()}, lanes {lane.min()} to {lane.max()} and x_m {least_m} to {most_m} are "
            "too wide a span to search for neighbors: pass the entries of one recording at a time"
        )
    location = (tick.astype(np.int64) - tick.min()) * lanes + (lane.astype(np.int64) - lane.min() + 1)
    location *= stretch
    location += x - x.min()

    order = np.argsort(location).astype(np.int32)
    location = location[order]
    position = np.empty_like(order)
    position[order] = np.arange(order.size, dtype=np.int32)
    largest_scene = int(clock["tick"].value_counts()["count"].to_numpy().max())
    beside, within = _find_reach(location, stretch, reach, largest_scene)
    vehicle_id = clock["vehicle_id"].to_numpy()[order]
    return _Line(cell, stretch, location, vehicle_id, position, beside, within)


def _find_reach(
    location: Integers, stretch: int, reach: int, largest_scene: int
) -> tuple[NDArray[np.int32], NDArray[np.unsignedinteger]]:
    """Find `_Line.beside` and `_Line.within`, whose numbers are at most the size of the largest scene."""
    beside = np.empty((location.size, 2), np.int32)
    within = np.empty((location.size, 4), np.min_scalar_type(largest_scene))

    def search_chunk(start: int) -> None:
        chunk = slice(start, start + CHUNK_ROWS)
        # Only the part of the line that the chunk can reach is searched: it stays in the processor's cache.
        far = stretch + reach
        first, end = np.searchsorted(location, (location[chunk][0] - far, location[chunk][-1] + far))
        near = location[first:end]
        left, own, right = (
            (
                first + np.searchsorted(near, alongside - reach, side="right"),
                first + np.searchsorted(near, alongside + reach, side="left"),
            )
            for alongside in (location[chunk] - stretch, location[chunk], location[chunk] + stretch)
        )
        itself = np.arange(start, start + own[0].size)
        beside[chunk] = np.stack((left[0], right[0]), axis=1)
        counts = (left[1] - left[0], itself - own[0], own[1] - itself - 1, right[1] - right[0])
        within[chunk] = np.stack(counts, axis=1)

    map_in_threads(search_chunk, range(0, location.size, CHUNK_ROWS))
    return beside, within


@dataclass(frozen=True)
class _Pairs:
    """Origins of a chunk with their neighbors, (P,) each, sorted by origin, column and dx.

    `row` is -1 if crowded out, `other` the neighbor's index on the line, `dx` the distance along the road in units.
    """

    origin: NDArray[np.int32]
    column: NDArray[np.int8]
    row: NDArray[np.int8]
    other: NDArray[np.int32]
    dx: Integers

    def select_placed(self) -> "_Pairs":
        """Select the pairs whose neighbor has a cell."""
        at = self.row >= 0
        if at.all():
            return self
        return _Pairs(self.origin[at], self.column[at], self.row[at], self.other[at], self.dx[at])


def _find_pairs(line: _Line, at: NDArray[np.int32]) -> _Pairs:
    """Pair a chunk of origins, given by their (B,) indices on the line, with all vehicles in reach."""
    # Four runs of indices for each origin, without itself: left lane, behind, ahead, right lane.
    left, right = line.beside[at].T
    lengths = line.within[at].astype(np.int64)
    starts = np.stack((left, at - lengths[:, 1], at + 1, right), axis=1).ravel()
    lengths = lengths.ravel()
    columns = np.array((0, 1, 1, 2), np.int8)
    alongside = (line.location[at, None] + (columns - COLUMNS // 2).astype(np.int64) * line.stretch).ravel()

    # As `expand_ranges`, with 32-bit numbers: half the memory.
    run = np.repeat(np.arange(lengths.size, dtype=np.int32), lengths)
    other = (starts - (np.cumsum(lengths) - lengths))[run] + np.arange(run.size)
    dx = line.location[other] - alongside[run]
    # Half a cell is added, less a unit behind where halves round down: floor(..) then counts cells from row 0.
    row = (2 * dx + (ROWS * line.cell - (dx < 0))) // (2 * line.cell)
    return _Pairs(run // 4, columns[run % 4], row.astype(np.int8), other, dx)


def _find_repeats(pairs: _Pairs) -> Flags:
    """Find the pairs, from the second on, whose neighbor shares the cell of the pair before."""
    repeats: Flags = (np.diff(pairs.row) == 0) & (np.diff(pairs.column) == 0) & (np.diff(pairs.origin) == 0)
    return repeats


def _find_contested(pairs: _Pairs) -> Integers:
    """Find the pairs of columns in which two neighbors share a cell; they are adjacent, since dx rises in a column."""
    column, twice = pairs.origin * COLUMNS + pairs.column, _find_repeats(pairs)
    if not twice.any():
        return np.empty(0, np.int64)
    crowded = np.zeros(int(column[-1]) + 1, np.bool_)
    crowded[column[1:][twice]] = True
    return np.flatnonzero(crowded[column])


def _resolve_collisions(pairs: _Pairs, contested: Integers, vehicle_id: NDArray[np.int32]) -> int:
    """Give every contested cell to its nearest vehicle, move the others in place, and count them.

    `row`, `other` and `dx` of the (M,) contested pairs, whole columns of origins' grids one after the other, are
    replaced, sorted by cell. Each round moves one vehicle per column, so there are at most 12 rounds.
    """
    row, other, dx = pairs.row[contested], pairs.other[contested], pairs.dx[contested]
    column = pairs.origin[contested] * COLUMNS + pairs.column[contested]
    column = np.cumsum(np.diff(column, prepend=column[:1]) != 0)
    nearest_first = np.lexsort((vehicle_id[other], np.abs(dx), column))
    row, other, dx, column = row[nearest_first], other[nearest_first], dx[nearest_first], column[nearest_first]

    # The first vehicle in a cell keeps it.
    taken = np.zeros((int(column[-1]) + 1, ROWS), np.bool_)
    _, keepers = np.unique(column * ROWS + row, return_index=True)
    taken[column[keepers], row[keepers]] = True
    moves = np.ones(row.size, np.bool_)
    moves[keepers] = False
    movers = np.flatnonzero(moves)
    begins = find_run_starts(column[movers])
    turn = np.arange(movers.size) - np.repeat(begins, np.diff(begins, append=movers.size))

    row[movers[turn >= ROWS - 1]] = -1
    blocked = 2 * ROWS
    for round_number in range(min(int(turn.max()) + 1, ROWS - 1)):
        now = movers[turn == round_number]
        steps = np.arange(ROWS) - row[now, None]
        preferred = np.where(dx[now, None] >= 0, steps > 0, steps < 0)
        cost = np.where(taken[column[now]], blocked, 2 * np.abs(steps) - preferred)
        best = cost.argmin(axis=1)
        fits = cost[np.arange(best.size), best] < blocked
        taken[column[now], best] = True
        row[now] = np.where(fits, best, -1)

    by_cell = np.lexsort((row, column))
    pairs.row[contested], pairs.other[contested] = row[by_cell], other[by_cell]
    pairs.dx[contested] = dx[by_cell]
    return movers.size
