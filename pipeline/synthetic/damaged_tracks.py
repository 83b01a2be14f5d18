"""Tracks while they are being damaged, and the list of what was done to them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Defect:
    """One injected defect.

    Args:
        name: late_start, overlap, backward, acceleration_spike, frozen_slow_speed, frame_gap, overlap_unseen,
            wrong_leader, wrong_headway, lane_flicker, position_jump.
        vehicle: whose.
        first_frame: of the damaged or missing entries.
        last_frame: of them.
        entries: how many.
        value: late_start the x_m of the first entry kept; overlap and overlap_unseen the depth in m; backward the
            lowest speed in m/s; acceleration_spike the acceleration in m/s2; frozen_slow_speed the speed in m/s;
            wrong_headway and position_jump the error in m; lane_flicker the wrong lane.
    """

    name: str
    vehicle: int
    first_frame: int
    last_frame: int
    entries: int
    value: float | None = None


@dataclass
class Work:
    """Columns being damaged, and who has been; all arrays are of shape (rows,) but begins and ends: (vehicles,)."""

    rate_hz: float
    random: np.random.Generator
    vehicle: Integers
    frame: Integers
    lane: Integers
    x: Floats
    length: Floats
    speed: Floats
    accel: Floats
    leader: Integers
    begins: Integers
    ends: Integers
    never_written: npt.NDArray[np.bool_]
    lost_later: npt.NDArray[np.bool_]
    leader_skipped: npt.NDArray[np.bool_]
    headway_error: Floats
    used: set[int] = field(default_factory=set)
    defects: list[Defect] = field(default_factory=list)

    def seconds(self, least: float, most: float) -> int:
        """A random number of frames, at least one."""
        return max(1, round(self.random.uniform(least, most) * self.rate_hz))

    def free(self) -> list[int]:
        """Vehicles (their places) without a defect, shuffled."""
        return [int(place) for place in self.random.permutation(len(self.begins)) if int(place) not in self.used]

    def rows(self, place: int) -> slice:
        """The rows of a vehicle."""
        return slice(int(self.begins[place]), int(self.ends[place]))

    def note(self, name: str, first: int, last: int, value: float | None = None) -> None:
        """Declare the entries from row `first` to row `last` of one vehicle damaged."""
        self.defects.append(
            Defect(
                name,
                int(self.vehicle[first]),
                int(self.frame[first]),
                int(self.frame[last]),
                last - first + 1,
                None if value is None else float(value),
            )
        )


Inflict = Callable[[Work, int], bool]
"""Damages one vehicle (its place) where the defect makes sense there, and says whether it did."""


def pick_run(work: Work, place: int, wanted: int, margin: int) -> tuple[int, int] | None:
    """A random run of `wanted` rows at least `margin` rows from both ends of the track: first and last row."""
    rows = work.rows(place)
    room = rows.stop - rows.start - 2 * margin - wanted
    if room < 0:
        return None
    first = rows.start + margin + int(work.random.integers(room + 1))
    return first, first + wanted - 1
