"""What the derived traffic tables read of a subset's tracks, as arrays: entries, leaders, steps from entry to entry."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.resample import join_key
from tracklake.pipeline.transforms.tracks.gaps import NO_LEADER, find_rows
from tracklake.schemas.arrays import Flags, Floats, Integers, find_run_starts

COLUMNS = (
    "vehicle_id",
    "frame",
    "x_m",
    "y_m",
    "lane",
    "speed_mps",
    "accel_mps2",
    "accel_10hz_mps2",
    "leader_id",
    "follower_id",
    "gap_m",
)
"""Columns of `tracks` that the derived tables read."""
NO_LANE = -1
"""Number that stands for no lane in arrays."""


@dataclass(frozen=True)
class Whole:
    """What is known of a whole subset where a scene has some of its vehicles.

    Args:
        road_m: least and greatest position of all entries; None where they are equal, or there are none.
        has_leaders: whether any entry has a leader.
        own: vehicles that the scene is for, sorted; others are their leaders and followers.
    """

    road_m: tuple[float, float] | None
    has_leaders: bool
    own: Integers


@dataclass(frozen=True)
class Scene:
    """The entries of a subset, sorted by vehicle and frame, and its sizes of vehicles.

    Of a long subset these are whole tracks of some vehicles and of all their leaders and followers.

    Args:
        tracks: COLUMNS of `tracks`.
        vehicles: vehicle_id, length_m of `vehicles`.
        rate_hz: frame rate.
        first_frame: the recording's first frame, where time is 0.
        end_s: time of the recording's last frame.
        whole: what is known of the whole subset; None where the scene is that.
    """

    tracks: pl.DataFrame
    vehicles: pl.DataFrame
    rate_hz: float
    first_frame: int
    end_s: float
    whole: Whole | None = None

    def read(self, name: str) -> Floats:
        """Return a column of numbers, NaN where it is null."""
        return self.tracks[name].cast(pl.Float64).fill_null(np.nan).to_numpy()

    def read_acceleration(self) -> Floats:
        """Return accelerations: the recorded ones, recomputed ones where the source has none; NaN without either."""
        recorded = self.read("accel_mps2")
        return np.where(np.isnan(recorded), self.read("accel_10hz_mps2"), recorded)

    @cached_property
    def ids(self) -> NDArray[np.int32]:
        """Vehicle of each entry."""
        return self.tracks["vehicle_id"].to_numpy()

    @cached_property
    def frames(self) -> NDArray[np.int32]:
        """Frame of each entry."""
        return self.tracks["frame"].to_numpy()

    @cached_property
    def lanes(self) -> NDArray[np.int16]:
        """Lane of each entry; NO_LANE where it is unknown."""
        return self.tracks["lane"].fill_null(NO_LANE).to_numpy()

    @cached_property
    def leaders(self) -> NDArray[np.int32]:
        """Leader of each entry, as recorded; NO_LEADER where there is none."""
        return self.tracks["leader_id"].fill_null(NO_LEADER).to_numpy()

    @cached_property
    def leader_rows(self) -> tuple[NDArray[np.intp], Flags]:
        """Row of each entry's leader at the same frame, and whether there is one."""
        return find_rows(self.ids, self.frames, self.leaders)

    @cached_property
    def follows(self) -> Flags:
        """Whether an entry is the vehicle's next frame after the row before it; (N + 1,), the last one False."""
        steps = np.zeros(len(self.ids) + 1, bool)
        steps[1:-1] = (self.ids[1:] == self.ids[:-1]) & (np.diff(self.frames) == 1)
        return steps

    @cached_property
    def pieces(self) -> Integers:
        """Number of each entry's piece of track, in which no frame is missing."""
        return np.cumsum(~self.follows[:-1])

    @cached_property
    def times_s(self) -> Floats:
        """Time of each entry since the recording's first frame."""
        times: Floats = (self.frames - self.first_frame) / self.rate_hz
        return times

    @cached_property
    def own(self) -> Flags:
        """Whether an entry is of a vehicle that the scene is for."""
        if self.whole is None:
            return np.ones(len(self.ids), bool)
        own: Flags = np.isin(self.ids, self.whole.own)
        return own

    @cached_property
    def has_leaders(self) -> bool:
        """Whether any entry of the subset has a leader."""
        return bool((self.leaders != NO_LEADER).any()) if self.whole is None else self.whole.has_leaders

    @cached_property
    def road_m(self) -> tuple[float, float] | None:
        """Least and greatest position of all entries; None where they are equal, or there are none."""
        if self.whole is not None:
            return self.whole.road_m
        x_m = self.read("x_m")
        return (float(x_m.min()), float(x_m.max())) if x_m.size and x_m.min() < x_m.max() else None

    @cached_property
    def lengths_m(self) -> Floats:
        """Length of each entry's vehicle; NaN where it is unknown."""
        known = self.vehicles.sort("vehicle_id").select(
            "vehicle_id", pl.col("length_m").cast(pl.Float64).fill_null(np.nan)
        )
        starts = find_run_starts(self.ids)
        if not (known.height and starts.size):
            return np.full(len(self.ids), np.nan)
        vehicle = self.ids[starts]
        at = np.minimum(np.searchsorted(known["vehicle_id"].to_numpy(), vehicle), known.height - 1)
        length_m = np.where(known["vehicle_id"].to_numpy()[at] == vehicle, known["length_m"].to_numpy()[at], np.nan)
        return np.repeat(length_m, np.diff(starts, append=len(self.ids)))

    def find_lanes(self, vehicle: NDArray[np.integer], frame: NDArray[np.integer]) -> NDArray[np.int16]:
        """Find the lanes of vehicles at frames, (R,); NO_LANE where there is no entry, or none with a lane."""
        row, is_present = self.find_entries(vehicle, frame)
        return np.where(is_present, self.lanes[row], NO_LANE) if self.ids.size else np.full(len(vehicle), NO_LANE)

    def find_entries(self, vehicle: NDArray[np.integer], frame: NDArray[np.integer]) -> tuple[Integers, Flags]:
        """Find the rows of vehicles at frames, (R,), and whether there is one."""
        keys, wanted = self._keys, join_key(vehicle, frame)
        row = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        return row, keys[row] == wanted if len(keys) else np.zeros(len(row), bool)

    @cached_property
    def _keys(self) -> Integers:
        return join_key(self.ids, self.frames)


def measure_ttc(gap_m: Floats, closing_mps: Floats) -> Floats:
    """Measure the time to collision in s: gap / closing speed (Hayward 1972); NaN where not closing or overlapping."""
    defined = (gap_m >= 0) & (closing_mps > 0)
    ttc_s: Floats = np.divide(gap_m, closing_mps, out=np.full(len(gap_m), np.nan), where=defined)
    return ttc_s
