"""Ingestion of a ROS bag of real size: 16 beams of 1,800 returns, 10 scans a second, with a camera and a receiver.

    python benchmarks/v2v_bags.py [--minutes 10] [--version 1] [--storage sqlite3] [--compressed] [--work DIR]

The bag is written scan by scan, in the layout of a Velodyne driver (22 bytes a point, 3.8 GB in all), and ingested
by `tracklake ingest` in a process of its own. Around the vehicle are a road, other vehicles, and walls on both sides.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
from ingest import ingest

from tracklake.pipeline.synthetic.onboard.bag_files import Camera, Image, write_bag
from tracklake.schemas.arrays import Floats, Singles

BEAMS, AZIMUTHS, RATE_HZ = 16, 1800, 10
LIDAR_M = 1.9
WALL_M, WALL_HEIGHT_M, REACH_M = 15.0, 4.0, 100.0
START_US = 1_700_000_000_000_000
VEHICLES = 8


def main() -> None:
    """Write the bag, ingest it, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the drive")
    parser.add_argument("--version", type=int, choices=(1, 2), default=1, help="of ROS")
    parser.add_argument("--storage", choices=("sqlite3", "mcap"), default="sqlite3", help="of ROS 2")
    parser.add_argument("--compressed", action="store_true", help="by LZ4 (ROS 1) or zstd (ROS 2)")
    parser.add_argument("--work", type=Path, help="folder for the bag and the lake (8 GB for 10 minutes)")
    options = parser.parse_args()
    ticks = round(options.minutes * 60 * RATE_HZ)
    with tempfile.TemporaryDirectory(dir=options.work) as work:
        raw = Path(work) / "drives" / "trip"
        raw.mkdir(parents=True)
        start = time.perf_counter()
        write_bag(
            raw / "log.bag" if options.version == 1 else raw / "log",
            version=options.version,
            ego=make_ego(ticks),
            scans=make_scans(ticks),
            images=make_images(ticks),
            camera=Camera(1200.0, 1200.0, 960.0, 540.0, 1920, 1080),
            mounts={"lidar": (0.0, 0.0, LIDAR_M), "camera": (0.5, 0.0, 1.4)},
            storage=options.storage,
            compressed=options.compressed,
        )
        written = time.perf_counter() - start
        size = sum(file.stat().st_size for file in raw.rglob("*") if file.is_file()) / 1e9
        seconds, peak = ingest(raw.parent, Path(work), dict(os.environ))
        files = list(Path(work).glob("lake/lidar_returns/**/*.parquet"))
        kept = pl.scan_parquet(files).select(pl.len()).collect().item()
        stored = sum(file.stat().st_size for file in files) / 1e9
        print("| bag | scans | points | GB | written s | ingest s | peak GiB | returns kept | GB of Parquet |")
        print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
        name = f"ROS {options.version}{', compressed' * options.compressed}"
        counts = f"{ticks:,} | {ticks * BEAMS * AZIMUTHS:,} | {size:.2f} | {written:.0f}"
        print(f"| {name} | {counts} | {seconds:.1f} | {peak:.2f} | {kept:,} | {stored:.2f} |")


def make_ego(ticks: int) -> pl.DataFrame:
    """Drive north at 20 m/s."""
    tick = np.arange(ticks)
    columns = {"utc_us": START_US + 100_000 * tick, "lat_deg": 40 + 1.8e-5 * tick, "lon_deg": np.full(ticks, -83.0)}
    constants = {"elevation_m": 200.0, "speed_mps": 20.0, "heading_deg": 0.0, "accel_mps2": 0.0, "yaw_rate_degps": 0.0}
    return pl.DataFrame(columns).with_columns(**{name: pl.lit(value) for name, value in constants.items()})


def make_scans(ticks: int) -> Iterator[tuple[int, Singles]]:
    """Cast every beam to the nearest of the road, the walls and the vehicles; beams without a return are NaN."""
    random = np.random.default_rng(1)
    elevation = np.radians(np.arange(-15, 16, 2.0))[:, None]
    azimuth = np.radians(np.arange(AZIMUTHS) * 360 / AZIMUTHS)
    along, across = np.cos(azimuth), np.sin(azimuth)
    rise = np.tan(elevation)
    with np.errstate(divide="ignore"):
        road = np.broadcast_to(np.where(rise < 0, -LIDAR_M / rise, np.inf), (BEAMS, AZIMUTHS))
        wall = np.broadcast_to(WALL_M / np.abs(across), (BEAMS, AZIMUTHS))
    wall = np.where(LIDAR_M + wall * rise < WALL_HEIGHT_M, wall, np.inf)
    centre = np.stack([random.uniform(-60, 60, VEHICLES), random.choice([-3.5, 3.5, 7.0], VEHICLES)], axis=1)
    speed = random.uniform(-2, 2, VEHICLES)
    for tick in range(ticks):
        centre[:, 0] = (centre[:, 0] + speed / RATE_HZ + 60) % 120 - 60
        flat = np.minimum(road, wall)
        body = cast_boxes(along, across, centre)
        flat = np.where(LIDAR_M + body * rise < 1.6, np.minimum(flat, body), flat)
        flat = np.where(flat <= REACH_M, flat + random.normal(0, 0.02, (BEAMS, AZIMUTHS)), np.nan)
        points = np.stack([flat * along, flat * across, flat * rise], axis=2)
        yield START_US + 100_000 * tick + 20_000, points.reshape(-1, 3).astype(np.float32)


def cast_boxes(along: Floats, across: Floats, centre: Floats) -> Floats:
    """Return the distance (A,) to the nearest vehicle in each direction, infinite where there is none."""
    with np.errstate(divide="ignore"):
        edges_x = (centre[:, :1, None] + np.array([-2.4, 2.4])) / along[:, None]
        edges_y = (centre[:, 1:, None] + np.array([-0.95, 0.95])) / across[:, None]
    enter = np.maximum(edges_x.min(axis=2), edges_y.min(axis=2))
    leave = np.minimum(edges_x.max(axis=2), edges_y.max(axis=2))
    hit = (enter > 0) & (enter <= leave)
    return np.where(hit, enter, np.inf).min(axis=0)


def make_images(ticks: int) -> Iterator[Image]:
    """Make three boxes per image."""
    boxes = np.array([[900.0, 500, 100, 80], [400, 510, 60, 50], [1300, 505, 70, 55]])
    for tick in range(ticks):
        yield Image(START_US + 100_000 * tick + 40_000, boxes, np.full(3, 0.9), ("car", "car", "truck"))


if __name__ == "__main__":
    main()
