"""`evaluations`: results of `tracklake evaluate` in long form, measured rows and published ones.

It is a file of the lake's folder (`evaluations/<protocol>.csv`), and no table of the lake: runs are trained, renamed
and deleted without the lake's knowing, so nothing here is kept up to date.

Every figure of a measured row is over the same n samples: those of the part, the dataset and the group whose position
is known at `seconds`. A future is known from its first tick on without a gap, so they are known at every tick before as
well. Errors are those of the predicted position (of several alternatives, of the most probable one); the density
is judged by `nll_nats` alone. `average` is how n samples become one figure:

- `samples`: the mean over them; every sample counts the same, so a vehicle that is seen for long counts more.
- `vehicles`: the mean over each vehicle's own samples, then the mean over the vehicles; every vehicle counts the same.

Roots are taken last: rmse_m of `vehicles` is the root of the mean over vehicles of their mean squared distances.
"""

import pandera.polars as pa
import polars as pl

from tracklake.schemas.columns import PARTS, Table, column

ORIGINS = ("measured", "published")
AVERAGES = ("samples", "vehicles")
EVERYTHING = "all"
"""Name of the dataset and the group that hold all samples."""

FINDING_GROUPS = {
    "warning": ("findings=touched", "findings=untouched"),
    "error": ("findings=error", "findings=no error"),
}
"""Groups by severity, from the mildest on: windows whose own vehicle breaks a rule of this severity or worse in the
history or the known future, and the others."""

_OF_TICK = "at `seconds`"


def _metres(description: str) -> pa.Column:
    """Declare a column of distances."""
    return column(pl.Float64, description, unit="m", nullable=True, ge=0)


def _share(description: str) -> pa.Column:
    """Declare a column of shares."""
    return column(pl.Float64, description, nullable=True, ge=0, le=1)


_FIGURES = {
    "rmse_m": _metres(f"square root of the mean squared distance between predicted and true place {_OF_TICK}"),
    "rmse_longitudinal_m": _metres("the same of the distance along the direction of travel only"),
    "rmse_lateral_m": _metres("the same of the distance across it only"),
    "mae_m": _metres(f"mean distance {_OF_TICK}"),
    "mae_longitudinal_m": _metres("mean absolute distance along the direction of travel only"),
    "mae_lateral_m": _metres("mean absolute distance across it only"),
    "ade_m": _metres("mean over all ticks up to `seconds` of the distance, of each sample first"),
    "fde_m": _metres("distance at the last of these ticks: the same number as mae_m, by the name that goes with ade_m"),
    "nll_nats": column(
        pl.Float64,
        f"mean of -ln p of the true place {_OF_TICK}, p the model's density in 1/m2 with all its alternatives; null "
        "where it gives none",
        unit="nat",
        nullable=True,
    ),
    "lateral_accuracy": _share("samples whose most probable lateral maneuver is the true one; null where none is said"),
    "longitudinal_accuracy": _share("the same of longitudinal maneuvers"),
    "majority_lateral_share": _share(
        "what lateral_accuracy would be of always saying the maneuver that is the commonest of the dataset's samples"
    ),
    "majority_longitudinal_share": _share("the same of longitudinal maneuvers"),
}

FIGURES = tuple(_FIGURES)
"""Columns of the measured figures."""

EVALUATIONS = Table(
    "evaluations",
    "One row per model, dataset, group, average and horizon: errors, and how likely the truth was held.",
    key=("origin", "model", "reference", "nearest", "dataset", "group", "average", "seconds"),
    partition=(),
    columns={
        "protocol": column(pl.String, "of the tensors; of a published row, the protocol that it is put beside"),
        "protocol_digest": column(pl.String, "its digest; null: published", nullable=True),
        "split": column(pl.String, "null: published", nullable=True),
        "part": column(pl.String, "of the split; null: published", nullable=True, isin=PARTS),
        "origin": column(pl.String, "measured here, or published elsewhere, on other data", isin=ORIGINS),
        "model": column(pl.String, "the run's name; of a published row, the registry's name where there is one"),
        "reference": column(pl.String, "where a published row stands; empty: measured"),
        "nearest": column(
            pl.Int64,
            "vehicles around the ego that the model was shown, at most; null: it reads the grid, or published",
            nullable=True,
            ge=0,
        ),
        "dataset": column(pl.String, "ngsim, highd, or all of the part; of a published row, as published"),
        "group": column(
            pl.String,
            "`all`; samples by their true maneuver, for instance `lateral=left`; by findings on their windows: "
            + ", ".join(f"`{group}`" for groups in FINDING_GROUPS.values() for group in groups),
        ),
        "average": column(pl.String, "what counts the same: samples or vehicles", isin=AVERAGES),
        "seconds": column(pl.Float64, "ahead of the sample", unit="s", gt=0),
        "n": column(pl.Int64, "samples whose position is known then; null: published", nullable=True, ge=0),
        "vehicles": column(pl.Int64, "vehicles they are of; null: published", nullable=True, ge=0),
        **_FIGURES,
        "latency_ms": column(
            pl.Float64,
            "median time to predict all samples of one moment at once on one thread, read already; in rows of "
            "everything only",
            unit="ms",
            nullable=True,
            ge=0,
        ),
        "latency_samples": column(
            pl.Float64, "median number of samples of those moments; likewise", nullable=True, ge=0
        ),
    },
)
