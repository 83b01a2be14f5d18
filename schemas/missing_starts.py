"""`start_cutoffs` and `missing_starts`: where tracks should begin, and the missing parts of late ones."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column

METHODS = ("regression", "mean_speed")

START_CUTOFFS = Table(
    "start_cutoffs",
    "One row per freeway subset: the cut-off and how its tracks begin.",
    key=("subset",),
    columns={
        **PLACE,
        "cutoff_m": column(
            pl.Float64, "a track first seen beyond is late; null where none could be set", unit="m", nullable=True
        ),
        "eligible": column(pl.Int32, "vehicles whose start can be judged", ge=0),
        "late": column(pl.Int32, "of them, first seen beyond the cut-off", ge=0),
        "fully_tracked": column(pl.Int32, "of them, references for the repair", ge=0),
        "road_seen_from_frame": column(
            pl.Int32,
            "vehicles first seen before this frame have unrecorded road ahead (null: tracking began everywhere)",
            nullable=True,
        ),
    },
)


MISSING_STARTS = Table(
    "missing_starts",
    "One row per late start: the estimated frames between the cut-off and its first entry.",
    key=("vehicle_id",),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "whose track starts late", ge=0),
        "lane": column(pl.Int16, "of the first entry", nullable=True),
        "cutoff_m": column(pl.Float64, "where its track should have begun", unit="m"),
        "start_x_m": column(pl.Float64, "x_m of the first entry", unit="m"),
        "start_frame": column(pl.Int32, "frame of the first entry"),
        "start_speed_mps": column(pl.Float32, "recorded speed of the first entry", unit="m/s"),
        "method": column(pl.String, "regression, or mean_speed with fewer than 10 references", isin=METHODS),
        "references": column(pl.Int32, "fully tracked vehicles that reach start_x_m", ge=0),
        "intercept_frames": column(pl.Float64, "b0 of frames = b0 + b1 * speed", nullable=True),
        "slope_frames_per_mps": column(pl.Float64, "b1 of frames = b0 + b1 * speed", unit="s/m", nullable=True),
        "r2": column(pl.Float64, "share of the references' variance that the regression explains", nullable=True),
        "frames_estimated": column(pl.Float64, "from the cut-off to the first entry"),
        "frames_sigma": column(pl.Float64, "sample standard deviation of the references' frames"),
        "first_missing_frame": column(pl.Int32, "the window is [first_missing_frame, start_frame - 1], both included"),
    },
)
