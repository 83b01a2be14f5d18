"""Scenes as small integers: what the player of a subset's page shows, chosen within a limit of size and packed."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import Integers

ENTRY_BYTES, SEGMENT_BYTES = 4, 28
"""Packed size of an entry and of a segment's head, in bytes, before base64."""
X_PER_M, Y_PER_M, SPEED_PER_MPS, HEADING_PER_RAD = 10, 100, 3.6, 75
"""Units of packed positions along and across the road, speeds and headings: 0.1 m, 0.01 m, 1 km/h, 1/75 rad."""
LEAST_SPEED = 40
"""Speed backwards that is packed as 0, in km/h."""
LARGEST_STEP = 127
"""Largest step of a position between two ticks that one byte holds; behind a larger one a new segment begins."""
LENGTH_M, WIDTH_M = 4.5, 1.8
"""Size that a vehicle of unknown size is drawn with."""

Window = tuple[int, int]
"""First and last tick of a stretch of time, both included."""


@dataclass(frozen=True)
class Selection:
    """What fits into the player.

    Args:
        ticks: chosen ticks, in order.
        accepted: whether each window was chosen.
        first_ticks: number of ticks chosen from the beginning.
    """

    ticks: Integers
    accepted: list[bool]
    first_ticks: int


def prepare_entries(entries: pl.DataFrame) -> pl.DataFrame:
    """Add the quantised columns x, y, speed, heading, and `begins`: whether an entry begins a segment.

    Args:
        entries: vehicle_id, tick, x_m, y_m, speed_mps, heading_rad, sorted by vehicle_id, tick.
    """
    quantised = entries.with_columns(
        (pl.col("x_m") * X_PER_M).round().cast(pl.Int32).alias("x"),
        (pl.col("y_m") * Y_PER_M).round().cast(pl.Int32).alias("y"),
        pack_speeds().alias("speed"),
        (pl.col("heading_rad").cast(pl.Float64) * HEADING_PER_RAD)
        .round()
        .clip(-127, 127)
        .cast(pl.Int8)
        .alias("heading"),
    )
    return mark_segments(quantised)


def pack_speeds() -> pl.Expr:
    """Return `speed_mps` as a byte, in km/h from LEAST_SPEED backwards on."""
    speed = pl.col("speed_mps").cast(pl.Float64) * SPEED_PER_MPS + LEAST_SPEED
    return speed.round().clip(0, 255).cast(pl.UInt8)


def mark_segments(entries: pl.DataFrame) -> pl.DataFrame:
    """Mark in `begins` the entries that do not follow the row before within a byte's step."""
    follows = (
        (pl.col("vehicle_id").diff() == 0)
        & (pl.col("tick").diff() == 1)
        & (pl.col("x").diff().abs() <= LARGEST_STEP)
        & (pl.col("y").diff().abs() <= LARGEST_STEP)
    )
    return entries.with_columns(begins=~follows.fill_null(value=False))


def select_ticks(entries: pl.DataFrame, windows: Sequence[Window], first: Window, most_bytes: int) -> Selection:
    """Choose whole windows in their order, then ticks from the beginning, as long as they fit.

    Args:
        entries: entries of all ticks that may be chosen, of `prepare_entries`.
        windows: stretches of time around findings, the gravest finding first.
        first: stretch at the beginning of the recording, of which the end may be cut.
        most_bytes: greatest size of the packed data as base64.
    """
    last_tick = max([first[1], *(last for _, last in windows)])
    budget = most_bytes // 4 * 3
    tick, begins = entries["tick"].to_numpy(), entries["begins"].to_numpy()
    within = (tick >= 0) & (tick <= last_tick)
    count = np.bincount(tick[within], minlength=last_tick + 1)
    cost = ENTRY_BYTES * count + SEGMENT_BYTES * np.bincount(tick[within & begins], minlength=last_tick + 1)
    chosen: NDArray[np.bool_] = np.zeros(last_tick + 1, np.bool_)
    accepted = []
    spent = 0
    for begin, end in windows:
        new = ~chosen[begin : end + 1]
        # All vehicles may begin a segment where a window begins; where stretches meet, this counts too many.
        price = int(cost[begin : end + 1][new].sum()) + SEGMENT_BYTES * int(count[begin : end + 1].max(initial=0))
        fits = bool(count[begin : end + 1].any()) and spent + price <= budget
        accepted.append(fits)
        if fits:
            chosen[begin : end + 1] = True
            spent += price
    begin, end = first
    growing = spent + np.cumsum(np.where(chosen[begin : end + 1], 0, cost[begin : end + 1]))
    first_ticks = int(np.searchsorted(growing, budget, side="right"))
    chosen[begin : begin + first_ticks] = True
    return Selection(np.flatnonzero(chosen), accepted, first_ticks)


def find_stretches(ticks: Integers) -> list[list[int]]:
    """Return the first and the last tick of every run of consecutive ticks."""
    ends = np.flatnonzero(np.diff(ticks, append=ticks[-1:] + 2) > 1)
    begins = np.append(0, ends[:-1] + 1)[: len(ends)]
    stretches: list[list[int]] = np.stack([ticks[begins], ticks[ends]], axis=1).tolist()
    return stretches


def pack_entries(entries: pl.DataFrame, ticks: Integers) -> dict[str, str]:
    """Pack the entries of some ticks as base64 of little-endian integers.

    `segments` has seven 32-bit integers per segment: vehicle, first tick, entries, x (0.1 m), y (0.01 m), and the
    vehicle's length and width (0.1 m). `entries` has four bytes per entry: its steps of x and y since the entry before,
    0 for a segment's first, speed (km/h + LEAST_SPEED, unsigned) and heading (1/75 rad).

    Args:
        entries: entries of `prepare_entries`, with length_m and width_m, which are null where unknown.
        ticks: ticks to pack.
    """
    packed = mark_segments(entries.filter(pl.col("tick").is_in(pl.Series(ticks).implode())))
    follows = ~packed["begins"].to_numpy()
    steps = [np.where(follows, packed[name].diff().fill_null(0).to_numpy(), 0) for name in ("x", "y")]
    rows: NDArray[np.int8] = np.empty((packed.height, ENTRY_BYTES), np.int8)
    for column, values in enumerate((*steps, packed["speed"].to_numpy().view(np.int8), packed["heading"].to_numpy())):
        rows[:, column] = values
    starts = np.flatnonzero(~follows)
    heads = packed[starts].select(
        "vehicle_id",
        "tick",
        pl.Series("count", np.diff(starts, append=packed.height)),
        "x",
        "y",
        (pl.col("length_m").cast(pl.Float64).fill_null(LENGTH_M) * X_PER_M).round(),
        (pl.col("width_m").cast(pl.Float64).fill_null(WIDTH_M) * X_PER_M).round(),
    )
    return {
        "segments": base64.b64encode(heads.to_numpy().astype("<i4").tobytes()).decode("ascii"),
        "entries": base64.b64encode(rows.tobytes()).decode("ascii"),
    }
