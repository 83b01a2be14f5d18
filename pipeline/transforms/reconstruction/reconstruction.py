"""Reconstruction of a subset: physically possible tracks near the recorded ones."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.reconstruction.bounds import (
    Limits,
    Runs,
    find_breaks,
    limit_motion,
    list_runs,
    measure_motion,
)
from tracklake.pipeline.transforms.reconstruction.config import DEFAULT_CLASS, ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.jumps import find_displacements
from tracklake.pipeline.transforms.reconstruction.lateral import bound_lateral, find_lane_changes
from tracklake.pipeline.transforms.reconstruction.motion import Problem, bound_motion
from tracklake.pipeline.transforms.reconstruction.noise import LEAST_HZ, Noise, estimate_noise
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces, Skip, cut_pieces
from tracklake.pipeline.transforms.reconstruction.platoons import find_leaders, keep_behind_leaders, measure_overlaps
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate, make_penalty, smooth_robustly
from tracklake.schemas.arrays import Flags, Floats
from tracklake.schemas.columns import Table
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

DEFAULT_CONFIG = ReconstructionConfig()
OUTLIER = 4.0
"""Residuals, in standard deviations of the noise, beyond which Huber's distance is linear."""
LEAST_OUTLIER_M = {"x_m": 1.0, "y_m": 4e-6}
"""Least such residual by coordinate, in m. Along the road smaller ones can be motion that the penalty cuts off, such as
hard braking, and noise that is greater for some vehicles, such as those that crawl and are recorded in steps."""
MOVED_M = 0.001
"""Least distance from the smoothed position, in m, at which an entry counts as moved by the bounds."""


@dataclass(frozen=True)
class Reconstruction:
    """Tables about one subset; each conforms to its declaration and is sorted by its key.

    Args:
        entries: rows of `reconstructed`.
        quality: the row of `reconstruction_quality`.
        skips: rows of `reconstruction_skips`.
        unkept: rows of `unkept_bounds`.
    """

    entries: pl.DataFrame
    quality: pl.DataFrame
    skips: pl.DataFrame
    unkept: pl.DataFrame


@dataclass(frozen=True)
class Axis:
    """One coordinate at every point of the pieces, and how it was found.

    Args:
        recorded: (N,) recorded positions, interpolated in gaps.
        noise: their noise and the weight of smoothness; None where there are no points.
        problem: the smoothed pieces.
        x: (N,) positions within the bounds.
    """

    recorded: Floats
    noise: Noise | None
    problem: Problem
    x: Floats

    @property
    def moved(self) -> Flags:
        """Whether bounds moved the point, (N,)."""
        return np.asarray(np.abs(self.x - self.problem.smoothed) > MOVED_M, np.bool_)


def reconstruct(
    tracks: pl.DataFrame,
    vehicles: pl.DataFrame,
    facts: Mapping[str, Any],
    config: ReconstructionConfig = DEFAULT_CONFIG,
) -> Reconstruction:
    """Reconstruct all tracks of one subset.

    Args:
        tracks: vehicle_id, frame, time_s, x_m, y_m, lane, leader_id, in any order.
        vehicles: vehicle_id, class, length_m, width_m; all but the first may be null.
        facts: the subset's row of `subsets`.
        config: settings.
    """
    pieces, skips = cut_pieces(tracks, facts, config.max_gap_s)
    series = Series(pieces.first, pieces.size, pieces.rate_hz)
    runs: list[Runs] = []
    if not pieces.points:
        nothing = Axis(np.empty(0), None, Problem(series, np.empty(0), np.empty((4, 0)), np.empty(0)), np.empty(0))
        along = across = nothing
    else:
        along, runs = _reconstruct_along(pieces, series, vehicles, config, skips)
        across, lateral_runs = _reconstruct_across(pieces, series, config, skips)
        runs.append(lateral_runs)
    entries = _list_entries(pieces, series, along, across, facts)
    outside = _find_outside(pieces, series, entries, skips)
    if pieces.points:
        runs.append(_list_overlaps(pieces, vehicles, replace(along, x=np.where(outside, np.nan, along.x)), across))
    entries = entries.filter(~outside)
    unkept = _list_unkept(pieces, [run.leave_out(outside) for run in runs], facts)
    return Reconstruction(
        entries,
        _summarise(entries, vehicles, along, across, unkept.height, facts, config),
        _list_skips(skips, facts),
        unkept,
    )


