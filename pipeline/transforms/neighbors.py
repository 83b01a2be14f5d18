"""Who stands around a vehicle: the 13 x 3 grid, without silent overwriting."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from schemas.samples import CELLS

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
CHUNK_ROWS = 1 << 14
"""Origins whose grids are filled at a time: their 2.5 MB stay in the processor's cache (measured: half the time)."""

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
    an empty stretch on either side of a tick's lanes. A sentinel stands at either end.
    """

    stretch: int
    place: Ints
    """(N + 2,) sorted places."""
    entry: NDArray[np.int32]
    """(N + 2,) row of the clock that stands there; -1 for the sentinels."""
    position: NDArray[np.int32]
    """(N,) where on the line each row of the clock stands."""
    beside: tuple[NDArray[np.int32], NDArray[np.int32]]
    """(N + 2,) each: the first position in the left and in the right lane that is not behind."""


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
        ValueError: ticks, lanes and positions span more than 64 bits hold.
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
    tables, collisions, crowded_out = [], 0, 0
    for start in range(0, rows.size, CHUNK_ROWS):
        chunk = rows[start : start + CHUNK_ROWS]
        grid, contested, own = _fill_grids(line, line.position[chunk].astype(np.int64))
        if contested.size:
            collisions += contested.shape[1]
            crowded_out += _settle(grid, contested, own, line, vehicle_id)
        filled = np.flatnonzero(grid >= 0)
        origin = filled // CELLS
        other = grid[filled]
        tables.append(
            pl.DataFrame(
                {
                    "vehicle_id": vehicle_id[chunk][origin],
                    "tick": tick[chunk][origin],
                    "cell": (filled - origin * CELLS).astype(np.int8),
                    "neighbor_id": vehicle_id[line.entry[other]],
                    "dx_m": (_offset(line, other, own, filled) / UNITS_PER_M).astype(np.float32),
                },
                schema=NEIGHBOR_DTYPES,
            )
        )
    return Neighborhood(pl.concat(tables), collisions, crowded_out)


def _lay_out(clock: pl.DataFrame) -> _Line:
    """Sort the entries by (tick, lane, x)."""
    x_m, lane, tick = clock["x_m"].to_numpy(), clock["lane"].to_numpy(), clock["tick"].to_numpy()
    lanes = int(lane.max()) - int(lane.min()) + 3
    stretch = round((float(x_m.max()) - float(x_m.min())) * UNITS_PER_M) + REACH_UNITS + 2
    if (int(tick.max()) - int(tick.min()) + 1) * lanes * stretch >= 1 << 62:
        raise ValueError(
            f"ticks {tick.min()} to {tick.max()}, lanes {lane.min()} to {lane.max()} and x_m {x_m.min()} to "
            f"{x_m.max()} are too wide a span to search for neighbors: pass the entries of one recording at a time"
        )
    place = (tick.astype(np.int64) - tick.min()) * lanes + (lane.astype(np.int64) - lane.min() + 1)
    place *= stretch
    place += np.rint((x_m - x_m.min()) * UNITS_PER_M).astype(np.int64)

    order = np.argsort(place)
    place = place[order]
    beyond = 2 * stretch
    place = np.concatenate(([place[0] - beyond], place, [place[-1] + beyond]))
    position = np.empty(order.size, np.int32)
    position[order] = np.arange(1, order.size + 1, dtype=np.int32)
    left, right = (np.searchsorted(place, place + shift).astype(np.int32) for shift in (-stretch, stretch))
    entry = np.concatenate(([-1], order, [-1])).astype(np.int32)
    return _Line(stretch=stretch, place=place, entry=entry, position=position, beside=(left, right))


def _fill_grids(line: _Line, at: Ints) -> tuple[NDArray[np.int32], Ints, Ints]:
    """Put every neighbor of a chunk of origins into its cell, first come first served.

    Args:
        line: all entries.
        at: (B,) positions of the origins on the line.

    Returns:
        The grids (B * 39,): positions on the line, -1 = empty; those who found their cell taken (2, M): cell, position
        on the line; the origins' places on the line (B,).
    """
    own = line.place[at]
    grid = np.full(at.size * CELLS, -1, np.int32)
    taken: list[Ints] = []
    left, right = line.beside
    starts = (left[at].astype(np.int64), at, right[at].astype(np.int64))
    for column, start in enumerate(starts):
        target = own + (column - COLUMNS // 2) * line.stretch
        itself = 1 if column == COLUMNS // 2 else 0
        for side, first in ((1, start + itself), (-1, start - 1)):
            for origin, other, distance in _sweep(line.place, target, first, side):
                row = ROWS // 2 + side * ((2 * distance + CELL_UNITS) // (2 * CELL_UNITS))
                cell = origin * CELLS + (column * ROWS + row)
                free = grid[cell] < 0
                grid[cell[free]] = other[free]
                if not free.all():
                    taken.append(np.stack((cell[~free], other[~free])))
    contested = np.concatenate(taken, axis=1) if taken else np.empty(0, np.int64)
    return grid, contested, own


def _sweep(place: Ints, target: Ints, first: Ints, side: int) -> Iterator[tuple[Ints, Ints, Ints]]:
    """Walk from each origin along a lane, one vehicle a step, until nobody has another one within reach.

    Args:
        place: (N + 2,) the line.
        target: (B,) the place on the line that lies alongside each origin.
        first: (B,) where on the line to begin.
        side: 1 to walk ahead, -1 to walk back.

    Yields:
        origin (index into B), position on the line, distance in units (>= 0).
    """
    origin, other = np.arange(target.size), first
    while origin.size:
        distance = (place[other] - target[origin]) * side
        near = distance < REACH_UNITS
        origin, other = origin[near], other[near]
        yield origin, other, distance[near]
        other = other + side


def _offset(line: _Line, other: NDArray[np.int32] | Ints, own: Ints, cell: Ints) -> Ints:
    """Offset (dx) in units of those who stand at `other`, around the origins whose grids hold `cell`."""
    column = cell // ROWS
    origin = column // COLUMNS
    dx: Ints = line.place[other] - own[origin] - (column - (origin * COLUMNS + COLUMNS // 2)) * line.stretch
    return dx


def _settle(grid: NDArray[np.int32], contested: Ints, own: Ints, line: _Line, vehicle_id: NDArray[np.int32]) -> int:
    """Give every contested cell to its nearest vehicle and move the others; return how many find no cell.

    A round moves one vehicle in every column that has one to move, so there are at most 12 rounds.
    """
    cell, other = contested
    cells = np.unique(cell)
    cell, other = np.concatenate((cells, cell)), np.concatenate((grid[cells], other))
    dx = _offset(line, other, own, cell)
    order = np.lexsort((vehicle_id[line.entry[other]], np.abs(dx), cell))
    cell, other, dx = cell[order], other[order], dx[order]
    keeps = np.diff(cell, prepend=-1) > 0
    grid[cell[keeps]] = other[keeps]

    cell, other, dx = cell[~keeps], other[~keeps], dx[~keeps]
    column = cell // ROWS
    order = np.lexsort((vehicle_id[line.entry[other]], np.abs(dx), column))
    cell, other, dx, column = cell[order], other[order], dx[order], column[order]
    begins = np.flatnonzero(np.diff(column, prepend=-1))
    turn = np.arange(column.size) - np.repeat(begins, np.diff(begins, append=column.size))

    rows = np.arange(ROWS)
    blocked = 2 * ROWS
    moved = 0
    for round_number in range(min(int(turn.max()) + 1, ROWS - 1)):
        now = turn == round_number
        cells_of_column = column[now, None] * ROWS + rows
        steps = cells_of_column - cell[now, None]
        preferred = np.where(dx[now, None] >= 0, steps > 0, steps < 0)
        cost = np.where(grid[cells_of_column] < 0, 2 * np.abs(steps) - preferred, blocked)
        best = cost.argmin(axis=1)
        fits = cost[np.arange(best.size), best] < blocked
        grid[(column[now] * ROWS + best)[fits]] = other[now][fits]
        moved += int(fits.sum())
    return column.size - moved
