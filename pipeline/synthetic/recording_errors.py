"""Injection of recording errors: wrong leaders, headways, lanes and positions of vehicles that drive normally."""

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.damaged_tracks import DamagedTracks, Injector, draw_run
from tracklake.pipeline.synthetic.neighbors import NO_ROW
from tracklake.schemas.arrays import Floats, Integers

FREE_M = 30.0
"""Least distance to other vehicles of a position that jumps or is recorded in the wrong lane, in m."""


def _draw_following_run(work: DamagedTracks, place: int) -> tuple[int, int] | None:
    """Draw a run of 0.3 to 2 s with a leader throughout: its first and last row."""
    run = draw_run(work, place, work.draw_frames(0.3, 2.0), margin=2)
    if run is None or (work.leader[run[0] : run[1] + 1] == NO_ROW).any():
        return None
    return run


def inject_wrong_leader(work: DamagedTracks, place: int) -> bool:
    """Record the leader's leader as the leader for a while."""
    run = _draw_following_run(work, place)
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    if (work.leader[work.leader[rows]] == NO_ROW).any():
        return False
    work.leader_skipped[rows] = True
    work.add_defect("wrong_leader", *run)
    return True


def inject_wrong_headway(work: DamagedTracks, place: int) -> bool:
    """Record a headway that is too long for a while."""
    run = _draw_following_run(work, place)
    if run is None:
        return False
    error = work.random.uniform(1.5, 4.0)
    work.headway_error[run[0] : run[1] + 1] = error
    work.add_defect("wrong_headway", *run, error)
    return True


def inject_jump(work: DamagedTracks, place: int) -> bool:
    """Record a position that is too far ahead for some frames."""
    run = draw_run(work, place, work.draw_frames(0.1, 0.5), margin=2)
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    leader = work.leader[rows]
    room = np.where(leader == NO_ROW, np.inf, work.x[leader] - work.x[rows])
    if room.min() < FREE_M:
        return False
    error = work.random.uniform(2.5, 4.0)
    work.x[rows] += error
    work.add_defect("position_jump", *run, error)
    return True


def make_lane_flicker_injector(on_ramp_lane: int | None) -> Injector:
    """Make an injector that records an adjacent lane for less than two seconds, but not beside the on-ramp."""

    def damage_vehicle(work: DamagedTracks, place: int) -> bool:
        run = draw_run(work, place, work.draw_frames(0.4, 1.5), margin=2)
        if run is None:
            return False
        rows = slice(run[0], run[1] + 1)
        lane = int(work.lane[run[0]])
        if (work.lane[run[0] - 1 : run[1] + 2] != lane).any() or lane == on_ramp_lane:
            return False
        target = lane - 1 if lane > 1 else lane + 1
        others = (work.frame >= work.frame[run[0]]) & (work.frame <= work.frame[run[1]]) & (work.lane == target)
        own = work.x[run[0] + work.frame[others] - work.frame[run[0]]]
        if (np.abs(work.x[others] - own) < FREE_M).any():
            return False
        work.lane[rows] = target
        work.add_defect("lane_flicker", *run, target)
        return True

    return damage_vehicle


def select_recorded_leaders(leader: Integers, tracks: pl.DataFrame) -> Integers:
    """Replace each row's leader (a row, or NO_ROW) by its leader's leader where `leader_skipped` is set."""
    if "leader_skipped" not in tracks.columns:
        return leader
    beyond = np.where(leader == NO_ROW, NO_ROW, leader[leader])
    return np.where(tracks["leader_skipped"].to_numpy(), beyond, leader)


def get_headway_errors(tracks: pl.DataFrame) -> Floats:
    """Return the errors of recorded headways in m: the column `headway_error`, or zeros."""
    if "headway_error" not in tracks.columns:
        return np.zeros(tracks.height)
    return tracks["headway_error"].to_numpy()
