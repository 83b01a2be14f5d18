"""Reconstruction of a subset: physically possible tracks near the recorded ones."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.number_store import MakeStore, MemoryStore, NumberStore
from tracklake.pipeline.transforms.reconstruction.along import smooth_share, solve_along
from tracklake.pipeline.transforms.reconstruction.bounds import Runs, find_breaks, list_runs, measure_motion
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.estimates import Estimates, make_estimates
from tracklake.pipeline.transforms.reconstruction.lateral import bound_lateral, find_lane_changes
from tracklake.pipeline.transforms.reconstruction.overlaps import measure_overlaps
from tracklake.pipeline.transforms.reconstruction.pieces import Skip
from tracklake.pipeline.transforms.reconstruction.platoons import Platoons
from tracklake.pipeline.transforms.reconstruction.result_tables import (
    Axis,
    Tally,
    join_unkept,
    list_entries,
    list_skips,
    list_unkept,
    summarise,
)
from tracklake.pipeline.transforms.reconstruction.shares import Share, Shares, add_skips
from tracklake.pipeline.transforms.reconstruction.smoothing import differentiate
from tracklake.pipeline.transforms.slices import list_windows
from tracklake.schemas.arrays import Flags, expand_ranges
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

DEFAULT_CONFIG = ReconstructionConfig()
ALL_AT_ONCE = 2**62
"""More points than there are."""


@dataclass(frozen=True)
class Reconstruction:
    """Tables about one subset; each conforms to its declaration and is sorted by its key.

    Args:
        entries: rows of `reconstructed`.
        quality: the row of `reconstruction_quality`.
        skips: rows of `reconstruction_skips`.
        unkept: rows of `unkept_bounds`.
    """

    entries: pl.DataFrame = field(default_factory=RECONSTRUCTED.empty)
    quality: pl.DataFrame = field(default_factory=RECONSTRUCTION_QUALITY.empty)
    skips: pl.DataFrame = field(default_factory=RECONSTRUCTION_SKIPS.empty)
    unkept: pl.DataFrame = field(default_factory=UNKEPT_BOUNDS.empty)


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
    share, rest = reconstruct_shares(lambda: [tracks], vehicles, facts, config)
    return replace(rest, entries=share.entries)


def reconstruct_shares(
    read_tracks: Callable[[], Iterable[pl.DataFrame]],
    vehicles: pl.DataFrame,
    facts: Mapping[str, Any],
    config: ReconstructionConfig = DEFAULT_CONFIG,
    make_store: MakeStore = MemoryStore,
    at_once: int = ALL_AT_ONCE,
) -> Iterator[Reconstruction]:
    """Yield the entries of one subset share by share, as `reconstruct` makes them of all, and then the other tables.

    Args:
        read_tracks: function that yields the tracks, whole ones in order of vehicles, as often as it is called.
        vehicles: as `reconstruct` takes them.
        facts: likewise.
        config: likewise.
        make_store: function that makes a store of numbers.
        at_once: number of points that are held in memory besides a share.
    """
    shares = Shares(read_tracks, facts, config.max_gap_s)
    skips, unkept, tally = [*shares.skips], list[pl.DataFrame](), Tally(make_store("float32"))
    estimates = None
    if shares.all.points:
        estimates = make_estimates(shares, config, make_store, at_once)
        platoons = solve_along(shares, estimates, vehicles, config, make_store, at_once)
        points = _Points(platoons, make_store("float64"), make_store("int32"), make_store("bool"))
        skips += _list_lacking(shares)
    for share in shares:
        entries = RECONSTRUCTED.empty()
        if share.pieces.points and estimates is not None:
            entries, broken, skipped = _write_share(share, estimates, points, facts, config)
            unkept += [list_unkept(shares.all, run, share.first_point) for run in broken]
            skips += skipped
        tally.add(entries)
        yield Reconstruction(entries)
    if estimates is not None:
        unkept += _list_overlaps(points, vehicles, make_store, at_once)
    listed = join_unkept(unkept, facts)
    noise = {} if estimates is None else estimates.noise
    quality = summarise(tally, vehicles.height, noise, listed.height, facts, config, at_once)
    yield Reconstruction(quality=quality, skips=list_skips(add_skips(skips), facts), unkept=listed)


@dataclass(frozen=True)
class _Points:
    """The N points of a subset as they are written; the last three grow share by share.

    Args:
        along: positions along the road; NaN where they are not written.
        y: positions across it.
        lane: recorded lanes, -1 = none.
        recorded: whether the point was recorded.
    """

    along: Platoons
    y: NumberStore
    lane: NumberStore
    recorded: NumberStore


def _write_share(
    share: Share, estimates: Estimates, points: _Points, facts: Mapping[str, Any], config: ReconstructionConfig
) -> tuple[pl.DataFrame, list[Runs], list[Skip]]:
    """Return the entries of a share, the runs that break a bound, and what is left out; `points` grow."""
    pieces, series, own, platoons = share.pieces, share.series, share.own_points, points.along
    along = Axis(pieces.interpolate("x_m"), platoons.problem.smoothed[own], platoons.x[own])
    values = measure_motion(series, along.x)
    broken = find_breaks(values, platoons.limits.find(share.own_pieces, series, along.x))
    runs = [list_runs(series, bound, broken[bound], values[bound]) for bound in broken]
    across = _reconstruct_across(share, estimates, config)
    accel = differentiate(series, across.x)[1]
    runs.append(list_runs(series, "lateral_acceleration", np.abs(accel) > config.lateral_accel_mps2, accel))
    entries = list_entries(pieces, series, along, across, facts)
    outside, skips = _find_outside(share, entries)
    platoons.x[own] = np.where(outside, np.nan, along.x)
    points.y.append(across.x)
    points.lane.append(pieces.tracks["lane"].fill_null(-1).to_numpy()[pieces.row])
    points.recorded.append(pieces.recorded)
    unknown = (platoons.leader[own] >= 0) & np.isnan(platoons.find_lengths(platoons.leader[own])) & pieces.recorded
    if unknown.any():
        left_out = "overlaps with leaders of unknown length"
        skips.append(Skip("no_length", _count_vehicles(share, unknown), int(unknown.sum()), left_out))
    return entries.filter(~outside), [run.leave_out(outside) for run in runs], skips


def _reconstruct_across(share: Share, estimates: Estimates, config: ReconstructionConfig) -> Axis:
    """Return the positions across the road."""
    problem = smooth_share(share, estimates, "y_m")
    smoothed = problem.smoothed[:]
    direction = find_lane_changes(share.pieces, share.series, smoothed)
    y = bound_lateral(problem, direction, config.lateral_accel_mps2)
    return Axis(share.pieces.interpolate("y_m"), smoothed, y)


def _list_lacking(shares: Shares) -> list[Skip]:
    """List what is left out since the source has no lanes."""
    if shares.has_lanes:
        return []
    left_out = "the one way through lane changes" + ("" if shares.has_leaders else "; overlaps with leaders")
    return [Skip("no_lanes", shares.vehicles, shares.entries, left_out)]


def _find_outside(share: Share, entries: pl.DataFrame) -> tuple[Flags, list[Skip]]:
    """Find the points (N,) of pieces that the table's ranges do not admit, as at 400 m/s; they are left out."""
    ranges = ((name, one.ge, one.le) for name, one in RECONSTRUCTED.columns.items())
    inside = [pl.col(name).is_between(least, most) for name, least, most in ranges if None not in (least, most)]
    outside = entries.select(~pl.all_horizontal(inside)).to_series().to_numpy()
    if not outside.any():
        return outside, []
    outside = np.repeat(np.logical_or.reduceat(outside, share.series.first), share.series.size)
    recorded = outside & share.pieces.recorded
    left_out = "everything: no motion near the recorded positions lies within the table's ranges"
    return outside, [Skip("out_of_range", _count_vehicles(share, recorded), int(recorded.sum()), left_out)]


