"""Derived columns that compare the entries of one track: jumps, gaps, jerk, lane changes."""

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.quality_reports.rules.scene import ABSENT, Scene
from tracklake.schemas.arrays import Flags, Floats, Singles

CLOCK_HZ = 10.0
"""Rate at which jerk is measured (DESIGN section 5)."""
TICKS = 10
"""Number of jerks in one second."""
NO_CHANGE_MPS2 = 5e-5
"""Least change of a recorded acceleration that counts, in m/s²; the Float32 of 100 m/s² errs by 4e-6."""


def measure_jumps(scene: Scene) -> Floats:
    """Measure abs(dx - dt (v1 + v2) / 2) to the entry before, m, to 1 um; NaN without an entry one frame before."""
    x, speed = scene.tracks["x_m"].to_numpy(), scene.tracks["speed_mps"].to_numpy().astype(np.float64)
    jump = np.full(scene.height, np.nan)
    jump[1:] = np.abs(np.diff(x) - (speed[1:] + speed[:-1]) / 2 / scene.frame_rate_hz)
    jump[scene.age == 0] = np.nan
    # What equals the threshold in the source's decimals must not exceed it by the last bit.
    return np.round(jump, 6)


def count_skipped_frames(scene: Scene) -> NDArray[np.int32]:
    """Count the frames missing between an entry and the one before of its track; 0 in a track's first entry."""
    skipped = np.zeros(scene.height, np.int32)
    skipped[1:] = np.diff(scene.frame) - 1
    skipped[scene.begins] = 0
    return skipped


def measure_jerk(scene: Scene) -> Floats:
    """Measure (a(t) - a(t - 0.1 s)) / 0.1 s of the recorded acceleration, m/s³, to 0.001; NaN without either."""
    change = _get_past(scene, 0).astype(np.float64) - _get_past(scene, 1)
    return np.round(change * CLOCK_HZ, 3)


def measure_lateral_acceleration(scene: Scene) -> Floats:
    """Measure the change of the lateral speed in the last 0.1 s / 0.1 s, m/s², to 0.001; NaN without either."""
    now, before = (_get_past(scene, tick, "lateral_speed_mps") for tick in (0, 1))
    return np.round((now.astype(np.float64) - before) * CLOCK_HZ, 3)


def measure_heading_error(scene: Scene) -> Floats:
    """Measure the angle between an entry's heading and its motion, rad, to 0.0001; NaN without a heading."""
    speed, aside, heading = (scene.measurements(name) for name in ("speed_mps", "lateral_speed_mps", "heading_rad"))
    error: Floats = np.round(np.abs(heading - np.arctan2(aside, speed)).astype(np.float64), 4)
    return error


def count_jerk_reversals(scene: Scene) -> NDArray[np.int8]:
    """Count the changes of sign among the ten jerks, 0.1 s apart, of the second that ends at an entry.

    Jerks of zero and missing ones are skipped: at a track's beginning and after a frame gap the second is shorter.
    """
    return scene.once(_compare_jerks)[0]


def find_jerk_reversals(scene: Scene) -> pl.Series:
    """Return whether an entry's jerk has another sign than the last one of the second before; null without a jerk.

    Jerks of zero and missing ones are skipped, as `count_jerk_reversals` does.
    """
    reverses = scene.once(_compare_jerks)[1]
    has_jerk = ~np.isnan(_get_past(scene, 0) - _get_past(scene, 1))
    return pl.Series(reverses).set(pl.Series(~has_jerk), None)


def _compare_jerks(scene: Scene) -> tuple[NDArray[np.int8], Flags]:
    """Count each entry's changes of sign within a second; also return whether its own jerk is one."""
    reversals = np.zeros(scene.height, np.int8)
    sign = np.zeros(scene.height, np.int8)
    before = _get_past(scene, TICKS)
    for tick in range(TICKS - 1, -1, -1):
        now = _get_past(scene, tick)
        change = now - before
        new = (change > NO_CHANGE_MPS2).view(np.int8) - (change < -NO_CHANGE_MPS2).view(np.int8)
        reverses = (new * sign) < 0
        reversals += reverses
        np.copyto(sign, new, where=new != 0)
        before = now
    return reversals, reverses


def _get_past(scene: Scene, tick: int, column: str = "accel_mps2") -> Singles:
    """Return what was recorded `tick` tenths of a second before each entry; NaN where it is missing.

    At 25 Hz every other tick lies between two frames; the value there is linear between theirs (their mean). Rates at
    which it lies elsewhere between frames have none: nothing is interpolated over longer.
    """
    values: Singles = scene.measurements(column)
    halves = 2 * tick * scene.frame_rate_hz / CLOCK_HZ
    if halves % 1 or scene.frame_rate_hz < CLOCK_HZ:
        return np.full(scene.height, np.nan, np.float32)
    low, rest = divmod(int(halves), 2)
    past = _shift(values, low)
    if rest:
        past += _shift(values, low + 1)
        past /= 2
    past[scene.age < low + rest] = np.nan
    return past


def _shift(values: Singles, rows: int) -> Singles:
    """Return the values so many rows before, NaN where there are none."""
    if rows == 0:
        return values.copy()
    shifted = np.full(len(values), np.nan, np.float32)
    shifted[rows:] = values[:-rows]
    return shifted


def measure_lane_stays(scene: Scene) -> Floats:
    """Measure the seconds that a vehicle stays in a lane between two stays in one other lane; NaN for other stays.

    A stay that begins or ends at a frame gap or at the end of the track has no length.
    """
    stays = np.full(scene.height, np.nan)
    if not scene.height:
        return stays
    lane, entered = scene.lane, scene.age > 0
    changed: Flags = np.ones(scene.height, np.bool_)
    changed[1:] = (lane[1:] != lane[:-1]) | ~entered[1:]
    begins = np.flatnonzero(changed)
    entries = np.diff(begins, append=scene.height)
    of, follows = lane[begins], entered[begins]
    between = np.zeros(len(begins), np.bool_)
    between[1:-1] = follows[1:-1] & follows[2:] & (of[:-2] == of[2:])
    between[1:-1] &= (of[1:-1] != ABSENT) & (of[2:] != ABSENT)
    seconds = np.where(between, entries / scene.frame_rate_hz, np.nan)
    return np.repeat(seconds, entries)


def measure_way_out_of_lane(scene: Scene) -> Floats:
    """Measure how far the body's middle lies outside the markings of the entry's lane, m, to 1 mm; NaN if unknown.

    The middle lies half a length behind the front centre, against the heading. 0 = inside.
    """
    if scene.lane_markings_m is None or len(scene.lane_markings_m) < 2:
        return np.full(scene.height, np.nan)
    markings = np.asarray(scene.lane_markings_m, np.float64)
    known = (scene.lane >= 1) & (scene.lane < len(markings))
    lane = np.where(known, scene.lane, 1)
    half_length = scene.trait("length_m")[scene.track].astype(np.float64) / 2
    y = scene.tracks["y_m"].to_numpy() - half_length * np.sin(scene.headings)
    outside = np.maximum(np.maximum(markings[lane - 1] - y, y - markings[lane]), 0.0)
    return np.where(known, np.round(outside, 3), np.nan)


def repeat_trait(scene: Scene, column: str) -> pl.Series:
    """Repeat a column of `vehicles` for each entry."""
    return scene.traits[column].gather(scene.track)


def repeat_motion_class(scene: Scene) -> pl.Series:
    """Repeat the class of each entry's vehicle for the bounds of its motion: where it is unknown, that of a car."""
    return scene.traits["class"].fill_null("car").gather(scene.track)
