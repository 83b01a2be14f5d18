"""Bounds of motion along the road: no backward motion, accelerations by speed and class, jerks; what breaks them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tracklake.pipeline.transforms.reconstruction.config import MotionBounds
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate
from tracklake.schemas.arrays import Flags, Floats, Integers, find_run_starts


@dataclass(frozen=True)
class Limits:
    """Bounds at every point, (N,) each: greatest acceleration at the point's speed, deceleration and jerk."""

    accel_mps2: Floats
    braking_mps2: Floats
    jerk_mps3: Floats

    def lower_to(self, others: "Limits") -> "Limits":
        """Return the lower of both greatest accelerations; the other bounds do not depend on speed."""
        return replace(self, accel_mps2=np.minimum(self.accel_mps2, others.accel_mps2))

    def at(self, points: Integers) -> "Limits":
        """Return the bounds at some points."""
        return Limits(self.accel_mps2[points], self.braking_mps2[points], self.jerk_mps3[points])


def limit_motion(bounds: Sequence[MotionBounds], kind: Integers, speed_mps: Floats) -> Limits:
    """Return the bounds at points of the given speeds; `kind` is the place of each point's bounds in the list."""

    def pick(name: str) -> Floats:
        return np.array([getattr(one, name) for one in bounds])[kind]

    fallen = pick("accel_at_rest_mps2") - pick("accel_fall_per_s") * np.maximum(speed_mps, 0)
    return Limits(np.maximum(fallen, pick("least_accel_mps2")), pick("braking_mps2"), pick("jerk_mps3"))


def measure_motion(series: Series, x: Floats) -> dict[str, Floats]:
    """Return, by bound, the value (N,) that it bounds at each point.

    A point moves backward if its speed is negative or the next point lies behind it. Its jerk is the change of
    acceleration from the point before.
    """
    speed, accel = differentiate(series, x)
    steps = np.zeros(len(x))
    steps[:-1] = np.where(series.lie_within(1)[:-1], np.diff(x) * series.rate_hz, 0.0)
    jerk = np.zeros(len(x))
    jerk[1:] = np.diff(accel) * series.rate_hz
    jerk[series.first] = 0
    return {"backward": np.minimum(speed, steps), "acceleration": accel, "deceleration": accel, "jerk": jerk}


def find_breaks(values: Mapping[str, Floats], limits: Limits) -> dict[str, Flags]:
    """Return, by bound, the points (N,) at which the written motion breaks it."""
    return {
        "backward": values["backward"] < 0,
        "acceleration": values["acceleration"] > limits.accel_mps2,
        "deceleration": values["deceleration"] < -limits.braking_mps2,
        "jerk": np.abs(values["jerk"]) > limits.jerk_mps3,
    }


@dataclass(frozen=True)
class Runs:
    """Runs of consecutive points that break a bound: their first and last points, and the most extreme values."""

    bound: str
    first: Integers
    last: Integers
    worst: Floats

    def leave_out(self, points: Flags) -> "Runs":
        """Return the runs that do not begin at one of some points (N,)."""
        kept = ~points[self.first]
        return replace(self, first=self.first[kept], last=self.last[kept], worst=self.worst[kept])


def list_runs(series: Series, bound: str, broken: Flags, values: Floats) -> Runs:
    """List the runs of consecutive points of a piece that break a bound."""
    points = np.flatnonzero(broken)
    piece = np.repeat(np.arange(len(series.first)), series.size)[points]
    starts = find_run_starts(points - np.arange(len(points)) + piece)
    last = points[np.append(starts[1:], len(points)) - 1] if points.size else points
    extreme = np.maximum.reduceat(np.abs(values[points]), starts) if points.size else np.empty(0)
    negative = bound in ("backward", "deceleration", "overlap")
    return Runs(bound, points[starts], last, -extreme if negative else extreme)