def _count_vehicles(share: Share, chosen: Flags) -> int:
    """Count the vehicles of some points."""
    return len(np.unique(share.pieces.tracks["vehicle_id"].to_numpy()[share.pieces.row[chosen]]))


def _list_overlaps(
    points: _Points, vehicles: pl.DataFrame, make_store: MakeStore, at_once: int
) -> Iterator[pl.DataFrame]:
    """Yield the runs that overlap the recorded leader, or another vehicle ahead, as rows of `unkept_bounds`."""
    pieces = points.along.pieces
    depth = _measure_depths(points, vehicles, make_store, at_once)
    for first, end in pieces.list_ranges(at_once):
        gaps = np.fmin(points.along.measure_gaps(first, end), depth[first:end])
        yield list_unkept(pieces, list_runs(pieces.cut_series(first, end), "overlap", gaps < 0, gaps), first)


def _measure_depths(points: _Points, vehicles: pl.DataFrame, make_store: MakeStore, at_once: int) -> NumberStore:
    """Return how deep each recorded point is in a vehicle ahead; see `measure_overlaps`. Frames are taken in turn."""
    pieces, depth = points.along.pieces, make_store("float64")
    for first, end in pieces.list_ranges(at_once):
        depth.append(np.full(end - first, np.nan))
    length_m, width_m = (pieces.read_trait(vehicles, name) for name in ("length_m", "width_m"))
    for chosen, before, size in list_windows(pieces.frame, pieces.series.size, at_once):
        own, run = expand_ranges(pieces.series.first[chosen] + before, size)
        recorded = points.recorded[own]
        own, piece = own[recorded], chosen[run[recorded]]
        frame = pieces.frame[piece] + own - pieces.series.first[piece]
        x, y, lane = points.along.x[own], points.y[own], points.lane[own]
        depth[own] = measure_overlaps(frame, lane, x, y, length_m[piece], width_m[piece])
    return depth
