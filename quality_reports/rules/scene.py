"""One subset as arrays: its entries, its vehicles, its road and its camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import Floats, Integers

ABSENT = -1
"""Index of a row, track or lane that does not exist."""
UNITS_PER_M = 10_000
"""Units of compared positions in a metre: tenths of a millimetre; files have 0.3 mm (0.001 ft) or 1 cm."""
VEHICLE_COLUMNS = ("length_m", "width_m", "class", "length_range_m", "width_range_m")
"""Columns of `vehicles` that rules may read."""
SUBSET_COLUMNS = ("frame_rate_hz", "lane_markings_m", "lanes", "on_ramp_lanes", "first_frame", "last_frame")
"""Columns of `subsets` that rules may read, in the order of a Scene's arguments."""
T = TypeVar("T")


@dataclass(frozen=True)
class Whole:
    """What rules need to know of a whole subset to judge a slice of it.

    Args:
        own_frames: first frame that the slice owns, and the one behind its last; other entries are context.
        shared_frames: one, other, frames: for how many frames two vehicles share a place, by their ids.
        ends_at_bumpers: whether recorded headways end at the leader's rear.
    """

    own_frames: tuple[int, int]
    shared_frames: pl.DataFrame
    ends_at_bumpers: bool


@dataclass(frozen=True)
class Scene:
    """Input of a subset's derived columns; it is never changed.

    Args:
        tracks: ONE subset's entries, sorted by vehicle_id, frame, each pair once.
        vehicles: vehicle_id and VEHICLE_COLUMNS of that subset, each id once; a vehicle that is not in it is of unknown
            size and class.
        frame_rate_hz: frame rate of the source.
        lane_markings_m: y_m of the lane markings, leftmost first; None where unknown.
        lanes: number of main lanes; None where unknown.
        on_ramp_lanes: lanes that are on-ramps.
        first_frame: the recording's first frame.
        last_frame: the subset's last frame.
        whole: what is known of the whole subset where the tracks are a slice of it; None where they are all.
        results: what `once` has computed, by function.
    """

    tracks: pl.DataFrame
    vehicles: pl.DataFrame
    frame_rate_hz: float
    lane_markings_m: Sequence[float] | None = None
    lanes: int | None = None
    on_ramp_lanes: Sequence[int] = ()
    first_frame: int | None = None
    last_frame: int | None = None
    whole: "Whole | None" = None
    results: dict[Callable[["Scene"], Any], Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def once(self, compute: Callable[["Scene"], T]) -> T:
        """Return the result of a function of the scene, which several derived columns share."""
        if compute not in self.results:
            self.results[compute] = compute(self)
        found: T = self.results[compute]
        return found

    @property
    def height(self) -> int:
        """Number of entries in the subset."""
        return self.tracks.height

    @cached_property
    def vehicle_id(self) -> NDArray[np.int32]:
        """Vehicle of each entry, (N,)."""
        return self.tracks["vehicle_id"].to_numpy()

    @cached_property
    def frame(self) -> NDArray[np.int32]:
        """Frame of each entry, (N,)."""
        return self.tracks["frame"].to_numpy()

    @cached_property
    def begins(self) -> Integers:
        """Row of each track's first entry, (V,)."""
        if not self.height:
            return np.empty(0, np.int64)
        return np.flatnonzero(np.concatenate([[True], self.vehicle_id[1:] != self.vehicle_id[:-1]]))

    @cached_property
    def ends(self) -> Integers:
        """Row after each track's last entry, (V,)."""
        return np.append(self.begins[1:], self.height)[: len(self.begins)]

    @cached_property
    def track(self) -> NDArray[np.int32]:
        """Track of each entry, counted from 0, (N,)."""
        return np.repeat(np.arange(len(self.begins), dtype=np.int32), self.ends - self.begins)

    @cached_property
    def age(self) -> NDArray[np.int32]:
        """Entries since the track's first one or its last frame gap, (N,)."""
        rows = np.arange(self.height, dtype=np.int32)
        follows = np.zeros(self.height, np.bool_)
        follows[1:] = (self.vehicle_id[1:] == self.vehicle_id[:-1]) & (self.frame[1:] - self.frame[:-1] == 1)
        age: NDArray[np.int32] = rows - np.maximum.accumulate(np.where(follows, 0, rows))
        return age

    @cached_property
    def x_units(self) -> Integers:
        """Position x_m in tenths of a millimetre, (N,)."""
        x: Floats = self.tracks["x_m"].to_numpy()
        return np.rint(x * UNITS_PER_M).astype(np.int64)

    @cached_property
    def headings(self) -> Floats:
        """Direction of each entry's body, rad, 0 where the source records none, (N,)."""
        headings: Floats = self.tracks["heading_rad"].cast(pl.Float64).fill_null(0.0).to_numpy()
        return headings

    @cached_property
    def leader(self) -> Integers:
        """Track of the recorded leader, ABSENT where none is recorded or it has no track, (N,)."""
        return self._find_tracks(self.tracks["leader_id"].fill_null(ABSENT).to_numpy())

    @cached_property
    def lane(self) -> NDArray[np.int32]:
        """Lane of each entry, ABSENT where it is unknown, (N,)."""
        return self.tracks["lane"].cast(pl.Int32).fill_null(ABSENT).to_numpy()

    @cached_property
    def traits(self) -> pl.DataFrame:
        """VEHICLE_COLUMNS of each track, null where unknown, (V,)."""
        tracks = pl.DataFrame({"vehicle_id": self.vehicle_id[self.begins]}, schema={"vehicle_id": pl.Int32})
        return tracks.join(self.vehicles, on="vehicle_id", how="left", maintain_order="left").select(VEHICLE_COLUMNS)

    def measurements(self, column: str) -> NDArray[Any]:
        """Return a column of floats in its own dtype, NaN where null, (N,)."""
        values: NDArray[Any] = self.tracks[column].fill_null(np.nan).to_numpy()
        return values

    def trait(self, column: str) -> NDArray[np.float32]:
        """Return length_m or width_m of each track, NaN where unknown, and NaN for ABSENT as the last, (V + 1,)."""
        known: NDArray[np.float32] = self.traits[column].cast(pl.Float32).fill_null(np.nan).to_numpy()
        return np.append(known, np.float32(np.nan))

    @cached_property
    def leader_row(self) -> Integers:
        """Row of the recorded leader's entry in the same frame, ABSENT where it has none, (N,)."""
        led = np.flatnonzero(self.leader != ABSENT)
        track, frame = self.leader[led], self.frame[led]
        first, last = self.begins[track], self.ends[track] - 1
        # A track without gaps has its entry of that frame so many rows after its first.
        guess = np.clip(first + (frame.astype(np.int64) - self.frame[first]), first, last)
        hit = self.frame[guess] == frame
        rows = np.full(self.height, ABSENT, np.int64)
        rows[led[hit]] = guess[hit]
        unmatched = np.flatnonzero(~hit & (frame > self.frame[first]) & (frame < self.frame[last]))
        if unmatched.size:
            span = int(self.frame.max()) + 1
            wanted = track[unmatched] * span + frame[unmatched]
            keys = self.track.astype(np.int64) * span + self.frame
            found = np.searchsorted(keys, wanted)
            there = keys[found] == wanted
            rows[led[unmatched[there]]] = found[there]
        return rows

    def _find_tracks(self, ids: NDArray[np.int32]) -> Integers:
        """Find the tracks of vehicles, ABSENT where there is none; ids stay the same over long stretches."""
        if not self.height:
            return np.empty(0, np.int64)
        begins = np.flatnonzero(np.concatenate([[True], ids[1:] != ids[:-1]]))
        known, wanted = self.vehicle_id[self.begins], ids[begins]
        found = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        tracks = np.where(known[found] == wanted, found, ABSENT)
        return np.repeat(tracks, np.diff(begins, append=self.height))


def find_lacking(vehicles: pl.DataFrame, facts: pl.DataFrame) -> frozenset[str]:
    """Find the columns of `tracks`, `vehicles` and `subsets` that one subset's source does not have."""
    row = facts.row(0, named=True)
    lacking = set(row["columns_missing"])
    lacking |= {name for name in VEHICLE_COLUMNS if vehicles[name].null_count() == vehicles.height}
    lacking |= {name for name in SUBSET_COLUMNS if row[name] is None}
    return frozenset(lacking)
