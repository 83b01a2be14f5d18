"""Position errors after fusion, the geodesy's round trip, and how long fusion takes.

    python benchmarks/onboard_fusion.py [--seeds N]

A car drives 50 m ahead at 30 m/s; GPS is plain, as `tracklake instrument` models it (an error of 1.2 m per axis and
receiver that changes within 30 s, beside one that both share), and headings are off by 1 degree. LiDAR measures the
centre with an error of 0.1 m per axis. Then 20 vehicles over 10 minutes, in traffic on three lanes.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from drive_scenes import Scene, compare, drive, measure_centres

from tracklake.pipeline.transforms.onboard.geodesy import convert_to_ecef, locate_from_ego_frame, place_in_ego_frame
from tracklake.pipeline.transforms.onboard.surrounding import Sensors, fuse_drive
from tracklake.schemas import SURROUNDING
from tracklake.schemas.arrays import Floats

POINTS = 1_000_000
"""Positions that are converted there and back."""
SETTLED_TICKS = 20
"""First ticks that are not judged: a vehicle is first found by messages alone."""
GPS_M, GPS_TIME_S, RANDOM_M = 1.2, 30.0, 0.1
"""Errors of plain GPS per axis that receivers do not share: slow, the time in which it changes, and white noise."""


def measure_errors(seed: int, *, curvature: float, hidden: bool) -> Floats:
    """Return median errors in m of one drive: by messages alone, with LiDAR, and smoothed."""
    scene = drive(
        [0, 50], [0, 0], [30, 30], seed=seed, curvature=curvature, heading_error_deg=1.0, gps_m=GPS_M,
        gps_time_s=GPS_TIME_S, random_m=RANDOM_M, hidden={1: slice(100, 150)} if hidden else {},
    )  # fmt: skip
    bsm, states = scene.make_messages(latency_s=0.03, loss=0.05)
    sensors = (Sensors(), Sensors(scans=scene.scan(), measure=measure_centres))
    alone, fused = (fuse_drive(bsm, states, scene.ticks, one).tables[SURROUNDING] for one in sensors)
    ticks = np.arange(100, 150) if hidden else np.arange(SETTLED_TICKS, scene.ticks)
    smoothed = ("smoothed_x_m", "smoothed_y_m")
    judged = (compare(scene, alone), compare(scene, fused), compare(scene, fused, smoothed))
    return np.array([float(np.median(rows.filter(rows["tick"].is_in(ticks))["error_m"])) for rows in judged])


def state_errors(seeds: int) -> None:
    """Print median errors over seeds, with bootstrap intervals of 95 %."""
    print(f"median position error of a vehicle 50 m ahead, m, {seeds} seeds (95 % interval)")
    draws = np.random.default_rng(0).integers(0, seeds, (2_000, seeds))
    for name, curvature, hidden in (
        ("straight", 0.0, False), ("curve of 500 m", 1 / 500, False), ("hidden from LiDAR for 5 s", 0.0, True)
    ):  # fmt: skip
        errors = np.stack([measure_errors(seed, curvature=curvature, hidden=hidden) for seed in range(seeds)])
        low, high = np.quantile(np.median(errors[draws], axis=1), [0.025, 0.975], axis=0)
        texts = (
            f"{what} {middle:.2f} ({least:.2f} to {most:.2f})"
            for what, middle, least, most in zip(
                ("messages alone", "with LiDAR", "smoothed"), np.median(errors, axis=0), low, high, strict=True
            )
        )
        print(f"  {name}: {', '.join(texts)}")


def state_speed() -> None:
    """Print how long 10 minutes with 20 vehicles take, without the clustering of LiDAR returns."""
    draw = np.random.default_rng(1)
    ahead, lanes = np.append(0.0, np.arange(-80, 120, 10.0)), np.append(0.0, np.tile([-3.7, 0.0, 3.7], 7)[:20])
    scene: Scene = drive(ahead, lanes, 25 + draw.normal(0, 0.02, 21), seconds=600, gps_m=GPS_M, gps_time_s=GPS_TIME_S)
    bsm, states = scene.make_messages()
    scans = list(scene.scan())
    for name, sensors in (
        ("messages", Sensors()), ("messages and LiDAR centres", Sensors(scans=iter(scans), measure=measure_centres))
    ):  # fmt: skip
        started = time.perf_counter()
        rows = fuse_drive(bsm, states, scene.ticks, sensors).tables[SURROUNDING].height
        print(f"fusion of {name}, 10 minutes, {rows:,} rows: {time.perf_counter() - started:.1f} s")


def state_round_trip() -> None:
    """Print how long a million positions take to the ego's frame, and how far off they are back again."""
    draw = np.random.default_rng(2)
    ego = np.stack([draw.uniform(low, high, POINTS) for low, high in ((-80, 80), (-179, 179), (-50, 3_000))], 1)
    near = ego + draw.normal(0, 1, (POINTS, 3)) * (1e-3, 1e-3, 5)
    heading_deg = draw.uniform(0, 360, POINTS)
    started = time.perf_counter()
    placed = place_in_ego_frame(near, ego, heading_deg)
    taken_s = time.perf_counter() - started
    back = locate_from_ego_frame(placed, ego, heading_deg)
    error_m = np.linalg.norm(convert_to_ecef(*back.T) - convert_to_ecef(*near.T), axis=1).max()
    print(
        f"{POINTS:,} positions to the ego's frame: {taken_s:.2f} s; there and back at most {error_m * 1e6:.2f} um off"
    )


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=30)
    state_round_trip()
    state_errors(parser.parse_args().seeds)
    state_speed()


if __name__ == "__main__":
    main()
