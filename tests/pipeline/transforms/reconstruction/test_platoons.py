"""Followers behind their leaders, against a loop that looks at every entry in every turn."""

import numpy as np
import pytest

from tracklake.pipeline.transforms.number_store import MemoryStore
from tracklake.pipeline.transforms.reconstruction.config import BOUNDS
from tracklake.pipeline.transforms.reconstruction.motion import (
    Problem,
    bound_motion,
    find_broken_pieces,
    make_motion_rows,
)
from tracklake.pipeline.transforms.reconstruction.platoons import (
    CLEARANCE_M,
    MOST_TRIES,
    OVERLAP_PRICE,
    ClassLimits,
    Platoons,
    keep_behind_leaders,
)
from tracklake.pipeline.transforms.reconstruction.programs import Rows
from tracklake.pipeline.transforms.reconstruction.shares import AllPieces
from tracklake.pipeline.transforms.reconstruction.smoothing import Series

PIECES, TICKS, LENGTH_M = 24, 90, 4.0


def make_platoon(seed):
    """Smoothed positions of vehicles in file, all with the same frames, and the point of each one's leader.

    For a while each follows the one behind, so that leaders form circles; one leader has no length.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(TICKS) / 10
    slow = 3.0 * np.sin(0.6 * time_s + rng.uniform(0, 6, (PIECES, 1)))
    x = 9 * time_s + slow - 5.5 * np.arange(PIECES)[:, None]
    ahead = np.where(np.arange(TICKS) < 60, -1, 1) + np.arange(PIECES)[:, None]
    ahead[(ahead < 0) | (ahead >= PIECES)] = -1
    leader = np.where(ahead >= 0, ahead * TICKS + np.arange(TICKS), -1)
    length_m = np.full(PIECES, LENGTH_M)
    length_m[seed % PIECES] = np.nan
    return x.ravel(), leader.ravel(), length_m


def fill(dtype, values):
    store = MemoryStore(dtype)
    store.append(values)
    return store


def move_back_slowly(problem, limits, limit, x, leader, length_m):
    """The same, turn by turn, over all entries; returns the positions and the number of turns."""
    piece = np.repeat(np.arange(PIECES), TICKS)
    length = np.where(leader >= 0, length_m[piece[leader]], np.nan)

    def measure_gaps():
        return np.where(leader >= 0, x[leader] - length - x, np.nan)

    bounding = measure_gaps() > -length
    tries, tried_at, moved_at = (dict.fromkeys(range(PIECES), 0) for _ in range(3))
    for turn in range(1, 201):
        points = np.flatnonzero(bounding & (measure_gaps() < 0))
        pairs = {(int(piece[point]), int(piece[leader[point]])) for point in points}
        due = {
            (own, ahead)
            for own, ahead in pairs
            if tries[own] == 0 or (tries[own] < MOST_TRIES and moved_at[ahead] > tried_at[own])
        }
        wanted = {own for own, _ in due}
        ready = wanted - {own for own, ahead in due if ahead in wanted} or wanted
        if not ready:
            limits = limits.lower_to(limit(x))
            broken = find_broken_pieces(problem.series, x, limits)
            ready = {int(number) for number in broken if 0 < tries[number] < MOST_TRIES}
        if not ready:
            return x, turn

        def make_rows(series, own, limits=limits):
            free = x[leader[own]] - length[own] - CLEARANCE_M - problem.smoothed[own]
            behind = Rows((1.0,), np.nan_to_num(free), bounding[own], 1.0, price=OVERLAP_PRICE)
            return [*make_motion_rows(series, problem.smoothed[own], limits.at(own)), behind]

        problem.solve(np.array(sorted(ready)), x, make_rows)
        for number in ready:
            tries[number] += 1
            tried_at[number] = moved_at[number] = turn
    return x, turn


@pytest.mark.parametrize("seed", range(6))
def test_followers_are_moved_back_as_a_loop_over_all_entries_does(seed):
    smoothed, leader, length_m = make_platoon(seed)
    series = Series(np.arange(PIECES) * TICKS, np.full(PIECES, TICKS), 10.0)
    problem = Problem(series, smoothed, np.ones(len(smoothed)), 0.3)
    classes = ClassLimits(list(BOUNDS.values()), np.zeros(PIECES, np.int64))

    def limit(x):
        return classes.find(slice(None), series, x)

    x, limits = bound_motion(problem, limit)
    expected, turns = move_back_slowly(problem, limits, limit, x.copy(), leader, length_m)
    platoons = Platoons(
        pieces=AllPieces(np.arange(PIECES), np.zeros(PIECES, np.int64), series),
        problem=problem,
        limits=classes,
        length_m=length_m,
        x=fill("float64", x),
        accel_mps2=fill("float64", limits.accel_mps2),
        leader=fill("int64", leader),
        is_bounding=MemoryStore("bool"),
        at_once=250,
    )
    platoons.find_bounding()
    keep_behind_leaders(platoons)
    np.testing.assert_array_equal(platoons.x[:], expected)
    assert (np.abs(expected - x) > 0.1).sum() > 100
    assert 5 < turns < 200
