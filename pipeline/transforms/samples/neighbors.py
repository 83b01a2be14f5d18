"""Who stands around a vehicle: the 13 x 3 grid, without silent overwriting."""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.samples.threads import map_in_threads
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.samples import CELLS

ROWS = 13
"""Cells of one column, behind to ahead; row 6 is alongside."""
COLUMNS = CELLS // ROWS
"""Left, own and right lane: lane - 1, lane and lane + 1."""
UNITS_PER_M = 10_000_000
"""Positions are compared as whole tenths of a micrometre: a millimetre and a thousandth of a foot are both whole
numbers of them, so that 'exclusive' and 'half away from zero' mean what they say."""
CELL_UNITS = 45_720_000
"""4.572 m, 15 feet."""
REACH_UNITS = 274_320_000
"""27.432 m, 90 feet: a neighbor is nearer than this."""
CHUNK_ROWS = 1 << 15
"""Origins whose pairs are made at a time: their few MB stay in the processor's cache."""

NEIGHBOR_DTYPES: dict[str, pl.DataType] = {
    "vehicle_id": pl.Int32(),
    "tick": pl.Int32(),
    "cell": pl.Int8(),
    "neighbor_id": pl.Int32(),
    "dx_m": pl.Float32(),
}

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Neighborhood:
    """What `find_neighbors` finds.

    Args:
        neighbors: NEIGHBOR_DTYPES, in the order of the origins' rows and then by cell.
        collisions: vehicles that found their cell taken by a nearer one; all but `crowded_out` stand in another cell.
        crowded_out: of them, those for whom the column had no free cell: they stand nowhere.
    """

    neighbors: pl.DataFrame
    collisions: int
    crowded_out: int


@dataclass(frozen=True)
class _Line:
    """All entries laid out on one line of integers, so that one comparison tells tick, lane and distance.

    A (tick, lane) is a stretch of `stretch` units, the lanes of a tick following one another; entries of different
    stretches are never within reach. The lane to the left is one stretch back, the lane to the right one ahead, with
    an empty stretch on either side of a tick's lanes.
    """

    stretch: int
    place: Ints
    """(N,) sorted places."""
    vehicle_id: NDArray[np.int32]
    """(N,) who stands there."""
    position: NDArray[np.int32]
    """(N,) where on the line each row of the clock stands."""
    beside: NDArray[np.int32]
    """(N, 2) position of the first entry within reach of each in the left and in the right lane."""
    within: NDArray[np.unsignedinteger]
    """(N, 4) how many are within reach: in the left lane, behind, ahead, in the right lane."""


def find_neighbors(clock: pl.DataFrame, origins: NDArray[np.bool_] | None = None) -> Neighborhood:
    """Find the vehicles around each origin and the cell of its 13 x 3 grid each stands in (DESIGN section 7).

    A neighbor has an entry at the same tick, in the same or an adjacent lane, nearer than 27.432 m (90 ft, exclusive)
    along the road. row = round(dx / 4.572 m) + 6, halves away from zero; cell = 13 * column + row, columns left, own,
    right; row 12 is ahead. Of the vehicles in one cell the nearest by abs(dx), then the smaller id, keeps it. When
    all cells have been given to their nearest, the others, again the nearest first, move to the nearest free cell of
    their column; of two equally near the one towards which their dx points (ahead for dx = 0).

    Args:
        clock: vehicle_id, tick, x_m, lane: one row per (vehicle, tick), in any order. Entries without a lane are
            nobody's neighbor and have none.
        origins: (N,) rows of the clock whose neighbors are wanted; None = all. Every row can be a neighbor.

    Raises:
        TracklakeError: ticks, lanes and positions span more than 64 bits hold.
    """
    has_lane = clock["lane"].is_not_null()
    if not has_lane.all():
        wanted = has_lane.to_numpy() if origins is None else origins & has_lane.to_numpy()
        return find_neighbors(clock.filter(has_lane), wanted[has_lane.to_numpy()])
    rows = np.arange(clock.height) if origins is None else np.flatnonzero(origins)
    if not rows.size:
        return Neighborhood(pl.DataFrame(schema=NEIGHBOR_DTYPES), collisions=0, crowded_out=0)

    line = _lay_out(clock)
    vehicle_id, tick = clock["vehicle_id"].to_numpy(), clock["tick"].to_numpy()

    def look_around(start: int) -> Neighborhood:
        chunk = rows[start : start + CHUNK_ROWS]
        pairs = _pair(line, line.position[chunk])
        contested = _find_contested(pairs)
        collisions = _settle(pairs, contested, line.vehicle_id) if contested.size else 0
        housed = pairs.housed()
        table = pl.DataFrame(
            {
                "vehicle_id": vehicle_id[chunk][housed.origin],
                "tick": tick[chunk][housed.origin],
                "cell": housed.row + ROWS * housed.column,
                "neighbor_id": line.vehicle_id[housed.other],
                "dx_m": (housed.dx / UNITS_PER_M).astype(np.float32),
            },
            schema=NEIGHBOR_DTYPES,
        )
        return Neighborhood(table, collisions, crowded_out=pairs.row.size - housed.row.size)

    chunks = map_in_threads(look_around, range(0, rows.size, CHUNK_ROWS))
    return Neighborhood(
        neighbors=pl.concat(chunk.neighbors for chunk in chunks),
        collisions=sum(chunk.collisions for chunk in chunks),
        crowded_out=sum(chunk.crowded_out for chunk in chunks),
    )


