"""Tracks while they are being damaged, and the list of injected defects."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers


@dataclass(frozen=True)
class Defect:
    """One defect injected into a track.

    Args:
        name: late_start, overlap, backward, acceleration_spike, frozen_slow_speed, frame_gap, overlap_unseen,
            wrong_leader, wrong_headway, lane_flicker, position_jump, hard_braking, sideways_speed, size_change,
            early_end, second_track.
        value: x_m of the first entry kept (late_start) or the last one (early_end), depth in m (overlap,
            overlap_unseen), lowest speed in m/s (backward), acceleration in m/s2 (acceleration_spike, hard_braking),
            speed in m/s (frozen_slow_speed, to the right: sideways_speed), error in m (wrong_headway, position_jump,
            size_change), wrong lane (lane_flicker), the copied vehicle (second_track).
    """

    name: str
    vehicle: int
    first_frame: int
    last_frame: int
    entries: int
    value: float | None = None


@dataclass
class DamagedTracks:
    """Columns that are being damaged, (rows,) each but begins and ends (vehicles,), and the defects so far.

    `copies` are rows that stand in the file a second time, with the id of that track; `next_vehicle` is an unused id.
    """

    rate_hz: float
    random: np.random.Generator
    vehicle: Integers
    frame: Integers
    lane: Integers
    x: Floats
    length: Floats
    speed: Floats
    accel: Floats
    lateral_speed: Floats
    leader: Integers
    begins: Integers
    ends: Integers
    never_written: Flags
    lost_later: Flags
    leader_skipped: Flags
    headway_error: Floats
    next_vehicle: int
    copies: list[tuple[slice, int]] = field(default_factory=list)
    used: set[int] = field(default_factory=set)
    defects: list[Defect] = field(default_factory=list)

    def draw_frames(self, least_s: float, most_s: float) -> int:
        """Draw a number of frames, at least one, from a range of seconds."""
        return max(1, round(self.random.uniform(least_s, most_s) * self.rate_hz))

    def draw_free_vehicles(self) -> list[int]:
        """Draw the indices of vehicles without a defect, in random order."""
        return [int(index) for index in self.random.permutation(len(self.begins)) if int(index) not in self.used]

    def find_rows(self, index: int) -> slice:
        """Return the rows of a vehicle."""
        return slice(int(self.begins[index]), int(self.ends[index]))

    def add_defect(
        self, name: str, first: int, last: int, value: float | None = None, vehicle: int | None = None
    ) -> None:
        """Declare that a vehicle's entries from row `first` to row `last` are damaged, or those of their copy."""
        self.defects.append(
            Defect(
                name,
                int(self.vehicle[first]) if vehicle is None else vehicle,
                int(self.frame[first]),
                int(self.frame[last]),
                last - first + 1,
                None if value is None else float(value),
            )
        )


Injector = Callable[[DamagedTracks, int], bool]
"""Function that damages the vehicle of an index if the defect is possible there, and returns whether it did."""


def draw_run(work: DamagedTracks, place: int, wanted: int, margin: int) -> tuple[int, int] | None:
    """Draw a run of `wanted` rows at least `margin` rows from both ends of the track: its first and last row."""
    rows = work.find_rows(place)
    room = rows.stop - rows.start - 2 * margin - wanted
    if room < 0:
        return None
    first = rows.start + margin + int(work.random.integers(room + 1))
    return first, first + wanted - 1
