"""Defects of what is recorded about a vehicle rather than of how it drives: leader, headway, lane, a position."""

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.damaged_tracks import Floats, Inflict, Integers, Work, pick_run
from tracklake.pipeline.synthetic.neighbors import NOBODY

FREE_M = 30.0
"""A lane is entered by mistake only where nobody is this near in it, and a position jumps only into free road."""


def _pick_following(work: Work, place: int) -> tuple[int, int] | None:
    """A random run of 0.3 to 2 s, first and last row, in which there is always a leader."""
    run = pick_run(work, place, work.seconds(0.3, 2.0), margin=2)
    if run is None or (work.leader[run[0] : run[1] + 1] == NOBODY).any():
        return None
    return run


def skip_leader(work: Work, place: int) -> bool:
    """For a while the leader's leader is recorded as the own."""
    run = _pick_following(work, place)
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    if (work.leader[work.leader[rows]] == NOBODY).any():
        return False
    work.leader_skipped[rows] = True
    work.note("wrong_leader", *run)
    return True


def misread_headway(work: Work, place: int) -> bool:
    """For a while the recorded headway is too long."""
    run = _pick_following(work, place)
    if run is None:
        return False
    error = work.random.uniform(1.5, 4.0)
    work.headway_error[run[0] : run[1] + 1] = error
    work.note("wrong_headway", *run, error)
    return True


def jump(work: Work, place: int) -> bool:
    """For some frames the vehicle is located too far ahead."""
    run = pick_run(work, place, work.seconds(0.1, 0.5), margin=2)
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    leader = work.leader[rows]
    room = np.where(leader == NOBODY, np.inf, work.x[leader] - work.x[rows])
    if room.min() < FREE_M:
        return False
    error = work.random.uniform(2.5, 4.0)
    work.x[rows] += error
    work.note("position_jump", *run, error)
    return True


def change_lane_and_back(on_ramp_lane: int | None) -> Inflict:
    """The lane beside its own is recorded for less than two seconds, while the vehicle keeps its way.

    Args:
        on_ramp_lane: beside which there is no lane to be in.
    """

    def inflict(work: Work, place: int) -> bool:
        run = pick_run(work, place, work.seconds(0.4, 1.5), margin=2)
        if run is None:
            return False
        rows = slice(run[0], run[1] + 1)
        lane = int(work.lane[run[0]])
        if (work.lane[run[0] - 1 : run[1] + 2] != lane).any() or lane == on_ramp_lane:
            return False
        target = lane - 1 if lane > 1 else lane + 1
        there = (work.frame >= work.frame[run[0]]) & (work.frame <= work.frame[run[1]]) & (work.lane == target)
        own = work.x[run[0] + work.frame[there] - work.frame[run[0]]]
        if (np.abs(work.x[there] - own) < FREE_M).any():
            return False
        work.lane[rows] = target
        work.note("lane_flicker", *run, target)
        return True

    return inflict


def recorded_leaders(leader: Integers, tracks: pl.DataFrame) -> Integers:
    """The rows of the leaders as recorded: the leader's leader where it was skipped.

    Args:
        leader: row of each row's leader, NOBODY where there is none.
        tracks: may have the column `leader_skipped`.
    """
    if "leader_skipped" not in tracks.columns:
        return leader
    beyond = np.where(leader == NOBODY, NOBODY, leader[leader])
    return np.where(tracks["leader_skipped"].to_numpy(), beyond, leader)


def headway_errors(tracks: pl.DataFrame) -> Floats:
    """Metres by which recorded headways are wrong: the column `headway_error`, where there is one."""
    if "headway_error" not in tracks.columns:
        return np.zeros(tracks.height)
    return tracks["headway_error"].to_numpy()
