"""Injection of a tracker's errors: lost ends, second tracks, impossible motion and sizes that change."""

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.damaged_tracks import DamagedTracks, Injector, draw_run

KEPT_SHARE = (0.4, 0.8)
"""Range of the share of its way after which a track that ends early is lost."""
SECOND_TRACK_M = (-0.3, 0.1)
"""Offset of a second track along and across the road, in m."""
SIDEWAYS_SHARE = 0.2
"""Speed to the right of a vehicle that seems to slide, as a share of its speed."""
LEAST_SLIDING_MPS = 8.0
"""Least speed of a vehicle that seems to slide, in m/s."""


def inject_hard_braking(work: DamagedTracks, place: int) -> bool:
    """Record a deceleration that no vehicle reaches."""
    run = draw_run(work, place, work.draw_frames(0.05, 0.5), margin=2)
    if run is None:
        return False
    work.accel[run[0] : run[1] + 1] = -work.random.uniform(8.5, 14.0)
    work.add_defect("hard_braking", *run, work.accel[run[0]])
    return True


def inject_sideways_speed(work: DamagedTracks, place: int) -> bool:
    """Record a speed to the right for one frame, as if the vehicle slid."""
    run = draw_run(work, place, 1, margin=round(work.rate_hz / 2))
    if run is None or work.speed[run[0]] < LEAST_SLIDING_MPS:
        return False
    work.lateral_speed[run[0]] = SIDEWAYS_SHARE * work.speed[run[0]]
    work.add_defect("sideways_speed", *run, work.lateral_speed[run[0]])
    return True


def inject_size_change(work: DamagedTracks, place: int) -> bool:
    """Record a greater length for a while, but not in the first entry."""
    run = draw_run(work, place, work.draw_frames(0.2, 1.0), margin=2)
    if run is None:
        return False
    error = work.random.uniform(0.3, 0.8)
    work.length[run[0] : run[1] + 1] += error
    work.add_defect("size_change", *run, error)
    return True


def make_early_end_injector(on_ramp_lane: int | None) -> Injector:
    """Make an injector that removes the last part of a track, where the vehicle drives in a main lane."""

    def damage_vehicle(work: DamagedTracks, place: int) -> bool:
        rows = work.find_rows(place)
        x = work.x[rows]
        if work.frame[rows.stop - 1] > work.frame.max() - work.rate_hz - 1 or x[-1] - x[0] < 100:
            return False
        kept = rows.start + int(np.argmax(x >= x[0] + work.random.uniform(*KEPT_SHARE) * (x[-1] - x[0])))
        # The auxiliary lane, into which the on-ramp leads, is the one before it.
        if on_ramp_lane is not None and work.lane[kept] >= on_ramp_lane - 1:
            return False
        work.never_written[kept + 1 : rows.stop] = True
        work.add_defect("early_end", kept + 1, rows.stop - 1, work.x[kept])
        return True

    return damage_vehicle


def inject_second_track(work: DamagedTracks, place: int) -> bool:
    """Write the first seconds of a track that enters the section a second time, under another id."""
    rows = work.find_rows(place)
    wanted = work.draw_frames(1.0, 2.5)
    if work.frame[rows.start] <= work.rate_hz + 1 or work.x[rows.start] > 5 or rows.stop - rows.start < 2 * wanted:
        return False
    copied = slice(rows.start, rows.start + wanted)
    work.copies.append((copied, work.next_vehicle))
    work.add_defect("second_track", copied.start, copied.stop - 1, work.vehicle[rows.start], work.next_vehicle)
    work.next_vehicle += 1
    return True


def copy_rows(tracks: pl.DataFrame, copies: list[tuple[slice, int]]) -> list[pl.DataFrame]:
    """Copy rows of tracks under other ids, a little beside the originals."""
    along, across = SECOND_TRACK_M
    return [
        tracks[rows].with_columns(
            pl.col("x") + along, pl.col("y") + across, vehicle=pl.lit(vehicle, tracks.schema["vehicle"])
        )
        for rows, vehicle in copies
    ]
