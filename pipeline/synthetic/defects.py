"""Injection of known defects into clean tracks.

A vehicle has one defect at most, and a leader that another vehicle is shifted into has none. The one exception is an
NGSIM overlap whose leader also misses frames, declared as both. A second track is a defect of its own id.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.damaged_tracks import DamagedTracks, Defect, Injector, draw_run
from tracklake.pipeline.synthetic.neighbors import find_surroundings
from tracklake.pipeline.synthetic.recording_errors import (
    inject_jump,
    inject_wrong_headway,
    inject_wrong_leader,
    make_lane_flicker_injector,
)
from tracklake.pipeline.synthetic.scenarios import Plan
from tracklake.pipeline.synthetic.tracking_errors import (
    copy_rows,
    inject_hard_braking,
    inject_second_track,
    inject_sideways_speed,
    inject_size_change,
    make_early_end_injector,
)
from tracklake.schemas.arrays import find_run_starts

LATE_START_M = (20.0, 200.0)
"""Range of positions at which late starts begin, in m."""
NEAREST_LEADER_M = 20.0
"""Largest gap of a vehicle that is shifted into its leader, in m; a larger shift would be no tracking error."""
DRIFT_S = 2.0
"""Time in which a vehicle drifts into its leader, and out again, in s."""
CLEAR_M = 0.05
"""Least distance of a gap from 0, so that rounding in the file does not decide whether vehicles overlap, in m."""
ROLLING_MPS = 1.6
"""Highest speed of vehicles that roll back, in m/s; their acceleration stays below 3.05 m/s2."""


@dataclass(frozen=True)
class Injected:
    """Damaged tracks and their defects.

    `lost` (Boolean) are entries that others name as their leader but that are missing from the file; `leader_skipped`
    (Boolean): the leader's leader is recorded as the leader; `headway_error` (Float64): that of the recorded headway in
    m.
    """

    tracks: pl.DataFrame
    defects: list[Defect]


def inject_defects(
    tracks: pl.DataFrame,
    plan: Plan,
    *,
    rate_hz: float,
    on_ramp_lane: int | None,
    unseen_leaders: bool,
    random: np.random.Generator,
    next_vehicle: int | None = None,
) -> Injected:
    """Damage the tracks of one subset, which are sorted by vehicle, frame, without gaps.

    Vehicles of `on_ramp_lane` begin in mid-section and so cannot start late. With `unseen_leaders` one overlap is with
    a leader that misses frames, for formats that record its headway. Second tracks have ids from `next_vehicle` on, by
    default those after the greatest.
    """
    work = _copy_tracks(tracks, rate_hz, random, next_vehicle)
    injectors: tuple[tuple[Injector, int], ...] = (
        (_make_overlap_injector(unseen_leaders), plan.overlaps),
        (_make_late_start_injector(on_ramp_lane), plan.late_starts),
        (_inject_backward, int(plan.backward_share * len(work.begins))),
        (_inject_frozen, plan.frozen),
        (_inject_spike, plan.spikes),
        (_inject_gap, plan.gaps),
        (inject_jump, plan.jumps),
        (inject_wrong_leader, plan.wrong_leaders),
        (inject_wrong_headway, plan.wrong_headways),
        (make_lane_flicker_injector(on_ramp_lane), plan.lane_flickers),
        (inject_hard_braking, plan.hard_brakings),
        (inject_sideways_speed, plan.sideways_speeds),
        (inject_size_change, plan.size_changes),
        (make_early_end_injector(on_ramp_lane), plan.early_ends),
        (inject_second_track, plan.second_tracks),
    )
    for injector, count in injectors:
        _damage_vehicles(work, injector, count)
    damaged = tracks.with_columns(
        pl.Series("x", work.x),
        pl.Series("speed", work.speed),
        pl.Series("accel", work.accel),
        pl.Series("lateral_speed", work.lateral_speed),
        pl.Series("length", work.length),
        pl.Series("lane", work.lane).cast(tracks.schema["lane"]),
        pl.Series("lost", work.lost_later),
        pl.Series("leader_skipped", work.leader_skipped),
        pl.Series("headway_error", work.headway_error),
    )
    copies = copy_rows(damaged, work.copies)
    return Injected(pl.concat([damaged.filter(~pl.Series(work.never_written)), *copies]), work.defects)


def _copy_tracks(
    tracks: pl.DataFrame, rate_hz: float, random: np.random.Generator, next_vehicle: int | None
) -> DamagedTracks:
    vehicle = tracks["vehicle"].to_numpy().astype(np.int64)
    begins = find_run_starts(vehicle)
    return DamagedTracks(
        rate_hz=rate_hz,
        random=random,
        vehicle=vehicle,
        frame=tracks["frame"].to_numpy().astype(np.int64),
        lane=tracks["lane"].to_numpy().astype(np.int64, copy=True),
        x=tracks["x"].to_numpy().copy(),
        length=tracks["length"].to_numpy().copy(),
        speed=tracks["speed"].to_numpy().copy(),
        accel=tracks["accel"].to_numpy().copy(),
        lateral_speed=tracks["lateral_speed"].to_numpy().copy(),
        leader=find_surroundings(tracks).leader,
        begins=begins,
        ends=np.append(begins[1:], len(vehicle)),
        never_written=np.zeros(len(vehicle), bool),
        lost_later=np.zeros(len(vehicle), bool),
        leader_skipped=np.zeros(len(vehicle), bool),
        headway_error=np.zeros(len(vehicle)),
        next_vehicle=int(vehicle.max(initial=0)) + 1 if next_vehicle is None else next_vehicle,
    )


def _damage_vehicles(work: DamagedTracks, injector: Injector, count: int) -> None:
    """Damage up to `count` vehicles; vehicles on which the defect is impossible are skipped."""
    for place in work.draw_free_vehicles():
        if count == 0:
            return
        if place not in work.used and injector(work, place):
            work.used.add(place)
            count -= 1


def _find_slowest_run(work: DamagedTracks, place: int, wanted: int, margin: int) -> tuple[int, int] | None:
    """Find the run of `wanted` rows from the slowest row that is not near an end."""
    rows = work.find_rows(place)
    inner = work.speed[rows][margin : max(margin, rows.stop - rows.start - margin - wanted)]
    if not len(inner):
        return None
    first = rows.start + margin + int(np.argmin(inner))
    return first, first + wanted - 1


def _make_late_start_injector(on_ramp_lane: int | None) -> Injector:
    def damage_vehicle(work: DamagedTracks, place: int) -> bool:
        """Remove the first part of the track."""
        rows = work.find_rows(place)
        start = work.random.uniform(*LATE_START_M)
        first = rows.start
        if work.frame[first] <= work.rate_hz + 1 or work.lane[first] == on_ramp_lane or work.x[first] > 5:
            return False
        kept = rows.start + int(np.argmax(work.x[rows] >= start))
        if kept == first or rows.stop - kept < work.rate_hz:
            return False
        work.never_written[first:kept] = True
        work.add_defect("late_start", first, kept - 1, work.x[kept])
        return True

    return damage_vehicle


def _make_overlap_injector(unseen_leaders: bool) -> Injector:
    unseen = [unseen_leaders]

    def damage_vehicle(work: DamagedTracks, place: int) -> bool:
        """Let the vehicle drift into its leader, where it is nearest to it, and back out again."""
        ramp, deep = round(DRIFT_S * work.rate_hz), work.draw_frames(0.4, 1.6)
        run = _find_nearest_run(work, place, 2 * ramp + deep)
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
        # So near to touching, rounding in the file would decide whether it is an overlap.
        gap = np.where(np.abs(gap) < CLEAR_M, CLEAR_M, gap)
        work.x[rows] = rear - gap
        inside = np.flatnonzero(gap < 0) + rows.start
        work.used.add(ahead)
        work.add_defect("overlap", int(inside[0]), int(inside[-1]), depth)
        if unseen[0]:
            # Some of the leader's entries are lost, but the headway to it is recorded.
            unseen[0] = False
            lost = work.leader[inside][: max(1, len(inside) // 2)]
            work.lost_later[lost] = True
            work.add_defect("frame_gap", int(lost[0]), int(lost[-1]))
            work.add_defect("overlap_unseen", int(inside[0]), int(inside[0]) + len(lost) - 1, depth)
        return True

    return damage_vehicle


def _find_nearest_run(work: DamagedTracks, place: int, wanted: int) -> tuple[int, int] | None:
    """Find the run of `wanted` rows behind one leader around the smallest gap, of at most NEAREST_LEADER_M."""
    rows = work.find_rows(place)
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


def _inject_backward(work: DamagedTracks, place: int) -> bool:
    """Let the vehicle roll back: smoothly if it is slow, else by wrong signs of its recorded speed."""
    wanted = work.draw_frames(4.0, 5.0)
    run = _find_slowest_run(work, place, wanted, margin=round(work.rate_hz / 2))
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
        # Accelerations that the file rounds to 0 would break the rule of low constant speeds by chance.
        work.accel[rows] = np.where(np.abs(work.accel[rows]) < 0.02, 0.02, work.accel[rows])
    else:
        rows = slice(run[0], run[0] + max(1, wanted // 6))
        work.speed[rows] = -work.random.uniform(0.1, 0.6)
    below = np.flatnonzero(work.speed[rows] < -0.02) + rows.start
    work.speed[rows] = np.where(np.abs(work.speed[rows]) <= 0.02, 0.05, work.speed[rows])
    for part in np.split(below, np.flatnonzero(np.diff(below) > 1) + 1):
        work.add_defect("backward", int(part[0]), int(part[-1]), work.speed[part].min())
    return True


def _inject_frozen(work: DamagedTracks, place: int) -> bool:
    """Keep a slow speed constant for a while, with an acceleration of exactly 0."""
    run = _find_slowest_run(work, place, work.draw_frames(0.4, 1.2), margin=round(work.rate_hz / 2))
    if run is None:
        return False
    rows = slice(run[0], run[1] + 1)
    work.speed[rows] = work.random.uniform(0.1, 1.45)
    work.accel[rows] = 0.0
    work.add_defect("frozen_slow_speed", *run, work.speed[run[0]])
    return True


def _inject_spike(work: DamagedTracks, place: int) -> bool:
    """Record an acceleration that no vehicle reaches."""
    run = draw_run(work, place, work.draw_frames(0.05, 0.5), margin=2)
    if run is None:
        return False
    work.accel[run[0] : run[1] + 1] = work.random.uniform(3.2, 9.0)
    work.add_defect("acceleration_spike", *run, work.accel[run[0]])
    return True


def _inject_gap(work: DamagedTracks, place: int) -> bool:
    """Remove some frames in the middle of the track."""
    run = draw_run(work, place, work.draw_frames(0.1, 1.0), margin=round(work.rate_hz))
    if run is None:
        return False
    work.lost_later[run[0] : run[1] + 1] = True
    work.add_defect("frame_gap", *run)
    return True
