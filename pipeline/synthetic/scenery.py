"""Entries of a subset as the slow loops see them: by frame and lane, with gaps and the past of each vehicle.

The module shares no code with the pipeline, its sources or its rules; see `expected_findings`.
"""

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from statistics import median

Key = tuple[int, int]
"""Key of an entry: vehicle and frame."""
RUNNING_S = 1.0
"""Time after the recording's beginning and before its end in which tracks may begin or end anywhere, in s."""
BORDER_M = 20.0
SPACING_M = 100.0
"""Distances of cross sections from the section's ends and from each other, in m."""
SAME_PLACE_SHARE = 0.7
"""Share of the smaller of two boxes that lies in the other where two tracks are one vehicle."""


@dataclass(frozen=True)
class Entry:
    """One row of a file in SI units: the front centre, `y` from the leftmost marking, `heading` to the right in rad.

    `length` and `width` are the vehicle's; `box` is the row's own length and width, if it has them; `lateral` the
    recorded speed to the right, None where positions give it.
    """

    front: float
    length: float
    speed: float
    accel: float
    leader: int
    headway: float | None
    y: float = 0.0
    width: float = 0.0
    lane: int = 1
    kind: str = "car"
    heading: float = 0.0
    lateral: float | None = None
    box: tuple[float, float] | None = None

    @cached_property
    def middle(self) -> tuple[float, float]:
        """Middle of the body: along and across the road."""
        back = self.length / 2
        return self.front - back * math.cos(self.heading), self.y - back * math.sin(self.heading)

    @cached_property
    def radius(self) -> float:
        """Distance from the middle of the body to its corners."""
        return math.hypot(self.length, self.width) / 2

    @cached_property
    def corners(self) -> list[tuple[float, float]]:
        """Corners of the body, in turn."""
        ahead = math.cos(self.heading), math.sin(self.heading)
        x, y = self.middle
        turns = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return [
            (
                x + (long * self.length * ahead[0] - wide * self.width * ahead[1]) / 2,
                y + (long * self.length * ahead[1] + wide * self.width * ahead[0]) / 2,
            )
            for long, wide in turns
        ]

    def meets(self, other: "Entry") -> bool:
        """Test whether two boxes overlap by half a millimetre or more; across comes first, as it parts lanes."""
        return all(
            round(one.overlap_along(two, axis), 3) > 0 for axis in (1, 0) for one, two in ((self, other), (other, self))
        )

    def overlap_along(self, other: "Entry", axis: int) -> float:
        """Compute how far two boxes overlap along (0) or across (1) this one, in m; negative = apart."""
        cosine, sine = math.cos(self.heading), math.sin(self.heading)
        ahead, aside = ((cosine, sine), (-sine, cosine))[axis]
        own = [ahead * x + aside * y for x, y in self.corners]
        theirs = [ahead * x + aside * y for x, y in other.corners]
        return min(max(own) - min(theirs), max(theirs) - min(own))

    def shares_place(self, other: "Entry") -> bool:
        """Test whether most of the smaller of two boxes lies in the other."""
        is_near = math.dist(self.middle, other.middle) < self.radius + other.radius  # spares most of the comparisons
        if not is_near or not self.meets(other):
            return False
        length, width = min(self.length, other.length), min(self.width, other.width)
        inside = max(
            min(one.overlap_along(two, 0), length) * min(one.overlap_along(two, 1), width)
            for one, two in ((self, other), (other, self))
        )
        return inside / min(self.length * self.width, other.length * other.width) >= SAME_PLACE_SHARE


@dataclass(frozen=True)
class Surface:
    """The road and the camera of a subset.

    Args:
        markings: y of the lane markings, leftmost first; empty = unknown.
        headway_stands_in: whether a recorded headway gives the gap to a leader without an entry in the frame.
        has_headings: whether the source tells where bodies point.
        lanes: number of main lanes.
        ramps: lanes that are on-ramps.
        first_frame: the recording's first frame; None = that of the first entry.
    """

    rate_hz: float = 10.0
    markings: tuple[float, ...] = ()
    headway_stands_in: bool = True
    has_headings: bool = False
    lanes: int = 5
    ramps: tuple[int, ...] = (7,)
    first_frame: int | None = None


