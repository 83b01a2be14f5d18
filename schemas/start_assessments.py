"""`start_assessments`: errors of the estimates of missing starts, measured on tracks that were cut."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column

ESTIMATORS = ("regression", "mean_speed", "no_margin", "local_regression")
"""The contract's (DESIGN section 6), two simpler ones and a better one; see `pipeline.transforms.starts.assessment`."""

START_ASSESSMENTS = Table(
    "start_assessments",
    "One row per estimator and start position: fully tracked vehicles whose track was cut to begin there, and how much "
    "of what was cut off the estimated windows cover. The tracks in the lake stay whole.",
    key=("estimator", "beyond_m"),
    columns={
        **PLACE,
        "estimator": column(
            pl.String,
            "regression is that of missing_starts; mean_speed and no_margin are simpler, local_regression fits the 10 "
            "references nearest in time",
            isin=ESTIMATORS,
        ),
        "beyond_m": column(pl.Float64, "the tracks were cut so far beyond the cut-off", unit="m", gt=0),
        "start_x_m": column(
            pl.Float64, "cut-off + beyond_m: tracks begin with the first entry from there on", unit="m"
        ),
        "starts": column(pl.Int32, "tracks that were cut there", ge=1),
        "starts_covered": column(pl.Int32, "of them, those whose window covers every missing frame", ge=0),
        "frames_missing": column(
            pl.Int64, "cut off, from the first entry at or beyond the cut-off to the start, all tracks together", ge=0
        ),
        "frames_covered": column(pl.Int64, "of them, those within the window", ge=0),
        "frames_excess": column(pl.Int64, "excess within the windows: the vehicle was not yet at the cut-off", ge=0),
        "coverage": column(
            pl.Float64, "frames_covered / frames_missing; null where none are", nullable=True, ge=0, le=1
        ),
        "excess": column(pl.Float64, "frames_excess / frames_missing; null where none are", nullable=True, ge=0),
        "error_mean_s": column(pl.Float64, "estimate - truth, without the margin; positive is too long", unit="s"),
        "error_median_s": column(pl.Float64, "likewise, the median", unit="s"),
    },
)
