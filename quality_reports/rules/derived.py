"""Derived columns that rules read besides those of `tracks`, declared once and computed on demand."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import polars as pl
from numpy.typing import NDArray

from tracklake.quality_reports.rules import along_tracks as along
from tracklake.quality_reports.rules import cross_sections as sections
from tracklake.quality_reports.rules import within_frames as within
from tracklake.quality_reports.rules.along_messages import DRIVE_READS
from tracklake.quality_reports.rules.scene import VEHICLE_COLUMNS, Scene

MOTION = ("vehicle_id", "frame", "x_m", "speed_mps", "frame_rate_hz")
ACCELERATION = ("vehicle_id", "frame", "accel_mps2", "frame_rate_hz")
PLANE = ("vehicle_id", "frame", "x_m", "y_m", "heading_rad", "length_m", "width_m")
LANE_ORDER = ("vehicle_id", "frame", "x_m", "lane")
LEADER = ("vehicle_id", "frame", "x_m", "leader_id")
RECORDING = ("frame_rate_hz", "lanes", "on_ramp_lanes", "first_frame", "last_frame")
ENDS = (*LANE_ORDER, *RECORDING)


@dataclass(frozen=True)
class Derived:
    """A column computed from a subset's entries, vehicles and facts.

    Args:
        build: function from a subset to one value per entry; NaN becomes null.
        reads: columns of `tracks`, `vehicles` and `subsets` that it needs.
    """

    build: Callable[[Scene], NDArray[Any] | pl.Series]
    reads: tuple[str, ...]


DERIVED: dict[str, Derived] = {
    **{name: Derived(partial(along.repeat_trait, column=name), ("vehicle_id", name)) for name in VEHICLE_COLUMNS},
    "jump_m": Derived(along.measure_jumps, MOTION),
    "frames_skipped": Derived(along.count_skipped_frames, ("vehicle_id", "frame")),
    "jerk_mps3": Derived(along.measure_jerk, ACCELERATION),
    "jerk_reversals": Derived(along.count_jerk_reversals, ACCELERATION),
    "jerk_reverses": Derived(along.find_jerk_reversals, ACCELERATION),
    "lateral_accel_mps2": Derived(
        along.measure_lateral_acceleration, ("vehicle_id", "frame", "lateral_speed_mps", "frame_rate_hz")
    ),
    "heading_error_rad": Derived(along.measure_heading_error, ("heading_rad", "speed_mps", "lateral_speed_mps")),
    "motion_class": Derived(along.repeat_motion_class, ("vehicle_id",)),
    "lane_stay_s": Derived(along.measure_lane_stays, ("vehicle_id", "frame", "lane", "frame_rate_hz")),
    "out_of_lane_m": Derived(
        along.measure_way_out_of_lane, ("vehicle_id", "y_m", "heading_rad", "length_m", "lane", "lane_markings_m")
    ),
    "overlap_m": Derived(within.measure_overlaps, PLANE),
    "double_track_s": Derived(within.measure_double_tracks, (*PLANE, "frame_rate_hz")),
    "fragment_m": Derived(sections.measure_fragments, ENDS),
    "missed_section_m": Derived(sections.measure_missed_sections, ENDS),
    "nearest_ahead_m": Derived(within.measure_nearest_ahead, LANE_ORDER),
    "leader_ahead_m": Derived(within.measure_leader_ahead, LEADER),
    "leader_in_lane": Derived(within.is_leader_in_lane, ("vehicle_id", "frame", "leader_id", "lane")),
    "recorded_gap_m": Derived(
        within.measure_recorded_gaps, ("vehicle_id", "leader_id", "headway_recorded_m", "gap_m", "length_m")
    ),
}
"""Derived columns by name; the functions document the values."""


def trace(names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of the lake's tables behind some columns, in order of appearance."""
    reads = {name: each.reads for name, each in DERIVED.items()} | DRIVE_READS
    return tuple(dict.fromkeys(column for name in names for column in reads.get(name, (name,))))


def prepare(scene: Scene, names: Iterable[str]) -> pl.DataFrame:
    """Add derived columns to a subset's tracks."""
    wanted = [name for name in dict.fromkeys(names) if name in DERIVED]
    return scene.tracks.with_columns(_as_series(name, DERIVED[name].build(scene)) for name in wanted)


def _as_series(name: str, values: NDArray[Any] | pl.Series) -> pl.Series:
    """Return values as a series in which NaN has become null."""
    series = values.alias(name) if isinstance(values, pl.Series) else pl.Series(name, values)
    # A comparison with null is null, which breaks no rule; one with NaN would hold.
    return series.fill_nan(None) if series.dtype.is_float() else series
