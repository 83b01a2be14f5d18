"""Bent roads of the sample: straight simulated carriageways laid along a line, and their scenarios.

The module shares no code with the pipeline's road axes, so that one can be checked by the other.
"""

from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.synthetic.scenarios import CLEAN, Road, Traffic
from tracklake.schemas.arrays import Floats

POINT_M = 0.1
"""Distance of two points of a line, in m."""
BEYOND_M = 80.0
"""Length of road before and behind the recorded window, in m."""


@dataclass(frozen=True)
class Line:
    """Points of a line and its directions there, counterclockwise from east; the first is at `begin_m`."""

    x_m: Floats
    y_m: Floats
    angle_rad: Floats
    begin_m: float

    @property
    def places(self) -> Floats:
        """Places of the points along the line, in m."""
        return self.begin_m + POINT_M * np.arange(len(self.x_m), dtype=np.float64)

    def locate(self, along_m: Floats, right_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the positions (N,) of places along and to the right of the line, and the line's directions there."""
        at = self.places
        x, y, angle = (np.interp(along_m, at, values) for values in (self.x_m, self.y_m, self.angle_rad))
        return x + right_m * np.sin(angle), y - right_m * np.cos(angle), angle

    def measure_bend(self, along_m: Floats) -> Floats:
        """Measure how much the line turns to the left per metre, (N,)."""
        bend: Floats = np.interp(along_m, self.places[1:] - POINT_M / 2, np.diff(self.angle_rad) / POINT_M)
        return bend


@dataclass(frozen=True)
class Course:
    """The course of a carriageway's left edge: where its window begins, and bends of so many metres and 1/m.

    With `opposite` the carriageway leads back beside this line, behind a median of so many metres.
    """

    start_m: tuple[float, float]
    angle_deg: float
    bends: tuple[tuple[float, float], ...]
    opposite_m: float | None = None

    def draw(self) -> Line:
        """Draw the line, and BEYOND_M straight on at either end."""
        pieces = ((BEYOND_M, 0.0), *self.bends, (BEYOND_M, 0.0))
        bend = np.concatenate([np.full(round(length / POINT_M), bend) for length, bend in pieces])
        angle = np.radians(self.angle_deg) + np.concatenate([[0.0], np.cumsum(bend * POINT_M)])
        between = (angle[1:] + angle[:-1]) / 2
        x, y = (np.concatenate([[0.0], np.cumsum(POINT_M * turns)]) for turns in (np.cos(between), np.sin(between)))
        first = round(BEYOND_M / POINT_M)
        line = Line(x + self.start_m[0] - x[first], y + self.start_m[1] - y[first], angle, -BEYOND_M)
        if self.opposite_m is None:
            return line
        back_x, back_y, _ = line.locate(line.places, np.full(len(x), -self.opposite_m))
        back_x, back_y = back_x[::-1], back_y[::-1]
        ways = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(back_x), np.diff(back_y)))])
        at = np.arange(0.0, ways[-1], POINT_M)
        back_x, back_y = np.interp(at, ways, back_x), np.interp(at, ways, back_y)
        return Line(back_x, back_y, np.unwrap(np.arctan2(np.gradient(back_y), np.gradient(back_x))), -BEYOND_M)


@dataclass(frozen=True)
class Way:
    """One carriageway, or one way over a junction."""

    name: str
    course: Course
    traffic: Traffic


@dataclass(frozen=True)
class LevelxScenario:
    """One recording of two carriageways in the format of exiD, inD or rounD.

    Args:
        index: part of the random seeds; that of the second carriageway is one more.
        has_map: whether a Lanelet2 map is written.
        other_sizes: record sizes in tracksMeta that differ from those in tracks, as at exiD's location 0.
    """

    dataset: str
    recording: str
    location_id: int
    road: Road
    share: float
    ways: tuple[Way, Way]
    index: int
    has_map: bool = False
    other_sizes: bool = False


ENTRY = Road(lanes=3, lane_width_m=3.6, window_m=480.0, rate_hz=25.0, limit_mps=30.0, ramp=True)
TWO_LANES = Road(lanes=2, lane_width_m=3.6, window_m=400.0, rate_hz=25.0, limit_mps=30.0)
STREET = Road(lanes=1, lane_width_m=3.5, window_m=110.0, rate_hz=25.0, limit_mps=7.0)
_CORNER = ((43.0, 0.0), (24.0, -np.pi / 48), (43.0, 0.0))
_CIRCLE = ((29.0, 0.0), (12.0, -np.pi / 48), (28.0, np.pi / 56), (12.0, -np.pi / 48), (29.0, 0.0))

_ENTRY_M, _ENTRY_BENDS = (60.0, -80.0), ((240.0, -1 / 900), (240.0, 1 / 700))
_NORTH_M, _NORTH_BENDS = (90.0, -420.0), ((400.0, 1 / 1500),)

EXID = (
    LevelxScenario(
        "exid", "00", 0, ENTRY, 0.9,
        (
            Way("east", Course(_ENTRY_M, 12.0, _ENTRY_BENDS), Traffic(0.25, 0.2, ramp_arrivals=0.1, plan=CLEAN)),
            Way("west", Course(_ENTRY_M, 12.0, _ENTRY_BENDS, 4.0), Traffic(0.3, ramp_arrivals=0.1, plan=CLEAN)),
        ),
        index=220, has_map=True, other_sizes=True,
    ),
    LevelxScenario(
        "exid", "19", 1, TWO_LANES, 0.5,
        (
            Way("north", Course(_NORTH_M, 80.0, _NORTH_BENDS), Traffic(0.25, plan=CLEAN)),
            Way("south", Course(_NORTH_M, 80.0, _NORTH_BENDS, 4.0), Traffic(0.35, plan=CLEAN)),
        ),
        index=222,
    ),
)  # fmt: skip
"""Recordings in exiD's format: the second one has no map."""
IND = (
    LevelxScenario(
        "ind", "07", 1, STREET, 0.6,
        (
            Way("south-to-east", Course((62.0, -110.0), 90.0, _CORNER), Traffic(0.15, bottleneck_mps=7.0, plan=CLEAN)),
            Way("north-to-west", Course((54.0, 10.0), -90.0, _CORNER), Traffic(0.12, bottleneck_mps=7.0, plan=CLEAN)),
        ),
        index=224,
    ),
)  # fmt: skip
ROUND = (
    LevelxScenario(
        "round", "12", 0, STREET, 0.6,
        (
            Way("south-to-north", Course((62.0, -110.0), 90.0, _CIRCLE), Traffic(0.15, bottleneck_mps=7.0, plan=CLEAN)),
            Way("north-to-south", Course((58.0, 0.0), -90.0, _CIRCLE), Traffic(0.12, bottleneck_mps=7.0, plan=CLEAN)),
        ),
        index=226,
    ),
)  # fmt: skip
BENT = {"exid": EXID, "ind": IND, "round": ROUND}
"""Recordings by format."""
