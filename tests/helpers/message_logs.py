"""Messages of vehicles: real ones where they are at hand, rows as readers return them, files of a few lines."""

from pathlib import Path

import polars as pl
import pytest
from lake_sources import EXCERPTS

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.messages import MESSAGE_SCHEMA

REAL = EXCERPTS.parent / "v2v"
needs_real_messages = pytest.mark.skipif(not REAL.is_dir(), reason="the real messages are not at hand")

MESSAGE = {
    "line": 1,
    "receiver": None,
    "utc_us": 1_525_190_663_694_000,
    "received_us": 1_525_190_663_750_000,
    "second_mark_ms": None,
    "own": False,
    "sender": None,
    "temporary_id": "9D59FB77",
    "message_count": 93,
    "lat_deg": 39.1874242,
    "lon_deg": -104.8498164,
    "elevation_m": 2091.7,
    "speed_mps": 9.76,
    "heading_deg": 8.6,
    "accel_mps2": -4.16,
    "lateral_accel_mps2": 0.5,
    "vertical_accel_mps2": 0.0,
    "yaw_rate_degps": -1.25,
    "steering_angle_deg": 3.0,
    "semi_major_m": 2.0,
    "semi_minor_m": 1.95,
    "orientation_deg": 45.0,
    "transmission": "forwardGears",
    "length_m": 5.7,
    "width_m": 1.9,
}
"""A message of another vehicle, received 56 ms after it was generated."""


def make_messages(*rows: dict[str, object]) -> pl.DataFrame:
    """Build messages from what differs from MESSAGE; lines are numbered in their order."""
    return pl.DataFrame(
        [MESSAGE | {"line": number} | row for number, row in enumerate(rows, start=1)],
        schema=MESSAGE_SCHEMA,
        strict=False,
    )


def write_log(folder: Path, *lines: str, name: str = "log") -> RawFile:
    path = folder / name
    path.write_text("".join(f"{line}\n" for line in lines))
    return RawFile(path, name)
