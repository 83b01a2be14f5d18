"""`vehicle_scores` and `subset_scores`: how reliable tracks and subsets are."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column

WITHOUT_ERROR = "of the entries, those that break no rule of severity error"
WITHOUT_WARNING = "of the entries, those that break no rule of severity error or warning"
REVERSALS = (
    "of the entries with a jerk, those whose jerk has another sign than the last one of the second before, on the 10 "
    "Hz clock; jerks of zero have no sign and are skipped"
)
CROSS_SECTION = pl.Struct({"x_m": pl.Float64, "crossed": pl.Int32, "vanished": pl.Int32, "appeared": pl.Int32})

VEHICLE_SCORES = Table(
    "vehicle_scores",
    "One row per vehicle: its feasibility, judged by the rules that could be checked in its subset.",
    key=("vehicle_id",),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "unique within the subset", ge=0),
        "entries": column(pl.Int32, "rows of the track", ge=1),
        "share_without_error": column(pl.Float64, WITHOUT_ERROR, ge=0, le=1),
        "share_without_warning": column(pl.Float64, WITHOUT_WARNING, ge=0, le=1),
        "jerk_reversal_share": column(pl.Float64, REVERSALS, nullable=True, ge=0, le=1),
    },
)

SUBSET_SCORES = Table(
    "subset_scores",
    "One row per subset: feasibility by the rules that could be checked, and how consistent recorded motion, "
    "recomputed motion and recorded headways are with each other. What cannot be compared is null.",
    key=("subset",),
    columns={
        **PLACE,
        "entries": column(pl.Int64, "rows of tracks", ge=1),
        "rules_unchecked": column(pl.List(pl.String), "rules that need a column which the source lacks"),
        "share_without_error": column(pl.Float64, WITHOUT_ERROR, ge=0, le=1),
        "share_without_warning": column(pl.Float64, WITHOUT_WARNING, ge=0, le=1),
        "vehicles_without_error": column(pl.Float64, "share of the vehicles without any such entry", ge=0, le=1),
        "vehicles_without_warning": column(pl.Float64, "share of the vehicles without any such entry", ge=0, le=1),
        "speed_rms_mps": column(
            pl.Float64, "root mean square of speed_mps - speed_10hz_mps", unit="m/s", nullable=True, ge=0
        ),
        "accel_rms_mps2": column(
            pl.Float64, "root mean square of accel_mps2 - accel_10hz_mps2", unit="m/s2", nullable=True, ge=0
        ),
        "high_jerk_share": column(
            pl.Float64, "of the entries with a jerk, those that break high_jerk", nullable=True, ge=0, le=1
        ),
        "worst_jerk_mps3": column(pl.Float64, "greatest jerk, either way", unit="m/s3", nullable=True, ge=0),
        "jerk_flicker_share": column(
            pl.Float64, "of the entries with a jerk, those that break jerk_flicker", nullable=True, ge=0, le=1
        ),
        "jerk_reversal_share": column(pl.Float64, REVERSALS, nullable=True, ge=0, le=1),
        "fragments_per_1000_vehicles": column(
            pl.Float64,
            "entries that break track_fragment per 1,000 vehicles: tracks that begin or end in the section",
            nullable=True,
            ge=0,
        ),
        "cross_sections": column(
            pl.List(CROSS_SECTION),
            "cross sections of the rule cross_section_flow by x_m: vehicles that crossed it; those that vanished or "
            "appeared in a main lane before the next one (null at the last), which they had to cross or to come from. "
            "The rest of the difference to the next are ramps and the recording's beginning and end",
            nullable=True,
        ),
        "spacing_rms_m": column(
            pl.Float64,
            "platoon consistency: root mean square of recorded headway - headway from positions, where the leader has "
            "an entry in the frame",
            unit="m",
            nullable=True,
            ge=0,
        ),
        "spacings": column(pl.Int64, "entries of which spacing_rms_m is made", ge=0),
    },
)
