"""`tracks`: one row per entry, in the canonical frame. Bounds are what physics and the fields of view forbid."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column

TRACKS = Table(
    "tracks",
    "One row per (vehicle, frame) at the source's own frame rate, in SI units: x_m runs in the direction of "
    "travel, y_m to the driver's right; both are those of the vehicle's FRONT CENTRE.",
    key=("vehicle_id", "frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "unique within the subset; the source's own id unless that was reused", ge=0),
        "frame": column(pl.Int32, "the source's frame number", ge=0),
        "time_s": column(pl.Float64, "since the recording's first frame", unit="s", ge=0),
        "x_m": column(
            pl.Float64,
            "front centre along the direction of travel, or along the road's axis (exiD, inD, rounD); with headings: "
            "body's middle + length/2 * cos(heading), to 1 mm",
            unit="m",
            ge=-2_000,
            le=20_000,
        ),
        "y_m": column(
            pl.Float64,
            "front centre from the carriageway's left edge (arterials: the street's), positive to the driver's right; "
            "with headings: body's middle + length/2 * sin(heading), to 1 mm",
            unit="m",
            ge=-2_000,
            le=2_000,
        ),
        "heading_rad": column(
            pl.Float32,
            "direction in which the body points, 0 along the road, positive to the driver's right, to 0.0001: as "
            "recorded, or (highD) that of the recorded velocity over 0.2 s, below 2 m/s the last one; null where the "
            "source has none (NGSIM)",
            unit="rad",
            nullable=True,
            ge=-1.6,
            le=1.6,
        ),
        "lane": column(
            pl.Int16,
            "1 is the driver's leftmost; as recorded, so that y_m may lie in the next lane just before or after a lane "
            "change; I-24: by strips of 12 ft; null where the source has none",
            nullable=True,
            ge=0,
        ),
        "speed_mps": column(
            pl.Float32,
            "recorded, signed along the direction of travel or the road's axis: negative is backwards; "
            "I-24: central difference of the back's position",
            unit="m/s",
            ge=-40,
            le=100,
        ),
        "accel_mps2": column(
            pl.Float32,
            "recorded, signed along the direction of travel: negative is braking; null where the source has none",
            unit="m/s2",
            nullable=True,
            ge=-200,
            le=200,
        ),
        "speed_cd_mps": column(
            pl.Float32,
            "central difference of x_m over the neighbouring frames; null at track ends and beside frame gaps",
            unit="m/s",
            nullable=True,
        ),
        "accel_cd_mps2": column(
            pl.Float32,
            "central difference of speed_cd_mps; null at track ends and beside frame gaps",
            unit="m/s2",
            nullable=True,
        ),
        "lateral_speed_mps": column(
            pl.Float32,
            "positive to the driver's right; recorded where the source has it (of the body's middle), else "
            "central difference of y_m",
            unit="m/s",
            nullable=True,
        ),
        "speed_10hz_mps": column(
            pl.Float32,
            "central difference of x_m 0.1 s before and after (linear between frames); null where those are missing",
            unit="m/s",
            nullable=True,
        ),
        "accel_10hz_mps2": column(
            pl.Float32,
            "central difference of speed_10hz_mps 0.1 s before and after; null where those are missing",
            unit="m/s2",
            nullable=True,
        ),
        "leader_id": column(
            pl.Int32, "vehicle ahead in the lane, as recorded, else derived (TGSIM, I-24); null = none", nullable=True
        ),
        "follower_id": column(
            pl.Int32, "vehicle behind in the lane, as recorded, else derived (TGSIM, I-24); null = none", nullable=True
        ),
        "gap_m": column(
            pl.Float64,
            "leader's front - leader's length - own front, rounded to 1 mm; exact where the leader points along the "
            "road, less than 1 cm too small at 2 degrees and 15 m; negative = overlap; null = no leader",
            unit="m",
            nullable=True,
        ),
        "headway_recorded_m": column(
            pl.Float32, "the source's own distance headway; null = no leader", unit="m", nullable=True
        ),
    },
)
