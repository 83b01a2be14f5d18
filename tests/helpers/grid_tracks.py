"""Tensor folders of the protocol grid-2021: vehicles behind each other, some of which change lanes."""

import numpy as np
from lane_tracks import open_tracks, track

from tracklake.schemas.protocols import PROTOCOLS

GRID = PROTOCOLS["grid-2021"]
RATE_HZ = GRID.rate_hz


def drive_track(vehicle_id, start_m, speed_mps, lane, *, ticks=70, accel_mps2=0.0, change=None):
    """Rows of a vehicle; `change` is (first tick, ticks, lanes to the right) of a lane change along a half cosine."""
    time_s = np.arange(ticks) / RATE_HZ
    x_m = start_m + speed_mps * time_s + accel_mps2 / 2 * time_s**2
    y_m = np.full(ticks, 4.0 * lane - 2.0)
    if change is not None:
        first, length, lanes = change
        share = np.clip((np.arange(ticks) - first) / length, 0, 1)
        y_m += 4.0 * lanes * (1 - np.cos(np.pi * share)) / 2
    speeds = speed_mps + accel_mps2 * time_s
    rows = track(vehicle_id, y_m.tolist(), x_m=x_m.tolist())
    return [(*row[:6], float(speed), row[7]) for row, speed in zip(rows, speeds, strict=True)]


def open_busy_road(path, *, vehicles=24, seed=0):
    """Two recordings of columns of vehicles, 30 m apart, in the middle lane; every second one changes lanes."""
    draw, rows_by_subset = np.random.default_rng(seed), {}
    for subset in ("a", "b"):
        rows = []
        for number in range(vehicles):
            change = (int(draw.integers(10, 45)), int(draw.integers(15, 30)), int(draw.choice([-1, 1])))
            rows += drive_track(
                number + 1,
                30.0 * number,
                20.0 + draw.normal(),
                2,
                accel_mps2=draw.normal(scale=0.4),
                change=change if number % 2 else None,
            )
        rows_by_subset[subset] = rows
    return open_tracks(path, rows_by_subset, parts={"b": "eval"}, protocol=GRID)
