"""Platoon consistency: no vehicle overlaps its leader; the leader is solved before its follower."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.reconstruction.bounds import Limits
from tracklake.pipeline.transforms.reconstruction.motion import Problem, find_broken_pieces, make_motion_rows
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces
from tracklake.pipeline.transforms.reconstruction.programs import Rows
from tracklake.pipeline.transforms.reconstruction.smoothing import Series
from tracklake.pipeline.transforms.resample import join_key
from tracklake.schemas.arrays import Flags, Floats, Integers

CLEARANCE_M = 0.02
"""Gap to the leader that programs keep, in m."""
OVERLAP_PRICE = 100.0
"""Price of an overlap, in m2 per m and point: bounds of motion come first, then overlaps, then recorded positions."""
MOST_TURNS = 200
"""Times that followers are solved after their leaders."""
MOST_TRIES = 4
"""Times that one follower is solved: leaders may form a circle where lanes are changed."""


@dataclass(frozen=True)
class Leaders:
    """Leader of each point (N,): its point at the same frame, or -1, and its length, NaN where unknown."""

    point: Integers
    length_m: Floats

    def measure_gaps(self, x: Floats) -> Floats:
        """Return the gap at each point, from front to the leader's rear; NaN without a leader or its length."""
        gap: Floats = np.where(self.point >= 0, x[self.point] - self.length_m - x, np.nan)
        return gap


def find_leaders(pieces: Pieces, vehicles: pl.DataFrame) -> Leaders:
    """Find the leaders of all points. A filled entry has the leader of the entries around it, if they agree."""
    ids = pieces.tracks["vehicle_id"].to_numpy().astype(np.int64)
    recorded = pieces.tracks["leader_id"].cast(pl.Int64).fill_null(-1).to_numpy()
    following = np.minimum(pieces.row + 1, len(ids) - 1)
    leader = recorded[pieces.row]
    leader = np.where(pieces.recorded | (recorded[following] == leader), leader, -1)
    keys, wanted = join_key(ids[pieces.row], pieces.frame), join_key(leader, pieces.frame)
    point = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    point = np.where((leader >= 0) & (keys[point] == wanted), point, -1)
    return Leaders(point, np.where(point >= 0, read_trait(pieces, vehicles, "length_m")[point], np.nan))


def measure_overlaps(pieces: Pieces, vehicles: pl.DataFrame, x: Floats, y: Floats) -> Floats:
    """Return how deep each recorded point (N,) is in a vehicle ahead of it, whether its leader or not, as -m; else NaN.

    The depth is the lesser of the two along and across the road. Vehicles of unknown widths overlap in one lane only.
    Points whose x is NaN overlap nothing.
    """
    lane = pieces.tracks["lane"].fill_null(-1).to_numpy()[pieces.row]
    length_m, width_m = (read_trait(pieces, vehicles, name) for name in ("length_m", "width_m"))
    known = np.flatnonzero(pieces.recorded & np.isfinite(x))
    order = known[np.lexsort((x[known], pieces.frame[known]))]
    found = np.full(pieces.points, np.nan)
    ahead, step = np.arange(1, len(order)), 1
    while ahead.size:
        first, second = order[ahead], order[ahead - step]
        gap_m = x[first] - length_m[first] - x[second]
        near = (pieces.frame[first] == pieces.frame[second]) & (gap_m < 0)
        ahead, first, second, gap_m = ahead[near], first[near], second[near], gap_m[near]
        apart_m = np.abs(y[first] - y[second]) - (width_m[first] + width_m[second]) / 2
        apart_m = np.where(np.isnan(apart_m), np.where(lane[first] == lane[second], -np.inf, np.inf), apart_m)
        found[second] = np.fmin(found[second], np.where(apart_m < 0, np.maximum(gap_m, apart_m), np.nan))
        step += 1
        ahead = ahead[ahead >= step]
    return found


def read_trait(pieces: Pieces, vehicles: pl.DataFrame, column: str) -> Floats:
    """Return a column of `vehicles` at every point, (N,); NaN where it is null."""
    ids = pieces.tracks.select("vehicle_id")
    values = ids.join(vehicles.select("vehicle_id", column), on="vehicle_id", how="left", maintain_order="left")[column]
    return values.cast(pl.Float64).fill_null(np.nan).to_numpy()[pieces.row]


def keep_behind_leaders(
    problem: Problem, x: Floats, limits: Limits, limit: Callable[[Floats], Limits], leaders: Leaders
) -> None:
    """Move followers that overlap their leaders back, in x; a leader that overlaps its own is moved before.

    A recorded leader whose front is behind the follower's is no leader: it does not bound the follower. Followers that
    are then faster than their bounds were made for are solved again, under those of their speeds (`limit`).
    """
    series = problem.series
    piece = np.repeat(np.arange(len(series.first)), series.size)
    bounding = leaders.measure_gaps(x) > -leaders.length_m
    tries, tried_at, moved_at = (np.zeros(len(series.first), np.int64) for _ in range(3))
    for turn in range(1, MOST_TURNS + 1):
        points = np.flatnonzero(bounding & (leaders.measure_gaps(x) < 0))
        follower, leader = piece[points], piece[leaders.point[points]]
        due = (tries[follower] < MOST_TRIES) & ((tries[follower] == 0) | (moved_at[leader] > tried_at[follower]))
        wanted = np.unique(follower[due])
        waiting = np.unique(follower[due & np.isin(leader, wanted)])
        ready = np.setdiff1d(wanted, waiting) if len(waiting) < len(wanted) else wanted
        if not ready.size:
            limits = limits.lower_to(limit(x))
            ready = find_broken_pieces(series, x, limits)
            ready = ready[(tries[ready] > 0) & (tries[ready] < MOST_TRIES)]
        if not ready.size:
            return
        problem.solve(ready, x, partial(_make_rows, problem, limits, leaders, bounding, x))
        tries[ready] += 1
        tried_at[ready] = moved_at[ready] = turn


def _make_rows(
    problem: Problem, limits: Limits, leaders: Leaders, bounding: Flags, x: Floats, series: Series, points: Integers
) -> list[Rows]:
    free_m = x[leaders.point[points]] - leaders.length_m[points] - CLEARANCE_M - problem.smoothed[points]
    behind = Rows((1.0,), np.nan_to_num(free_m), bounding[points], 1.0, price=OVERLAP_PRICE)
    return [*make_motion_rows(problem, limits, series, points), behind]