def _smooth_axis(pieces: Pieces, series: Series, column: str, config: ReconstructionConfig) -> Axis:
    """Smooth one coordinate of all pieces without bounds."""
    recorded = pieces.interpolate(column)
    set_noise, set_weight = (
        (config.noise_x_m, config.weight_x_s6) if column == "x_m" else (config.noise_y_m, config.weight_y_s6)
    )
    positions = recorded - find_displacements(series, recorded, pieces.recorded) if column == "x_m" else recorded
    noise = estimate_noise(series, positions, pieces.recorded, set_noise, set_weight, LEAST_HZ[column])
    penalty = make_penalty(series, noise.weight_s6)
    limit_m = max(OUTLIER * noise.noise_m, LEAST_OUTLIER_M[column])
    x, weights = smooth_robustly(penalty, positions, pieces.recorded.astype(np.float64), limit_m)
    return Axis(recorded, noise, Problem(series, x, penalty, weights), x)


def _reconstruct_along(
    pieces: Pieces, series: Series, vehicles: pl.DataFrame, config: ReconstructionConfig, skips: list[Skip]
) -> tuple[Axis, list[Runs]]:
    """Return the positions along the road, and the runs that break a bound all the same; `skips` may grow."""
    smoothed = _smooth_axis(pieces, series, "x_m", config)
    names = list(config.bounds)
    classes = pieces.tracks.select("vehicle_id").join(
        vehicles.select("vehicle_id", "class"), on="vehicle_id", how="left", maintain_order="left"
    )["class"]
    place = classes.fill_null(DEFAULT_CLASS).replace_strict(
        names, range(len(names)), default=names.index(DEFAULT_CLASS)
    )
    kind = place.to_numpy()[pieces.row].astype(np.int64)
    bounds = list(config.bounds.values())

    def limit(x: Floats) -> Limits:
        return limit_motion(bounds, kind, differentiate(series, x)[0])

    x, limits = bound_motion(smoothed.problem, limit)
    leaders = find_leaders(pieces, vehicles)
    keep_behind_leaders(smoothed.problem, x, limits, limit, leaders)
    unknown = (leaders.point >= 0) & np.isnan(leaders.length_m) & pieces.recorded
    if unknown.any():
        followers = len(np.unique(pieces.tracks["vehicle_id"].to_numpy()[pieces.row[unknown]]))
        skips.append(Skip("no_length", followers, int(unknown.sum()), "overlaps with leaders of unknown length"))
    values = measure_motion(series, x)
    broken = find_breaks(values, limit(x))
    runs = [list_runs(series, bound, broken[bound], values[bound]) for bound in broken]
    return replace(smoothed, x=x), runs


def _reconstruct_across(
    pieces: Pieces, series: Series, config: ReconstructionConfig, skips: list[Skip]
) -> tuple[Axis, Runs]:
    """Return the positions across the road, and the runs that break their bound all the same; `skips` may grow."""
    smoothed = _smooth_axis(pieces, series, "y_m", config)
    if pieces.tracks["lane"].null_count() == pieces.tracks.height:
        vehicles = pieces.tracks["vehicle_id"].n_unique()
        left_out = "the one way through lane changes"
        if pieces.tracks["leader_id"].null_count() == pieces.tracks.height:
            left_out += "; overlaps with leaders"
        skips.append(Skip("no_lanes", vehicles, pieces.tracks.height, left_out))
    direction = find_lane_changes(pieces, series, smoothed.x)
    y = bound_lateral(smoothed.problem, direction, config.lateral_accel_mps2)
    accel = differentiate(series, y)[1]
    runs = list_runs(series, "lateral_acceleration", np.abs(accel) > config.lateral_accel_mps2, accel)
    return replace(smoothed, x=y), runs


def _list_overlaps(pieces: Pieces, vehicles: pl.DataFrame, along: Axis, across: Axis) -> Runs:
    """Return the runs that overlap the recorded leader, or another vehicle ahead; none at NaN."""
    others = measure_overlaps(pieces, vehicles, along.x, across.x)
    gaps = np.fmin(find_leaders(pieces, vehicles).measure_gaps(along.x), others)
    return list_runs(along.problem.series, "overlap", gaps < 0, gaps)


