"""Evidence beside the scores of `tracklake evaluate`: errors of single vehicles, and differences with intervals.

Like `evaluations` they are files that a command writes (`--vehicle-errors`), and no tables of the lake.
"""

import polars as pl

from tracklake.schemas.columns import PLACE, Column, Table, column

VEHICLE = {**PLACE, "vehicle_id": column(pl.Int32, "unique within the subset")}


def _sum(description: str, unit: str, *, nullable: bool = True, least: float | None = 0) -> Column:
    """Declare a sum over a vehicle's samples."""
    return column(pl.Float64, description, unit=unit, nullable=nullable, ge=least)


VEHICLE_ERRORS = Table(
    "vehicle_errors",
    "One row per run, vehicle and horizon: errors summed over the vehicle's n samples, of which intervals are made.",
    key=("run", "dataset", "subset", "vehicle_id", "seconds"),
    partition=(),
    columns={
        "run": column(pl.String, "name of the run, or of a model that has no run"),
        "model": column(pl.String, "name of its model"),
        "seed": column(pl.Int64, "seed of the training; null: nothing was drawn", nullable=True, ge=0),
        **VEHICLE,
        "seconds": column(pl.Float64, "ahead of the sample", unit="s", gt=0),
        "n": column(pl.Int64, "samples whose position is known then", ge=1),
        "squared_longitudinal_m2": _sum(
            "sum of squared errors along the direction of travel, at `seconds`", "m2", nullable=False
        ),
        "squared_lateral_m2": _sum("the same across it; null where the recording has no lateral positions", "m2"),
        "distance_m": _sum("sum of the distances between predicted and true place; null likewise", "m"),
        "nll_nats": _sum("sum of -ln p as in `evaluations`; null where the model gives none", "nat", least=None),
    },
)

COMPARED_FIGURES = {
    "rmse_m": ("squared_longitudinal_m2", "squared_lateral_m2"),
    "rmse_longitudinal_m": ("squared_longitudinal_m2",),
    "rmse_lateral_m": ("squared_lateral_m2",),
    "mae_m": ("distance_m",),
    "nll_nats": ("nll_nats",),
}
"""Figures that can be compared, and the sums of VEHICLE_ERRORS behind each; those named rmse are roots of means."""


def _figure(description: str) -> Column:
    """Declare a value in the figure's own unit."""
    return column(pl.Float64, description, nullable=True)


COMPARISONS = Table(
    "comparisons",
    "One row per two models, figure and horizon: the difference with its 95 % interval over vehicles and seeds.",
    key=("a", "b", "figure", "seconds"),
    partition=(),
    columns={
        "a": column(pl.String, "first run or model; `(8 seeds)` where it stands for the runs of several seeds"),
        "b": column(pl.String, "the other one"),
        "figure": column(pl.String, "as in `evaluations`", isin=tuple(COMPARED_FIGURES)),
        "seconds": column(pl.Float64, "ahead of the sample", unit="s", gt=0),
        "n": column(pl.Int64, "samples of both", ge=1),
        "vehicles": column(pl.Int64, "vehicles that they are of", ge=1),
        "a_seeds": column(pl.Int64, "seeds of a", ge=1),
        "b_seeds": column(pl.Int64, "seeds of b", ge=1),
        "a_value": _figure("the figure of a, in m (NLL: nat): the mean over its seeds"),
        "b_value": _figure("the same of b"),
        "difference": _figure("a_value - b_value; below 0, a is better"),
        "low": _figure("lower end of the 95 % interval; null: of one vehicle"),
        "high": _figure("upper end of it; the models differ where 0 lies outside"),
    },
)
