"""Samples and their context by slow, obvious loops: clock, maneuvers, grid, the nearest and drops, one entry at a time.

Positions are whole millimetres in and whole half millimetres out, so that a position midway between two frames (25 Hz
on a 10 Hz clock) is a whole number, too, and nothing below is rounded.
"""

from fractions import Fraction
from typing import NamedTuple

CELL = 9144
"""15 feet in half millimetres."""
REACH = 6 * CELL


class Place(NamedTuple):
    """Where a vehicle is on a tick, and the gap-free run of frames that it is in."""

    x: int
    y: int
    lane: int
    frame: int | None
    run: tuple[int, int]


def put_on_clock(entries, *, first_frame, frame_rate_hz, rate_hz):
    """{(vehicle, tick): Place} of (vehicle, frame, x_mm, y_mm, lane) entries."""
    at = {(vehicle, frame): rest for vehicle, frame, *rest in entries}
    clock = {}
    for vehicle, frame in sorted(at):
        run = frame
        while (vehicle, run - 1) in at:
            run -= 1
        tick = Fraction(frame - first_frame) * rate_hz / Fraction(frame_rate_hz)
        x, y, lane = at[vehicle, frame]
        if tick.denominator == 1:
            clock[vehicle, int(tick)] = Place(2 * x, 2 * y, lane, frame, (vehicle, run))
        after = int(tick) + 1
        there = first_frame + after * Fraction(frame_rate_hz) / rate_hz
        if frame < there < frame + 1 and (vehicle, frame + 1) in at:
            assert there == frame + Fraction(1, 2)
            later_x, later_y, _ = at[vehicle, frame + 1]
            clock[vehicle, after] = Place(x + later_x, y + later_y, lane, None, (vehicle, run))
    return clock


def label(clock, vehicle, tick, rate_hz):
    """(lateral, longitudinal) maneuver."""

    def window(seconds):
        """The place so long before or after, or the last one on the way there, and how many ticks off it is."""
        step = 1 if seconds > 0 else -1
        end = tick
        while abs(end - tick) < abs(seconds) * rate_hz:
            if (vehicle, end + step) not in clock or clock[vehicle, end + step].run != here.run:
                break
            end += step
        return clock[vehicle, end], abs(end - tick)

    here = clock[vehicle, tick]
    before, after = window(-4)[0].lane, window(4)[0].lane
    lateral = "keep"
    if after < here.lane or here.lane < before:
        lateral = "left"
    if after > here.lane or here.lane > before:
        lateral = "right"
    (back, since), (ahead, until) = window(-3), window(5)
    longitudinal = "normal"
    if since and until and here.x > back.x:
        ratio = Fraction(ahead.x - here.x, until) / Fraction(here.x - back.x, since)
        if ratio < Fraction(4, 5):
            longitudinal = "brake"
    return lateral, longitudinal


def fill_grid(clock, vehicle, tick):
    """({cell: (neighbor, dx)}, collisions, crowded out)."""
    here = clock[vehicle, tick]
    grid, collisions, crowded_out = {}, 0, 0
    for column in range(3):
        home = []
        for (other, other_tick), place in clock.items():
            dx = place.x - here.x
            if other_tick == tick and other != vehicle and place.lane - here.lane == column - 1 and abs(dx) < REACH:
                cells = (2 * abs(dx) + CELL) // (2 * CELL)
                home.append((abs(dx), other, 6 + (cells if dx > 0 else -cells), dx))
        taken, movers = {}, []
        for candidate in sorted(home):
            if candidate[2] in taken:
                movers.append(candidate)
            else:
                taken[candidate[2]] = candidate
        collisions += len(movers)
        for candidate in movers:
            side = 1 if candidate[3] >= 0 else -1
            free = [
                (abs(row - candidate[2]), -side * (row - candidate[2]), row) for row in range(13) if row not in taken
            ]
            if free:
                taken[min(free)[2]] = candidate
            else:
                crowded_out += 1
        grid |= {13 * column + row: (candidate[1], candidate[3]) for row, candidate in taken.items()}
    return grid, collisions, crowded_out


def list_nearest(clock, vehicle, tick, k):
    """Ids of the k nearest."""
    here = clock[vehicle, tick]
    others = [
        ((place.x - here.x) ** 2 + (place.y - here.y) ** 2, other)
        for (other, other_tick), place in clock.items()
        if other_tick == tick and other != vehicle
    ]
    return [other for _, other in sorted(others)[:k]]


def judge(clock, vehicle, tick, protocol, *, first_frame, frame_rate_hz, early=(), findings=()):
    """Why the entry is no sample; None where it is one. History and future are whole ticks of the protocol."""
    here = clock[vehicle, tick]
    steps = (round(protocol.history_s * protocol.rate_hz), round(protocol.min_future_s * protocol.rate_hz))
    for reason, ticks in (
        ("short_history", range(tick - steps[0], tick)),
        ("short_future", range(tick + 1, tick + 1 + steps[1])),
    ):
        if any((vehicle, t) not in clock or clock[vehicle, t].run != here.run for t in ticks):
            return reason
    if vehicle in early:
        return "early_vehicle"
    stride = Fraction(frame_rate_hz) / protocol.rate_hz
    begins = first_frame + (tick - steps[0]) * stride
    ends = first_frame + (tick + round(protocol.horizon_s * protocol.rate_hz)) * stride
    errors = [(first, last) for whose, severity, first, last in findings if (whose, severity) == (vehicle, "error")]
    frames = [frame for first, last in errors for frame in range(first, last + 1)]
    # A tick between two frames is made of both: frames less than one away take part in it.
    if protocol.drop_error_findings and any(begins - 1 < frame < ends + 1 for frame in frames):
        return "error_finding"
    return None
