"""Entries as convolutional social pooling's script holds them: rows of a track, in feet and single precision.

Deo and Trivedi 2018, `preprocess_data.m`: columns 1, 2, 5, 6 and 14 of NGSIM's text files, as MATLAB's `single`.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.errors import TracklakeError

LARGEST_WHOLE = 1 << 24
"""Whole numbers beyond this cannot be told apart in single precision."""

Singles = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class CspEntries:
    """The entries of one subset, (N,) each, sorted by track and frame.

    Args:
        track_id: who it is: increasing.
        frame: increasing within a track.
        x_ft: lateral position (NGSIM's Local_X).
        y_ft: position along the road (NGSIM's Local_Y).
        lane: 1 is the driver's leftmost.
    """

    track_id: NDArray[np.int32]
    frame: Singles
    x_ft: Singles
    y_ft: Singles
    lane: Singles

    @property
    def height(self) -> int:
        """How many entries there are."""
        return self.track_id.size

    def bound_tracks(self) -> tuple[Ints, Ints]:
        """(N,) first and last row of the track that each row stands in."""
        starts = np.flatnonzero(np.diff(self.track_id, prepend=self.track_id[:1] - 1))
        lengths = np.diff(starts, append=self.height)
        first = np.repeat(starts, lengths)
        return first, first + np.repeat(lengths, lengths) - 1


def to_csp_entries(clock: pl.DataFrame, *, last_lane: int | None) -> CspEntries:
    """Turn entries in metres into what the script reads.

    Args:
        clock: track_id, frame, x_m, y_m, lane (without nulls), sorted by track_id, frame; each pair once.
        last_lane: lanes with higher numbers count as this one (the script's 6 on US-101); None: all stay.

    Raises:
        TracklakeError: an id or a frame that single precision does not hold.
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


def to_feet(metres: NDArray[np.float64]) -> Singles:
    """Metres as feet in single precision: where feet were recorded, the very single that the script reads.

    A foot is 0.3048 m, so that dividing gives the recorded number to within a few units of double precision's last
    place, 1e-13 of it. A number of up to six decimals that is not halfway between two singles is 1e-9 and more away
    from there, and below 2^18 feet none is halfway: both round to the same single.
    """
    return (metres / FOOT_M).astype(np.float32)


def name_as_recorded(clock: pl.DataFrame, vehicles: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Name tracks by the ids in the source's files, as the script does: one id is one track.

    Where the lake told vehicles of one id apart they are one track again. Of two with the same id in the same frame,
    which the script's own Dataset class cannot read, that of the lower vehicle_id (seen first) stays.

    Args:
        clock: vehicle_id, frame.
        vehicles: vehicle_id, source_vehicle_id.

    Returns:
        The clock with track_id, sorted by track_id, frame; how many rows were dropped.
    """
    names = vehicles.select("vehicle_id", track_id="source_vehicle_id")
    if names["vehicle_id"].equals(names["track_id"]):
        return clock.with_columns(track_id="vehicle_id"), 0
    named = clock.join(names, on="vehicle_id", how="left", maintain_order="left").sort(
        "track_id", "frame", "vehicle_id"
    )
    once = named.unique(["track_id", "frame"], keep="first", maintain_order=True)
    return once, named.height - once.height


def name_by_runs(clock: pl.DataFrame, block: NDArray[np.int32], *, highest_id: int) -> pl.DataFrame:
    """Name tracks so that none has a gap: the first run of a vehicle keeps its id, later ones get unused ids.

    The Dataset class counts rows, not frames: across a gap it would take a second for a tenth of one.

    Args:
        clock: vehicle_id, tick, segment, sorted by vehicle_id, tick.
        block: (N,) of the split; where it changes, a new run begins.
        highest_id: of all vehicles, also of those that are not in the clock; unused ids are above it.

    Returns:
        The clock with track_id, sorted by track_id, tick.
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
