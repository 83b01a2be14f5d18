"""Known defects, put into clean tracks on purpose, each written down.

A vehicle carries one defect at most, and neither does the leader into which a vehicle is shifted; the one exception
is that of an NGSIM overlap whose leader also misses frames, declared as both.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.damaged_tracks import Defect, Inflict, Work, pick_run
from tracklake.pipeline.synthetic.misreadings import change_lane_and_back, jump, misread_headway, skip_leader
from tracklake.pipeline.synthetic.neighbors import find_surroundings
from tracklake.pipeline.synthetic.scenarios import Plan

DEEPEST_START_M = 200.0
SHALLOWEST_START_M = 20.0
NEAREST_LEADER_M = 20.0
"""Vehicles overlap in recordings where they drive close; from farther away, the drift would be no tracking error."""

DRIFT_S = 2.0
"""How long a vehicle takes to drift into its leader, and out again."""

CLEAR_M = 0.05
ROLLING_MPS = 1.6
"""Only vehicles slower than this swing back; the acceleration of that stays below 3.05 m/s2."""


@dataclass(frozen=True)
class Injected:
    """Damaged tracks.

    Args:
        tracks: as before, with the columns `lost` (Boolean): entries that are seen, so that others name them as their
            leader, but are missing from the file; `leader_skipped` (Boolean): the leader's leader is recorded as the
            own; `headway_error` (Float64): metres by which the recorded headway is wrong.
        defects: all of them.
    """

    tracks: pl.DataFrame
    defects: list[Defect]


def inject(
    tracks: pl.DataFrame,
    plan: Plan,
    *,
    rate_hz: float,
    on_ramp_lane: int | None,
    unseen_leaders: bool,
    random: np.random.Generator,
) -> Injected:
    """Damage the tracks of one subset.

    Args:
        tracks: sorted by vehicle, frame, without gaps.
        plan: how many of which.
        rate_hz: frames per second.
        on_ramp_lane: whose vehicles begin in mid-section by nature and so cannot start late.
        unseen_leaders: make one overlap with a leader that misses frames (formats that record a headway to it).
        random: draws the same vehicles for the same seed.
    """
    vehicle = tracks["vehicle"].to_numpy().astype(np.int64)
    begins = np.flatnonzero(np.diff(vehicle, prepend=-1))
    work = Work(
        rate_hz=rate_hz,
        random=random,
        vehicle=vehicle,
        frame=tracks["frame"].to_numpy().astype(np.int64),
        lane=tracks["lane"].to_numpy().astype(np.int64, copy=True),
        x=tracks["x"].to_numpy().copy(),
        length=tracks["length"].to_numpy(),
        speed=tracks["speed"].to_numpy().copy(),
        accel=tracks["accel"].to_numpy().copy(),
        leader=find_surroundings(tracks).leader,
        begins=begins,
        ends=np.append(begins[1:], len(vehicle)),
        never_written=np.zeros(len(vehicle), bool),
        lost_later=np.zeros(len(vehicle), bool),
        leader_skipped=np.zeros(len(vehicle), bool),
        headway_error=np.zeros(len(vehicle)),
    )
    backward = int(plan.backward_share * len(begins))
    for each, count in (
        (_overlap(unseen_leaders), plan.overlaps),
        (_late_start(on_ramp_lane), plan.late_starts),
        (_backward, backward),
        (_frozen, plan.frozen),
        (_spike, plan.spikes),
        (_gap, plan.gaps),
        (jump, plan.jumps),
        (skip_leader, plan.wrong_leaders),
        (misread_headway, plan.wrong_headways),
        (change_lane_and_back(on_ramp_lane), plan.lane_flickers),
    ):
        _spread(work, each, count)
    damaged = tracks.with_columns(
        pl.Series("x", work.x),
        pl.Series("speed", work.speed),
        pl.Series("accel", work.accel),
        pl.Series("lane", work.lane).cast(tracks.schema["lane"]),
        pl.Series("lost", work.lost_later),
        pl.Series("leader_skipped", work.leader_skipped),
        pl.Series("headway_error", work.headway_error),
    ).filter(~pl.Series(work.never_written))
    return Injected(damaged, work.defects)


def _spread(work: Work, inflict: Inflict, count: int) -> None:
    """Damage up to `count` vehicles; those on which the defect makes no sense are passed by."""
    for place in work.free():
        if count == 0:
            return
        if place not in work.used and inflict(work, place):
            work.used.add(place)
            count -= 1


def _slowest(work: Work, place: int, wanted: int, margin: int) -> tuple[int, int] | None:
    """The run of `wanted` rows around the slowest row that is not near an end."""
    rows = work.rows(place)
    inner = work.speed[rows][margin : max(margin, rows.stop - rows.start - margin - wanted)]
    if not len(inner):
        return None
    first = rows.start + margin + int(np.argmin(inner))
    return first, first + wanted - 1


def _late_start(on_ramp_lane: int | None) -> Inflict:
    def inflict(work: Work, place: int) -> bool:
        """The first part of the track was never seen."""
        rows = work.rows(place)
        start = work.random.uniform(SHALLOWEST_START_M, DEEPEST_START_M)
        first = rows.start
        if work.frame[first] <= work.rate_hz + 1 or work.lane[first] == on_ramp_lane or work.x[first] > 5:
            return False
        kept = rows.start + int(np.argmax(work.x[rows] >= start))
        if kept == first or rows.stop - kept < work.rate_hz:
            return False
        work.never_written[first:kept] = True
        work.note("late_start", first, kept - 1, work.x[kept])
        return True

    return inflict


def _overlap(unseen_leaders: bool) -> Inflict:
    unseen = [unseen_leaders]

    def inflict(work: Work, place: int) -> bool:
        """For a while the vehicle drifts into its leader, where it is nearest to it, and back out again."""
        ramp, deep = round(DRIFT_S * work.rate_hz), work.seconds(0.4, 1.6)
        run = _nearest_to_leader(work, place, 2 * ramp + deep)
        if run is None:
            return False
        rows = slice(run[0], run[1] + 1)
        leaders = work.leader[rows]
        ahead = int(np.searchsorted(work.begins, leaders[0], side="right")) - 1
        rear = work.x[leaders] - work.length[leaders]
        if ahead in work.used:
            return False
        depth = float(work.random.uniform(0.4, 0.5 * min(4.0, work.length[leaders[0]])))
        rise = (1 - np.cos(np.pi * (np.arange(ramp) + 1) / (ramp + 1))) / 2
        share = np.concatenate([rise, np.ones(deep), rise[::-1]])
        gap = (1 - share) * (rear - work.x[rows]) - share * depth
        # So near to touching, the file's rounding would decide whether it is an overlap.
        gap = np.where(np.abs(gap) < CLEAR_M, CLEAR_M, gap)
        work.x[rows] = rear - gap
        inside = np.flatnonzero(gap < 0) + rows.start
        work.used.add(ahead)
        work.note("overlap", int(inside[0]), int(inside[-1]), depth)
        if unseen[0]:
            # Some of the leader's entries are lost, but the headway to it has been recorded.
            unseen[0] = False
            lost = work.leader[inside][: max(1, len(inside) // 2)]
            work.lost_later[lost] = True
            work.note("frame_gap", int(lost[0]), int(lost[-1]))
            work.note("overlap_unseen", int(inside[0]), int(inside[0]) + len(lost) - 1, depth)
        return True

    return inflict


def _nearest_to_leader(work: Work, place: int, wanted: int) -> tuple[int, int] | None:
    """The run of `wanted` rows behind one leader around the smallest gap that is at most NEAREST_LEADER_M."""
    rows = work.rows(place)
    leader = work.leader[rows]
    if rows.stop - rows.start < wanted or (leader < 0).all():
        return None
    gap = np.where(leader < 0, np.inf, work.x[leader] - work.length[leader] - work.x[rows])
    nearest = int(np.argmin(gap))
    first = min(max(0, nearest - wanted // 2), rows.stop - rows.start - wanted)
    chosen = slice(first, first + wanted)
    one_leader = (leader[chosen] >= 0).all() and len(np.unique(work.vehicle[leader[chosen]])) == 1
    if not one_leader or gap[chosen].max() > NEAREST_LEADER_M or gap[chosen].min() < CLEAR_M:
        return None
    return rows.start + first, rows.start + first + wanted - 1


def _backward(work: Work, place: int) -> bool:
    """The vehicle rolls back: a smooth swing where it is slow, wrong signs in its recorded speed where it is not."""
    wanted = work.seconds(4.0, 5.0)
    run = _slowest(work, place, wanted, margin=round(work.rate_hz / 2))
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    if work.speed[rows].max() < ROLLING_MPS:
        # x falls back by `depth` m and returns; speed and acceleration are the derivatives of that.
        lasts = wanted / work.rate_hz
        depth = (work.speed[rows][: wanted // 2].max() + 0.3) * lasts / np.pi
        phase = 2 * np.pi * (np.arange(wanted) + 1) / (wanted + 1)
        work.x[rows] -= depth / 2 * (1 - np.cos(phase))
        work.speed[rows] -= depth * np.pi / lasts * np.sin(phase)
        work.accel[rows] -= depth * 2 * np.pi**2 / lasts**2 * np.cos(phase)
        # Rounded to nothing in the file, these would be slow and without acceleration by chance.
        work.accel[rows] = np.where(np.abs(work.accel[rows]) < 0.02, 0.02, work.accel[rows])
    else:
        rows = slice(run[0], run[0] + max(1, wanted // 6))
        work.speed[rows] = -work.random.uniform(0.1, 0.6)
    below = np.flatnonzero(work.speed[rows] < -0.02) + rows.start
    work.speed[rows] = np.where(np.abs(work.speed[rows]) <= 0.02, 0.05, work.speed[rows])
    for part in np.split(below, np.flatnonzero(np.diff(below) > 1) + 1):
        work.note("backward", int(part[0]), int(part[-1]), work.speed[part].min())
    return True


def _frozen(work: Work, place: int) -> bool:
    """A slow speed stays the same for a while, with exactly no acceleration."""
    run = _slowest(work, place, work.seconds(0.4, 1.2), margin=round(work.rate_hz / 2))
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    work.speed[rows] = work.random.uniform(0.1, 1.45)
    work.accel[rows] = 0.0
    work.note("frozen_slow_speed", *run, work.speed[run[0]])
    return True


def _spike(work: Work, place: int) -> bool:
    """The recorded acceleration is beyond what cars do."""
    run = pick_run(work, place, work.seconds(0.05, 0.5), margin=2)
    if run is None:
        return False
    work.accel[run[0] : run[1] + 1] = work.random.uniform(3.2, 9.0)
    work.note("acceleration_spike", *run, work.accel[run[0]])
    return True


def _gap(work: Work, place: int) -> bool:
    """Some frames in the middle of the track are missing."""
    run = pick_run(work, place, work.seconds(0.1, 1.0), margin=round(work.rate_hz))
    if run is None:
        return False
    work.lost_later[run[0] : run[1] + 1] = True
    work.note("frame_gap", *run)
    return True
