"""Entries on a protocol's clock: tick k lies k / rate_hz seconds after the recording's first frame."""

from fractions import Fraction

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import Integers, find_run_starts
from tracklake.schemas.errors import TracklakeError

CLOCK_DTYPES: dict[str, pl.DataType] = {
    "vehicle_id": pl.Int32(),
    "tick": pl.Int32(),
    "frame": pl.Int32(),
    "x_m": pl.Float64(),
    "y_m": pl.Float64(),
    "lane": pl.Int16(),
    "speed_mps": pl.Float32(),
    "segment": pl.Int32(),
}
"""Columns of entries on the clock; see `put_on_clock`."""


def find_stride(*, frame_rate_hz: float, rate_hz: int) -> Fraction:
    """Return the number of source frames per tick as a fraction (25 Hz to 10 Hz: 5/2).

    Raises:
        TracklakeError: the clock is faster than the source.
    """
    stride = Fraction(frame_rate_hz).limit_denominator(1001) / rate_hz
    if stride < 1:
        raise TracklakeError(
            f"cannot put {frame_rate_hz:g} Hz tracks on a {rate_hz} Hz clock: expected a protocol rate of at most "
            f"{frame_rate_hz:g} Hz; choose a protocol with a lower rate_hz"
        )
    return stride


def put_on_clock(tracks: pl.DataFrame, *, first_frame: int, frame_rate_hz: float, rate_hz: int) -> pl.DataFrame:
    """Select or interpolate the entries on the clock, by frame and never by row (DESIGN section 7).

    Tick k is at frame `first_frame + k * frame_rate_hz / rate_hz`. If that is a whole number, the source's own entry
    is used; if not, x_m, y_m and speed_mps are interpolated linearly between the two frames around it and the lane is
    that of the earlier one. Both frames must exist: a gap is never bridged.

    `tracks` have vehicle_id, frame, x_m and perhaps y_m, lane, speed_mps of one subset, sorted by the first two.
    Returns the given ones of CLOCK_DTYPES, sorted by vehicle_id, tick; `frame` is null if no source frame falls on the
    tick. `segment` numbers the gap-free runs of source frames, so ticks are consecutive within a segment. A skipped
    frame starts a new segment even if no tick falls on that frame.
    """
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    frames, ticks = stride.numerator, stride.denominator
    position = (pl.col("frame").cast(pl.Int64) - first_frame) * ticks
    follows = (pl.col("vehicle_id") == pl.col("vehicle_id").shift(1)) & (
        pl.col("frame") - pl.col("frame").shift(1) == 1
    )
    given = [name for name in CLOCK_DTYPES if name in tracks.columns]
    entries = tracks.lazy().select(
        *given,
        tick=(position + frames - 1) // frames,
        segment=(~follows.fill_null(value=False)).cast(pl.Int32).cum_sum(),
    )
    columns = [pl.col(name).cast(CLOCK_DTYPES[name]) for name in CLOCK_DTYPES if name in {*given, "tick", "segment"}]
    if ticks == 1:
        on_frame = (pl.col("frame").cast(pl.Int64) - first_frame) % frames == 0
        return entries.filter(on_frame).select(columns).collect()

    # The first tick at or after an entry is `beyond` / `ticks` frames after it: at the entry itself, before the next
    # frame, or farther (then it belongs to a later entry).
    beyond = pl.col("tick") * frames - position
    on_frame = beyond == 0
    next_is_adjacent = (pl.col("segment") == pl.col("segment").shift(-1)).fill_null(value=False)
    share = beyond / ticks

    def interpolate(name: str) -> pl.Expr:
        now = pl.col(name).cast(pl.Float64)
        return pl.when(on_frame).then(now).otherwise(now + share * (now.shift(-1) - now)).alias(name)

    return (
        entries.with_columns(
            *(interpolate(name) for name in ("x_m", "y_m", "speed_mps") if name in given),
            frame=pl.when(on_frame).then("frame"),
            used=on_frame | ((beyond < ticks) & next_is_adjacent),
        )
        .filter("used")
        .select(columns)
        .collect()
    )


def join_key(vehicle_id: NDArray[np.integer], frame: NDArray[np.integer]) -> Integers:
    """Join vehicle and frame (or tick) to one number of the same order; frames may lie some way beyond Int32."""
    key: Integers = (vehicle_id.astype(np.int64, copy=False) << 32) + frame
    return key


def cut_runs(values: NDArray[np.int32], rows: int) -> list[tuple[int, int]]:
    """Cut rows into pieces of about `rows` that split no run of equal values: first row and end of each."""
    starts = find_run_starts(values)
    runs = np.searchsorted(starts, np.arange(0, values.size, rows), side="right") - 1
    cuts = [int(start) for start in np.unique(starts[runs])]
    return list(zip(cuts, [*cuts[1:], values.size], strict=True)) if cuts else []


def find_blocks(frame: NDArray[np.floating], vehicle_id: Integers, blocks: pl.DataFrame, where: str) -> Integers:
    """Find the row of `blocks` (SPLITS) that holds each entry, (N,); -1 = none; `where` names the subset.

    Raises:
        ValueError: two blocks hold one entry.
    """
    found = np.full(len(frame), -1, dtype=np.int64)
    for position, block in enumerate(blocks.iter_rows(named=True)):
        # Positions between frames are floating-point, so a millionth of a frame is tolerated.
        inside = (frame > block["first_frame"] - 1e-6) & (frame < block["last_frame"] + 1e-6)
        if block["first_vehicle_id"] is not None:
            inside &= vehicle_id >= block["first_vehicle_id"]
        if block["last_vehicle_id"] is not None:
            inside &= vehicle_id <= block["last_vehicle_id"]
        if (inside & (found >= 0)).any():
            raise ValueError(f"{where}: block {block['block']} of the split overlaps another one")
        found[inside] = position
    return found
