"""Platoon consistency: no vehicle overlaps its leader; the leader is solved before its follower."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.number_store import NumberStore
from tracklake.pipeline.transforms.reconstruction.bounds import Limits, limit_motion
from tracklake.pipeline.transforms.reconstruction.config import MotionBounds
from tracklake.pipeline.transforms.reconstruction.motion import Problem, find_broken_pieces, make_motion_rows
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces
from tracklake.pipeline.transforms.reconstruction.programs import Rows
from tracklake.pipeline.transforms.reconstruction.shares import AllPieces
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate, select_pieces
from tracklake.schemas.arrays import Floats, Integers

CLEARANCE_M = 0.02
"""Gap to the leader that programs keep, in m."""
OVERLAP_PRICE = 100.0
"""Price of an overlap, in m2 per m and point: bounds of motion come first, then overlaps, then recorded positions."""
MOST_TURNS = 200
"""Times that followers are solved after their leaders."""
MOST_TRIES = 4
"""Times that one follower is solved: leaders may form a circle where lanes are changed."""


@dataclass(frozen=True)
class ClassLimits:
    """Bounds of motion by class.

    Args:
        bounds: the bounds of each class.
        kind: (P,) position of each piece's class in them.
    """

    bounds: Sequence[MotionBounds]
    kind: Integers

    def find(self, pieces: Integers | slice, series: Series, x: Floats) -> Limits:
        """Return the bounds of some pieces at the speeds of their positions."""
        return limit_motion(self.bounds, np.repeat(self.kind[pieces], series.size), differentiate(series, x)[0])


@dataclass(frozen=True)
class Platoons:
    """The N points of a subset along the road, and their leaders.

    Args:
        pieces: where the P pieces lie.
        problem: their smoothed positions.
        limits: their bounds.
        length_m: (P,) length of each one's vehicle, NaN where unknown.
        x: (N,) positions within the bounds of motion; followers are moved back in them.
        accel_mps2: (N,) greatest accelerations of the programs; they are lowered.
        leader: (N,) point of the recorded leader, -1 = none.
        is_bounding: (N,) whether the leader bounds the follower; see `keep_behind_leaders`.
        at_once: number of points that are looked at together.
    """

    pieces: AllPieces
    problem: Problem
    limits: ClassLimits
    length_m: Floats
    x: NumberStore
    accel_mps2: NumberStore
    leader: NumberStore
    is_bounding: NumberStore
    at_once: int

    def find_bounding(self) -> None:
        """Find the leaders that bound their followers: those ahead of them."""
        for first, end in self.pieces.list_ranges(self.at_once):
            self.is_bounding.append(self.measure_gaps(first, end) > -self.find_lengths(self.leader[first:end]))

    def measure_gaps(self, first: int, end: int) -> Floats:
        """Return the gaps of points to their leaders; see `_measure_gaps`."""
        return self._measure_gaps(self.x[first:end], self.leader[first:end])

    def find_lengths(self, leader: Integers) -> Floats:
        """Return the lengths of leaders, given as points; NaN where there is none or it is unknown."""
        return np.where(leader >= 0, self.length_m[self.pieces.find_pieces(leader)], np.nan)

    def list_pairs(self, pieces: Integers) -> tuple[Integers, Integers]:
        """Return the pairs of some pieces and those that bound them, and of them those that overlap.

        A pair is one number: P * the follower + its leader.
        """
        bound, overlapping = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for some in self.pieces.group(pieces, self.at_once):
            points, series = select_pieces(self.problem.series, some)
            leader = self.leader[points]
            bounded = np.flatnonzero(self.is_bounding[points])
            follower = np.repeat(some, series.size)[bounded]
            pair = follower * len(self.length_m) + self.pieces.find_pieces(leader[bounded])
            gaps = self._measure_gaps(self.x[points[bounded]], leader[bounded])
            bound.append(np.unique(pair))
            overlapping.append(np.unique(pair[gaps < 0]))
        return np.concatenate(bound), np.concatenate(overlapping)

    def lower_limits(self, pieces: Integers) -> Integers:
        """Lower the bounds of some pieces to those at their speeds; return those that break them."""
        broken = [np.empty(0, np.int64)]
        for some in self.pieces.group(pieces, self.at_once):
            points, series = select_pieces(self.problem.series, some)
            x = self.x[points]
            at_speed = self.limits.find(some, series, x)
            lowered = replace(at_speed, accel_mps2=self.accel_mps2[points]).lower_to(at_speed)
            self.accel_mps2[points] = lowered.accel_mps2
            broken.append(some[find_broken_pieces(series, x, lowered)])
        return np.concatenate(broken)

    def solve(self, pieces: Integers) -> None:
        """Move some pieces behind their leaders."""
        self.problem.solve(pieces, self.x, self._make_rows)

    def _make_rows(self, series: Series, points: Integers) -> list[Rows]:
        leader, smoothed = self.leader[points], self.problem.smoothed[points]
        at_rest = self.limits.find(self.pieces.find_pieces(points[series.first]), series, smoothed)
        limits = replace(at_rest, accel_mps2=self.accel_mps2[points])
        free_m = self.x[leader] - self.find_lengths(leader) - CLEARANCE_M - smoothed
        behind = Rows((1.0,), np.nan_to_num(free_m), self.is_bounding[points], 1.0, price=OVERLAP_PRICE)
        return [*make_motion_rows(series, smoothed, limits), behind]

    def _measure_gaps(self, x: Floats, leader: Integers) -> Floats:
        """Return the gap at each point, from front to the leader's rear; NaN without a leader or its length."""
        gap = np.full(len(x), np.nan)
        led = np.flatnonzero(leader >= 0)
        gap[led] = self.x[leader[led]] - self.find_lengths(leader[led]) - x[led]
        return gap


