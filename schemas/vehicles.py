"""`vehicles`: one row per vehicle of a subset, as ingested; `vehicle_starts`: what repair found out about it."""

import polars as pl

from tracklake.schemas.columns import PLACE, VEHICLE_CLASSES, Table, column

VEHICLES = Table(
    "vehicles",
    "One row per vehicle: who it is and the extent of its track.",
    key=("vehicle_id",),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "unique within the subset", ge=0),
        "source_vehicle_id": column(pl.Int32, "the id in the source's file", ge=0),
        "class": column(
            pl.String, "car, truck or motorcycle; null where the source has none", nullable=True, isin=VEHICLE_CLASSES
        ),
        "automated": column(
            pl.Boolean,
            "whether it is one of the source's automated vehicles (TGSIM: with adaptive cruise control or more); null "
            "where the source does not say",
            nullable=True,
            added=True,
        ),
        "length_m": column(pl.Float32, "along the direction of travel", unit="m", nullable=True, ge=0, le=100),
        "width_m": column(pl.Float32, "across the direction of travel", unit="m", nullable=True, ge=0, le=20),
        "length_range_m": column(
            pl.Float32,
            "greatest less least length in the rows of the track, to 1 mm; null where they have none, or where another "
            "size is taken for another vehicle (NGSIM)",
            unit="m",
            nullable=True,
            ge=0,
        ),
        "width_range_m": column(pl.Float32, "the same of the width", unit="m", nullable=True, ge=0),
        "first_frame": column(pl.Int32, "the track's first frame"),
        "last_frame": column(pl.Int32, "the track's last frame"),
        "entries": column(pl.Int32, "rows of the track", ge=1),
        "entries_announced": column(
            pl.Int32, "how many the source's metadata says there are (Total_Frames, numFrames)", nullable=True
        ),
        "start_x_m": column(pl.Float64, "x_m of the first entry", unit="m"),
        "end_x_m": column(pl.Float64, "x_m of the last entry", unit="m"),
        "start_lane": column(pl.Int16, "lane of the first entry", nullable=True),
        "mean_speed_mps": column(pl.Float32, "mean of the recorded speeds", unit="m/s"),
        "lane_changes": column(pl.Int32, "times the lane differs from the entry's before", nullable=True),
    },
)


VEHICLE_STARTS = Table(
    "vehicle_starts",
    "One row per vehicle of a freeway subset: how its track begins.",
    key=("vehicle_id",),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "unique within the subset", ge=0),
        "eligible": column(pl.Boolean, "first seen one second or more into the recording, and not on an on-ramp"),
        "starts_late": column(pl.Boolean, "eligible and first seen beyond the cut-off"),
        "fully_tracked": column(pl.Boolean, "eligible, first seen at or before the cut-off, and no frame gap"),
        "early": column(pl.Boolean, "entered before the road ahead was fully recorded: gives no samples"),
    },
)