@dataclass
class Scenery:
    """The entries of a subset, indexed by frame and lane."""

    entries: dict[Key, Entry]
    surface: Surface

    def __post_init__(self) -> None:
        """Sort entries by frame and lane, and collect facts about every track."""
        self.lengths = {vehicle: entry.length for (vehicle, _), entry in self.entries.items()}
        self.in_frame: dict[int, list[Key]] = {}
        self.in_lane: dict[tuple[int, int], list[Key]] = {}
        for key in sorted(self.entries, key=lambda key: self.entries[key].front):
            self.in_frame.setdefault(key[1], []).append(key)
            self.in_lane.setdefault((key[1], self.entries[key].lane), []).append(key)
        self.frame_place = {key: place for keys in self.in_frame.values() for place, key in enumerate(keys)}
        self.lane_place = {key: place for keys in self.in_lane.values() for place, key in enumerate(keys)}
        frames = [frame for _, frame in self.entries]
        self.first_frame = min(frames, default=0) if self.surface.first_frame is None else self.surface.first_frame
        self.last_frame = max(frames, default=0)
        self.first_frames: dict[int, int] = {}
        self.last_frames: dict[int, int] = {}
        self.boxes: dict[int, list[tuple[float, float]]] = {}
        self.lane_changes: dict[int, int] = {}
        self.unbroken: dict[Key, int] = {}
        for key in sorted(self.entries):
            before = self.near(key, -1)
            self.first_frames.setdefault(*key)
            self.last_frames[key[0]] = key[1]
            if (box := self.entries[key].box) is not None:
                self.boxes.setdefault(key[0], []).append(box)
            self.unbroken[key] = 0 if before is None else self.unbroken[key[0], key[1] - 1] + 1
            if before is not None and before.lane != self.entries[key].lane:
                self.lane_changes[key[0]] = self.lane_changes.get(key[0], 0) + 1
        self.from_fronts = self._counts_from_fronts()

    def near(self, key: Key, frames: int) -> Entry | None:
        """Return the vehicle's entry a number of frames later (negative: earlier)."""
        return self.entries.get((key[0], key[1] + frames))

    def gap(self, key: Key) -> float | None:
        """Compute the gap from bumper to bumper in m; None = unknown."""
        own = self.entries[key]
        if own.leader == 0:
            return None
        leader = self.entries.get((own.leader, key[1]))
        if leader is not None:
            return round(leader.front - leader.length - own.front, 3)
        known = self.surface.headway_stands_in and own.headway is not None and own.leader in self.lengths
        if known and own.headway is not None and own.headway > 0:
            return round(own.headway - self.lengths[own.leader], 3)
        return None

    def recorded_gap(self, key: Key) -> float | None:
        """Compute the gap from bumper to bumper in m by the recorded headway."""
        own = self.entries[key]
        if own.leader == 0 or own.headway is None or own.leader not in self.lengths:
            return None
        return round(own.headway - (self.lengths[own.leader] if self.from_fronts else 0), 3)

    def _counts_from_fronts(self) -> bool:
        self.from_fronts = True
        known = [
            (front, self.lengths[self.entries[key].leader], gap)
            for key in self.entries
            if (front := self.recorded_gap(key)) is not None and (gap := self.gap(key)) is not None
        ]
        if not known:
            return True
        as_fronts = median(abs(front - gap) for front, _, gap in known)
        return as_fronts <= median(abs(front + length - gap) for front, length, gap in known)

    def past_accel(self, key: Key, tenths: int) -> float | None:
        """Return the acceleration some tenths of a second before; between two frames the mean of both."""
        around = self._find_entries_around(key, tenths)
        return None if around is None else sum(self.entries[each].accel for each in around) / 2

    def past_lateral_speed(self, key: Key, tenths: int) -> float | None:
        """Return the speed to the right some tenths of a second before; between two frames the mean of both."""
        speeds = [self.lateral_speed(each) for each in self._find_entries_around(key, tenths) or ()]
        known = [speed for speed in speeds if speed is not None]
        return sum(known) / 2 if len(known) == 2 else None

    def _find_entries_around(self, key: Key, tenths: int) -> tuple[Key, Key] | None:
        frames = tenths * self.surface.rate_hz / 10
        if self.unbroken[key] < frames:
            return None
        return (key[0], key[1] - math.floor(frames)), (key[0], key[1] - math.ceil(frames))

    def lateral_speed(self, key: Key) -> float | None:
        """Return the recorded speed to the right in m/s, else that of the positions one frame before and after."""
        before, after = self.near(key, -1), self.near(key, 1)
        if (recorded := self.entries[key].lateral) is not None:
            return recorded
        return None if before is None or after is None else (after.y - before.y) * self.surface.rate_hz / 2

    def size_range(self, vehicle: int, side: int) -> float | None:
        """Compute how much the length (0) or width (1) varies in a vehicle's rows, in m; None = unknown."""
        found = self._size_ranges.get(vehicle)
        return None if found is None else found[side]

    @cached_property
    def _size_ranges(self) -> dict[int, list[float]]:
        return {
            vehicle: [round(max(sizes) - min(sizes), 3) for sizes in zip(*boxes, strict=True)]
            for vehicle, boxes in self.boxes.items()
        }

    def appears(self, key: Key) -> bool:
        """Test whether an entry is the first of a track that begins in a main lane a second into the recording."""
        begins, running = self.first_frames[key[0]] == key[1], key[1] - self.first_frame
        return begins and self._is_main(key) and running >= RUNNING_S * self.surface.rate_hz

    def vanishes(self, key: Key) -> bool:
        """Test whether an entry is the last of a track that ends in a main lane a second before the recording does."""
        ends, running = self.last_frames[key[0]] == key[1], self.last_frame - key[1]
        return ends and self._is_main(key) and running >= RUNNING_S * self.surface.rate_hz

    def _is_main(self, key: Key) -> bool:
        lane = self.entries[key].lane
        return 1 <= lane <= self.surface.lanes and lane not in self.surface.ramps

    @cached_property
    def section(self) -> tuple[float, float]:
        """Where the section begins and ends in m, by tracks that do so while the recording runs; NaN = unknown."""
        starts = [self.entries[key].front for key in self.first_frames.items() if self.appears(key)]
        ends = [self.entries[key].front for key in self.last_frames.items() if self.vanishes(key)]
        return _interpolate(sorted(starts), 0.1), _interpolate(sorted(ends), 0.9)

    @cached_property
    def cross_sections(self) -> list[float]:
        """Positions of the cross sections in m; none where there is no room for two."""
        begin, end = self.section
        places: list[float] = []
        while begin + BORDER_M + SPACING_M * len(places) <= end - BORDER_M:
            places.append(begin + BORDER_M + SPACING_M * len(places))
        return places if len(places) > 1 else []

    @cached_property
    def doubles(self) -> dict[Key, set[int]]:
        """The other vehicles that share an entry's place, by entry."""
        doubles: dict[Key, set[int]] = {}
        for keys in self.in_frame.values():
            for place, key in enumerate(keys):
                for other in keys[place + 1 :]:
                    one, two = self.entries[key], self.entries[other]
                    if two.front - one.front > max(one.length, two.length):
                        break
                    if one.shares_place(two):
                        doubles.setdefault(key, set()).add(other[0])
                        doubles.setdefault(other, set()).add(key[0])
        return doubles

    @cached_property
    def frames_together(self) -> Counter[tuple[int, int]]:
        """Number of frames in which two vehicles share a place, by both vehicles."""
        return Counter((vehicle, other) for (vehicle, _), others in self.doubles.items() for other in others)


def _interpolate(values: list[float], share: float) -> float:
    """Return the value at a share of a sorted list, linear between two; NaN of an empty one."""
    if not values:
        return math.nan
    place = share * (len(values) - 1)
    low, high = values[math.floor(place)], values[math.ceil(place)]
    return low + (high - low) * (place - math.floor(place))
