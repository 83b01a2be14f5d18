"""`bsm`: basic safety messages (SAE J2735) that an instrumented vehicle sent or received."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column
from tracklake.schemas.drives import TIME_S, VEHICLE_ID

BSM = Table(
    "bsm",
    "One row per basic safety message that was kept, with its values in SI units.",
    key=("vehicle_id", "time_s"),
    columns={
        **PLACE,
        "vehicle_id": VEHICLE_ID,
        "time_s": column(pl.Float64, "when it was generated: seconds since the drive's start", unit="s", ge=0),
        "received_s": column(
            pl.Float64,
            "when the ego received it, by the ego's clock; null where unlogged and for its own",
            unit="s",
            nullable=True,
        ),
        "own": column(pl.Boolean, "whether the ego sent it"),
        "temporary_id": column(pl.String, "the sender's id in the message, 8 hex digits or as logged"),
        "message_count": column(pl.Int16, "the sender's counter", nullable=True, ge=0, le=127),
        "lost_before": column(pl.Int32, "the sender's messages missing between the one before and this", ge=0),
        "clock_step_s": column(
            pl.Float32, "jump of the sender's clock before this message; null = none", unit="s", nullable=True
        ),
        "lat_deg": column(pl.Float64, "WGS-84 latitude of the vehicle's centre", unit="deg", ge=-90, le=90),
        "lon_deg": column(pl.Float64, "WGS-84 longitude of the vehicle's centre", unit="deg", ge=-180, le=180),
        "elevation_m": column(pl.Float32, "above the ellipsoid", unit="m", nullable=True),
        "speed_mps": column(pl.Float32, "along the vehicle's heading", unit="m/s", nullable=True, ge=0),
        "heading_deg": column(pl.Float32, "clockwise from north", unit="deg", nullable=True, ge=0, lt=360),
        "accel_mps2": column(pl.Float32, "along the vehicle; braking is negative", unit="m/s2", nullable=True),
        "lateral_accel_mps2": column(pl.Float32, "positive to the driver's right", unit="m/s2", nullable=True),
        "vertical_accel_mps2": column(pl.Float32, "positive down, as in J2735", unit="m/s2", nullable=True),
        "yaw_rate_degps": column(pl.Float32, "clockwise is positive", unit="deg/s", nullable=True),
        "steering_angle_deg": column(
            pl.Float32, "of the steering wheel, positive to the right", unit="deg", nullable=True
        ),
        "semi_major_m": column(
            pl.Float32, "one standard deviation along the error ellipse's long axis", unit="m", nullable=True, ge=0
        ),
        "semi_minor_m": column(pl.Float32, "the same along its short axis", unit="m", nullable=True, ge=0),
        "orientation_deg": column(
            pl.Float32, "of the long axis, clockwise from north", unit="deg", nullable=True, ge=0, lt=360
        ),
        "transmission": column(pl.String, "neutral, park, forwardGears or reverseGears", nullable=True),
        "length_m": column(pl.Float32, "of the vehicle; null where not sent", unit="m", nullable=True, gt=0, le=100),
        "width_m": column(pl.Float32, "of the vehicle; null where not sent", unit="m", nullable=True, gt=0, le=20),
    },
)


EGO_STATES = Table(
    "ego_states",
    "One row per moment at which the ego's own position was logged, by its messages or its receiver.",
    key=("time_s",),
    columns={
        **PLACE,
        "time_s": TIME_S,
        "source": column(pl.String, "bsm or gnss", isin=("bsm", "gnss")),
        "lat_deg": column(pl.Float64, "WGS-84 latitude of the ego's centre", unit="deg", ge=-90, le=90),
        "lon_deg": column(pl.Float64, "WGS-84 longitude of the ego's centre", unit="deg", ge=-180, le=180),
        "elevation_m": column(pl.Float32, "above the ellipsoid", unit="m", nullable=True),
        "speed_mps": column(pl.Float32, "along its heading", unit="m/s", nullable=True, ge=0),
        "heading_deg": column(pl.Float32, "clockwise from north", unit="deg", nullable=True, ge=0, lt=360),
        "accel_mps2": column(pl.Float32, "along the vehicle; braking is negative", unit="m/s2", nullable=True),
        "yaw_rate_degps": column(pl.Float32, "clockwise is positive", unit="deg/s", nullable=True),
    },
)
