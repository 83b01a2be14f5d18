"""Entries in the units of convolutional social pooling's script: rows of a track, in feet and single precision.

Deo and Trivedi 2018, `preprocess_data.m`: columns 1, 2, 5, 6 and 14 of NGSIM's text files, as MATLAB's `single`.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import Floats, Integers, Singles, bound_runs
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.errors import TracklakeError

LARGEST_WHOLE = 1 << 24
"""Highest number below which single precision represents every whole number."""


@dataclass(frozen=True)
class CspEntries:
    """The entries of one subset, (N,) each, sorted by track and frame.

    Positions are in ft: x_ft is lateral (NGSIM's Local_X), y_ft along the road (Local_Y).
    """

    track_id: NDArray[np.int32]
    frame: Singles
    x_ft: Singles
    y_ft: Singles
    lane: Singles

    @property
    def height(self) -> int:
        """N, the number of entries."""
        return self.track_id.size

    def bound_tracks(self) -> tuple[Integers, Integers]:
        """Return the first and the last row of each row's track, (N,) each."""
        return bound_runs(self.track_id)


def to_csp_entries(clock: pl.DataFrame, *, last_lane: int | None) -> CspEntries:
    """Convert entries in metres to the script's.

    The clock has track_id, frame, x_m, y_m, lane (without nulls) and is sorted by the first two; each pair once. Lanes
    above `last_lane` count as it (the script's 6 on US-101).

    Raises:
        TracklakeError: single precision cannot represent an id or a frame.
    """
    for name in ("track_id", "frame"):
        highest = clock[name].max()
        if isinstance(highest, int) and highest > LARGEST_WHOLE:
            raise TracklakeError(
                f"{name} {highest}: the .mat files hold ids and frames in single precision, which tells whole numbers "
                f"apart up to {LARGEST_WHOLE:,}; correct the ids of this recording, or leave it out"
            )
    lane = clock["lane"].to_numpy()
    return CspEntries(
        track_id=clock["track_id"].to_numpy().astype(np.int32),
        frame=clock["frame"].to_numpy().astype(np.float32),
        x_ft=to_feet(clock["y_m"].to_numpy()),
        y_ft=to_feet(clock["x_m"].to_numpy()),
        lane=(lane if last_lane is None else np.minimum(lane, last_lane)).astype(np.float32),
    )


def to_feet(metres: Floats) -> Singles:
    """Convert metres to feet in single precision, exactly as the script reads recorded feet.

    A foot is 0.3048 m, so the division gives the recorded number to a few units of double precision's last place,
    1e-13 of it. A number of up to six decimals lies at least 1e-9 from the middle between two singles, and below 2^18
    feet none lies on it: both round to the same single.
    """
    return (metres / FOOT_M).astype(np.float32)


def assign_recorded_ids(clock: pl.DataFrame, vehicles: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Name tracks by the ids in the source's files, as the script does: one id is one track.

    Vehicles that share an id in the source are one track again. If two of them are in the same frame, which the
    script's Dataset class cannot read, the one with the lower vehicle_id (seen first) is kept.

    From vehicle_id, frame of the clock and vehicle_id, source_vehicle_id of the vehicles. Returns the clock with
    track_id, sorted by track_id, frame, and the number of dropped rows.
    """
    names = vehicles.select("vehicle_id", track_id="source_vehicle_id")
    if names["vehicle_id"].equals(names["track_id"]):
        return clock.with_columns(track_id="vehicle_id"), 0
    named = clock.join(names, on="vehicle_id", how="left", maintain_order="left").sort(
        "track_id", "frame", "vehicle_id"
    )
    once = named.unique(["track_id", "frame"], keep="first", maintain_order=True)
    return once, named.height - once.height


def assign_run_ids(clock: pl.DataFrame, block: Integers, *, highest_id: int) -> pl.DataFrame:
    """Name tracks so that none has a gap: the first run of a vehicle keeps its id, later runs get unused ids.

    The Dataset class counts rows, not frames: across a gap it would mistake a second for a tenth of one.

    The clock has vehicle_id, tick, segment, and is sorted by the first two; a new run begins where the (N,) block of
    the split changes. Unused ids are above `highest_id`, that of all vehicles. Returns the clock with track_id, sorted
    by track_id, tick.
    """
    vehicle, tick, segment = (clock[name].to_numpy() for name in ("vehicle_id", "tick", "segment"))
    new_vehicle = np.diff(vehicle, prepend=vehicle[:1] - 1) != 0
    again = (np.diff(segment, prepend=segment[:1]) != 0) | (np.diff(block, prepend=block[:1]) != 0)
    again |= np.diff(tick, prepend=tick[:1] - 1) != 1
    again &= ~new_vehicle
    if not again.any():
        return clock.with_columns(track_id="vehicle_id")
    starts = np.flatnonzero(new_vehicle | again)
    names = np.where(again[starts], highest_id + np.cumsum(again[starts]), vehicle[starts])
    track_id = pl.Series(np.repeat(names, np.diff(starts, append=vehicle.size)), dtype=pl.Int64)
    return clock.with_columns(track_id=track_id).sort("track_id", "tick")