def _list_entries(pieces: Pieces, series: Series, along: Axis, across: Axis, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write the points as rows of `reconstructed`."""
    if not pieces.points:
        return RECONSTRUCTED.empty()
    speed, accel = differentiate(series, along.x)
    lateral_speed, _ = differentiate(series, across.x)
    moved_m = np.hypot(along.x - along.recorded, across.x - across.recorded)
    frame = pl.DataFrame(
        {
            "vehicle_id": pieces.tracks["vehicle_id"].to_numpy()[pieces.row],
            "frame": pieces.frame,
            "time_s": pieces.interpolate("time_s"),
            "x_m": along.x,
            "y_m": across.x,
            "speed_mps": speed,
            "accel_mps2": accel,
            "lateral_speed_mps": lateral_speed,
            "moved_m": pl.Series(np.where(pieces.recorded, moved_m, np.nan)).fill_nan(None),
            "imputed": ~pieces.recorded,
            "constrained": along.moved | across.moved,
        }
    )
    return _conform(RECONSTRUCTED, frame, facts)


def _find_outside(pieces: Pieces, series: Series, entries: pl.DataFrame, skips: list[Skip]) -> Flags:
    """Find the points (N,) of pieces that the table's ranges do not admit, as at 400 m/s; `skips` may grow."""
    ranges = ((name, one.ge, one.le) for name, one in RECONSTRUCTED.columns.items())
    inside = [pl.col(name).is_between(least, most) for name, least, most in ranges if None not in (least, most)]
    outside = entries.select(~pl.all_horizontal(inside)).to_series().to_numpy()
    if not outside.any():
        return outside
    outside = np.repeat(np.logical_or.reduceat(outside, series.first), series.size)
    recorded = outside & pieces.recorded
    vehicles = len(np.unique(pieces.tracks["vehicle_id"].to_numpy()[pieces.row[recorded]]))
    left_out = "everything: no motion near the recorded positions lies within the table's ranges"
    skips.append(Skip("out_of_range", vehicles, int(recorded.sum()), left_out))
    return outside


def _summarise(
    entries: pl.DataFrame,
    vehicles: pl.DataFrame,
    along: Axis,
    across: Axis,
    unkept: int,
    facts: Mapping[str, Any],
    config: ReconstructionConfig,
) -> pl.DataFrame:
    """Write the row of `reconstruction_quality`."""
    moved = entries["moved_m"].drop_nulls()
    frame = pl.DataFrame(
        {
            "vehicles": [vehicles.height],
            "vehicles_reconstructed": [entries["vehicle_id"].n_unique()],
            "entries": [len(moved)],
            "imputed_entries": [entries["imputed"].sum()],
            "constrained_entries": [entries["constrained"].sum()],
            "noise_x_m": [along.noise and along.noise.noise_m],
            "noise_y_m": [across.noise and across.noise.noise_m],
            "noise_is_set": [config.noise_x_m is not None or config.noise_y_m is not None],
            "weight_x_s6": [along.noise and along.noise.weight_s6],
            "weight_y_s6": [across.noise and across.noise.weight_s6],
            "median_moved_m": [moved.median()],
            "moved_over_half_m_share": [(moved > 0.5).mean()],
            "moved_over_2_m_share": [(moved > 2.0).mean()],
            "bounds_not_kept": [unkept],
        }
    )
    return _conform(RECONSTRUCTION_QUALITY, frame, facts)


def _list_unkept(pieces: Pieces, runs: list[Runs], facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write runs that break a bound as rows of `unkept_bounds`."""
    ids = pieces.tracks["vehicle_id"].to_numpy()
    frames = [
        pl.DataFrame(
            {
                "vehicle_id": ids[pieces.row[run.first]],
                "bound": [run.bound] * len(run.first),
                "first_frame": pieces.frame[run.first],
                "last_frame": pieces.frame[run.last],
                "entries": run.last - run.first + 1,
                "worst": run.worst,
            }
        )
        for run in runs
        if len(run.first)
    ]
    return _conform(UNKEPT_BOUNDS, pl.concat(frames), facts) if frames else UNKEPT_BOUNDS.empty()


def _list_skips(skips: list[Skip], facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write what was left out as rows of `reconstruction_skips`."""
    names = ("reason", "vehicles", "entries", "left_out")
    frame = pl.DataFrame([{name: getattr(skip, name) for name in names} for skip in skips])
    return _conform(RECONSTRUCTION_SKIPS, frame, facts) if skips else RECONSTRUCTION_SKIPS.empty()


def _conform(table: Table, frame: pl.DataFrame, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Add the subset's place and put a frame into its table's columns and order."""
    place = [pl.lit(facts[name]).alias(name) for name in ("dataset", "subset")]
    return table.conform(frame.with_columns(place).lazy()).sort(table.key).collect()