def find_leaders(pieces: Pieces, all_pieces: AllPieces) -> Integers:
    """Find the leaders' points, -1 = none. A filled entry has the leader of the entries around it, if they agree."""
    recorded = pieces.tracks["leader_id"].cast(pl.Int64).fill_null(-1).to_numpy()
    following = np.minimum(pieces.row + 1, len(recorded) - 1)
    leader = recorded[pieces.row]
    leader = np.where(pieces.recorded | (recorded[following] == leader), leader, -1)
    return all_pieces.find_points(leader, pieces.frame)


def keep_behind_leaders(platoons: Platoons) -> None:
    """Move followers that overlap their leaders back; a leader that overlaps its own is moved before.

    A recorded leader whose front is behind the follower's is no leader: it does not bound the follower. Followers that
    are then faster than their bounds were made for are solved again, under those of their speeds.
    """
    count = len(platoons.length_m)
    bound, overlapping = platoons.list_pairs(np.arange(count))
    tries, tried_at, moved_at = (np.zeros(count, np.int64) for _ in range(3))
    for turn in range(1, MOST_TURNS + 1):
        follower, leader = np.divmod(overlapping, max(count, 1))
        due = (tries[follower] < MOST_TRIES) & ((tries[follower] == 0) | (moved_at[leader] > tried_at[follower]))
        wanted = np.unique(follower[due])
        waiting = np.unique(follower[due & np.isin(leader, wanted)])
        ready = np.setdiff1d(wanted, waiting) if len(waiting) < len(wanted) else wanted
        if not ready.size:
            # The bounds of pieces that were never solved are those at their speeds.
            ready = platoons.lower_limits(np.flatnonzero((tries > 0) & (tries < MOST_TRIES)))
        if not ready.size:
            return
        platoons.solve(ready)
        tries[ready] += 1
        tried_at[ready] = moved_at[ready] = turn
        touched = np.union1d(ready, bound[np.isin(bound % count, ready)] // count)
        kept = overlapping[~np.isin(overlapping // count, touched)]
        overlapping = np.concatenate([kept, platoons.list_pairs(touched)[1]])