def _lay_out(clock: pl.DataFrame) -> _Line:
    """Sort the entries by (tick, lane, x) and find whom each can reach."""
    x_m, lane, tick = clock["x_m"].to_numpy(), clock["lane"].to_numpy(), clock["tick"].to_numpy()
    lanes = int(lane.max()) - int(lane.min()) + 3
    stretch = round((float(x_m.max()) - float(x_m.min())) * UNITS_PER_M) + REACH_UNITS + 2
    if (int(tick.max()) - int(tick.min()) + 1) * lanes * stretch >= 1 << 62:
        raise TracklakeError(
            f"ticks {tick.min()} to {tick.max()}, lanes {lane.min()} to {lane.max()} and x_m {x_m.min()} to "
            f"{x_m.max()} are too wide a span to search for neighbors: pass the entries of one recording at a time"
        )
    place = (tick.astype(np.int64) - tick.min()) * lanes + (lane.astype(np.int64) - lane.min() + 1)
    place *= stretch
    place += np.rint((x_m - x_m.min()) * UNITS_PER_M).astype(np.int64)

    order = np.argsort(place).astype(np.int32)
    place = place[order]
    position = np.empty_like(order)
    position[order] = np.arange(order.size, dtype=np.int32)
    most = int(clock["tick"].value_counts()["count"].to_numpy().max())
    beside, within = _find_reach(place, stretch, most)
    vehicle_id = clock["vehicle_id"].to_numpy()[order]
    return _Line(stretch, place, vehicle_id, position, beside, within)


def _find_reach(place: Ints, stretch: int, most: int) -> tuple[NDArray[np.int32], NDArray[np.unsignedinteger]]:
    """`_Line.beside` and `_Line.within`, which is to hold numbers up to `most`."""
    beside = np.empty((place.size, 2), np.int32)
    within = np.empty((place.size, 4), np.min_scalar_type(most))

    def look_up(start: int) -> None:
        chunk = slice(start, start + CHUNK_ROWS)
        # Searched is only that part of the line that the chunk can reach: it stays in the processor's cache.
        far = stretch + REACH_UNITS
        first, end = np.searchsorted(place, (place[chunk][0] - far, place[chunk][-1] + far))
        near = place[first:end]
        left, own, right = (
            (
                first + np.searchsorted(near, alongside - REACH_UNITS, side="right"),
                first + np.searchsorted(near, alongside + REACH_UNITS, side="left"),
            )
            for alongside in (place[chunk] - stretch, place[chunk], place[chunk] + stretch)
        )
        itself = np.arange(start, start + own[0].size)
        beside[chunk] = np.stack((left[0], right[0]), axis=1)
        counts = (left[1] - left[0], itself - own[0], own[1] - itself - 1, right[1] - right[0])
        within[chunk] = np.stack(counts, axis=1)

    map_in_threads(look_up, range(0, place.size, CHUNK_ROWS))
    return beside, within


