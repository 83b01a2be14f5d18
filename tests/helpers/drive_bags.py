"""A small bag of a vehicle with a receiver, a LiDAR and a camera, written by the virtual instrumentation."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.synthetic.onboard.bag_files import Camera, Image, Stamped, make_store, write_bag, write_stream

START_US = 1_700_000_000_000_000
"""Moment of the first fix, in microseconds since 1970."""
EGO = pl.DataFrame(
    {
        "utc_us": [START_US + 100_000 * tick for tick in range(3)],
        "lat_deg": [40.0, 40.00001, 40.00002],
        "lon_deg": [-83.0, -83.0, -83.0],
        "elevation_m": [200.0, None, 201.0],
        "speed_mps": [20.0, 21.0, 22.0],
        "heading_deg": [359.0, 0.0, 1.5],
        "accel_mps2": [0.5, 0.5, -1.0],
        "yaw_rate_degps": [0.0, 2.0, -3.0],
    }
)
SCANS = (
    (START_US + 10_000, np.array([[10.0, 2.0, -1.0], [5.0, -3.0, 0.5], [8.0, 0.0, -1.9]], np.float32)),
    (START_US + 110_000, np.array([[250.0, 0.0, 0.0]], np.float32)),
)
"""Points from the LiDAR: x ahead, y right, z up; on a roof of 1.9 m the third is the road, and the fourth is far."""
IMAGES = (
    Image(
        START_US + 50_000, np.array([[100.0, 200, 50, 40], [0, 10, 20, 30]]), np.array([0.75, 0.5]), ("car", "truck")
    ),
    Image(START_US + 150_000, np.zeros((0, 4)), np.zeros(0), ()),
)
CAMERA = Camera(1000.0, 1100.0, 960.0, 540.0, 1920, 1080)
MOUNTS = {"lidar": (0.5, 0.1, 1.9), "camera": (1.0, -0.2, 1.4)}
"""Places in m: ahead of the ego's centre, to its right, above the ground."""
TEXTS = ((START_US + 60_000, '{"metadata": {}}'),)


def write_small_bag(path: Path, version: Literal[1, 2] = 1, **changes: object) -> Path:
    """Write the bag, with other arguments where given."""
    known: dict[str, Any] = {"ego": EGO, "scans": iter(SCANS), "images": iter(IMAGES), "camera": CAMERA}
    known |= {"mounts": MOUNTS, "messages": iter(TEXTS), "version": version}
    write_bag(path, **(known | changes))
    return path


def write_messages(path: Path, messages: Iterable[tuple[str, str, int, object]], version: int = 1) -> Path:
    """Write messages of any kind: topic, type without `msg`, moment in us since START_US, and the message."""
    stream = (
        Stamped(START_US + after_us, topic, name.replace("/", "/msg/"), message)
        for topic, name, after_us, message in messages
    )
    write_stream(path, stream, make_store(version), version)
    return path


def list_files(path: Path) -> list[RawFile]:
    """Return the files of a bag as they are found in a folder."""
    return [RawFile(file, file.name) for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
