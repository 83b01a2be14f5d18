"""`drives` and `stations`: recordings of an instrumented vehicle, and the vehicles whose messages it logged."""

import polars as pl

from tracklake.schemas.columns import ORIGINS, PLACE, Table, column
from tracklake.schemas.subsets import SOURCE_FILE

TICK_RATE_HZ = 10
"""Ticks per second on the clock of every drive, in Hz: tick k lies at time_s = k / 10."""
VEHICLE_ID = column(pl.Int32, "vehicle of the drive: a station, or from 1,000,000 on one that only LiDAR saw", ge=0)
TIME_S = column(pl.Float64, "seconds since the drive's start", unit="s", ge=0)
TICK = column(pl.Int32, "time_s = tick / 10", ge=0)

DRIVES = Table(
    "drives",
    "One row per drive: the log of one instrumented vehicle, the ego.",
    key=("subset",),
    columns={
        **PLACE,
        "recording": column(pl.String, "folder or file that the drive was read from"),
        "origin": column(pl.String, "recorded on a road, or synthetic: by `tracklake instrument`", isin=ORIGINS),
        "start_utc": column(pl.Datetime("us"), "moment, in UTC, at which time_s = 0"),
        "seconds": column(pl.Float64, "from the first record to the last", unit="s", ge=0),
        "ego_id": column(pl.Int32, "station of the ego's own messages; null where it logged none", nullable=True),
        "ego_length_m": column(pl.Float32, "null where unknown", unit="m", nullable=True, gt=0, le=100),
        "ego_width_m": column(pl.Float32, "null where unknown", unit="m", nullable=True, gt=0, le=20),
        "stations": column(pl.Int32, "vehicles whose messages were kept, the ego's own included", ge=0),
        "messages": column(pl.Int64, "rows of bsm", ge=0),
        "scans": column(pl.Int32, "LiDAR scans", ge=0),
        "images": column(pl.Int32, "camera images with or without boxes", ge=0),
        "camera_fx_px": column(pl.Float64, "focal length, horizontal", unit="px", nullable=True, gt=0),
        "camera_fy_px": column(pl.Float64, "focal length, vertical", unit="px", nullable=True, gt=0),
        "camera_cx_px": column(pl.Float64, "principal point, from the left", unit="px", nullable=True),
        "camera_cy_px": column(pl.Float64, "principal point, from the top", unit="px", nullable=True),
        "camera_x_m": column(pl.Float64, "camera ahead of the ego's centre", unit="m", nullable=True),
        "camera_y_m": column(pl.Float64, "camera to the right of the ego's centre", unit="m", nullable=True),
        "camera_z_m": column(pl.Float64, "camera above the ground", unit="m", nullable=True),
        "lidar_x_m": column(pl.Float64, "LiDAR ahead of the ego's centre", unit="m", nullable=True),
        "lidar_y_m": column(pl.Float64, "LiDAR to the right of the ego's centre", unit="m", nullable=True),
        "lidar_z_m": column(pl.Float64, "LiDAR above the ground", unit="m", nullable=True),
        "source_files": column(pl.List(SOURCE_FILE), "the raw files and their sha256"),
    },
)


STATIONS = Table(
    "stations",
    "One row per vehicle whose messages a drive logged: its ids over time, and what happened to its messages.",
    key=("vehicle_id",),
    columns={
        **PLACE,
        "vehicle_id": VEHICLE_ID,
        "own": column(pl.Boolean, "whether it is the ego"),
        "temporary_ids": column(pl.List(pl.String), "ids in the messages, the first used first"),
        "id_changes": column(pl.Int32, "times it was given another temporary id", ge=0),
        "length_m": column(pl.Float32, "as sent; null where never", unit="m", nullable=True, gt=0, le=100),
        "width_m": column(pl.Float32, "as sent; null where never", unit="m", nullable=True, gt=0, le=20),
        "first_s": TIME_S,
        "last_s": TIME_S,
        "messages": column(pl.Int64, "messages kept", ge=1),
        "duplicates": column(pl.Int64, "messages dropped: the same counter and moment as one kept", ge=0),
        "invalid": column(pl.Int64, "messages dropped for an impossible position or time", ge=0),
        "lost": column(
            pl.Int64,
            "messages missing by the counter, which runs from 0 to 127; a silence of more than 12.8 s counts none",
            ge=0,
        ),
        "clock_steps": column(pl.Int64, "times the sender's clock jumped by over 0.5 s against the receiver's", ge=0),
        "latency_median_s": column(
            pl.Float32, "received - generated; null where either is unlogged", unit="s", nullable=True
        ),
    },
)