@dataclass(frozen=True)
class _Pairs:
    """Origins of a chunk and who is around them, by origin, column and dx."""

    origin: NDArray[np.int32]
    """(P,) of the chunk."""
    column: NDArray[np.int8]
    row: NDArray[np.int8]
    """(P,) of the cell; -1 = crowded out."""
    other: NDArray[np.int32]
    """(P,) position on the line."""
    dx: Ints
    """(P,) in units."""

    def housed(self) -> "_Pairs":
        """Those that stand in a cell."""
        at = self.row >= 0
        if at.all():
            return self
        return _Pairs(self.origin[at], self.column[at], self.row[at], self.other[at], self.dx[at])


def _pair(line: _Line, at: NDArray[np.int32]) -> _Pairs:
    """Pair a chunk of origins, given by their (B,) positions on the line, with everybody in reach."""
    # Four runs of positions for each origin, which does not pair with itself: left lane, behind, ahead, right lane.
    left, right = line.beside[at].T
    lengths = line.within[at].astype(np.int64)
    starts = np.stack((left, at - lengths[:, 1], at + 1, right), axis=1).ravel()
    lengths = lengths.ravel()
    columns = np.array((0, 1, 1, 2), np.int8)
    alongside = (line.place[at, None] + (columns - COLUMNS // 2).astype(np.int64) * line.stretch).ravel()

    run = np.repeat(np.arange(lengths.size, dtype=np.int32), lengths)
    other = (starts - (np.cumsum(lengths) - lengths))[run] + np.arange(run.size)
    dx = line.place[other] - alongside[run]
    # Half a cell more, and a unit less behind, where halves are rounded down: floor(..) then counts cells from row 0.
    row = (2 * dx + (ROWS * CELL_UNITS - (dx < 0))) // (2 * CELL_UNITS)
    return _Pairs(run // 4, columns[run % 4], row.astype(np.int8), other, dx)


def _find_contested(pairs: _Pairs) -> Ints:
    """Pairs in columns of which a cell has been given twice; in a column dx rises, so such pairs follow one another."""
    column = pairs.origin * COLUMNS + pairs.column
    twice = (column[1:] == column[:-1]) & (pairs.row[1:] == pairs.row[:-1])
    if not twice.any():
        return np.empty(0, np.int64)
    crowded = np.zeros(int(column[-1]) + 1, np.bool_)
    crowded[column[1:][twice]] = True
    return np.flatnonzero(crowded[column])


def _settle(pairs: _Pairs, contested: Ints, vehicle_id: NDArray[np.int32]) -> int:
    """Give every contested cell to its nearest vehicle and move the others, in place; return how many those are.

    A round moves one vehicle in every column that has one to move, so there are at most 12 rounds.

    Args:
        pairs: of a chunk; `row`, `other` and `dx` of the contested ones are replaced, in the order of their cells.
        contested: (M,) which pairs; whole columns of an origin's grid, one after the other.
        vehicle_id: by position on the line.
    """
    row, other, dx = pairs.row[contested], pairs.other[contested], pairs.dx[contested]
    column = pairs.origin[contested] * COLUMNS + pairs.column[contested]
    column = np.cumsum(np.diff(column, prepend=column[:1]) != 0)
    nearest_first = np.lexsort((vehicle_id[other], np.abs(dx), column))
    row, other, dx, column = row[nearest_first], other[nearest_first], dx[nearest_first], column[nearest_first]

    # Of those in one cell the first keeps it.
    taken = np.zeros((int(column[-1]) + 1, ROWS), np.bool_)
    _, keepers = np.unique(column * ROWS + row, return_index=True)
    taken[column[keepers], row[keepers]] = True
    moves = np.ones(row.size, np.bool_)
    moves[keepers] = False
    movers = np.flatnonzero(moves)
    begins = np.flatnonzero(np.diff(column[movers], prepend=-1))
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
