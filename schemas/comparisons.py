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

DENSITY_CLASSES = {
    "0 to 7": (0.0, 7.0),
    "7 to 11": (7.0, 11.0),
    "11 to 16": (11.0, 16.0),
    "16 to 22": (16.0, 22.0),
    "22 to 28": (22.0, 28.0),
    "28 or more": (28.0, float("inf")),
}
"""Classes of traffic density in vehicles per km of lane: levels of service A to F of freeways (Highway Capacity Manual
2000, exhibit 23-2)."""
ALL_DENSITIES = "all"
"""Name of the class that holds all samples."""

_RUN = {"run": column(pl.String, "name of the run or model")}
_SECONDS = {"seconds": column(pl.Float64, "ahead of the sample", unit="s", gt=0)}
_COUNTS = {
    "n": column(pl.Int64, "samples whose position is known then", ge=0),
    "vehicles": column(pl.Int64, "vehicles that they are of", ge=0),
}
_DENSITY = {
    "density": column(
        pl.String,
        "class of traffic density: vehicles per km of lane at the moment of prediction, or all",
        isin=(ALL_DENSITIES, *DENSITY_CLASSES),
    )
}


def _share(description: str, *, nullable: bool = False) -> Column:
    """Declare a column of shares."""
    return column(pl.Float64, description, nullable=nullable, ge=0, le=1)


def _metres(description: str, *, nullable: bool = True) -> Column:
    """Declare a column of distances."""
    return column(pl.Float64, description, unit="m", nullable=nullable, ge=0)


_BOUNDS = {
    "low": _share("lower end of the share's 95 % interval over vehicles; null: of one vehicle", nullable=True),
    "high": _share("upper end of it", nullable=True),
}

CALIBRATION = Table(
    "calibration",
    "One row per run, horizon and probability: how many true positions lie in the region that is said to hold them.",
    key=("run", "seconds", "level"),
    partition=(),
    columns={
        **_RUN,
        **_SECONDS,
        "level": _share("probability of the region: the smallest one of the predicted density, with all alternatives"),
        **_COUNTS,
        "coverage": _share("share of true positions in it; equal to `level` where the model is calibrated"),
        **_BOUNDS,
    },
)

DENSITY_ERRORS = Table(
    "density_errors",
    "One row per run, class of traffic density and horizon: the error beside the predicted standard deviation.",
    key=("run", "density", "seconds"),
    partition=(),
    columns={
        **_RUN,
        **_DENSITY,
        **_SECONDS,
        **_COUNTS,
        "mean_density_vpkm": column(pl.Float64, "mean density of the samples", unit="veh/km", nullable=True, ge=0),
        "rmse_longitudinal_m": _metres("as in `evaluations`"),
        "sigma_longitudinal_m": _metres(
            "root of the mean predicted variance along the road; null: no density is given"
        ),
        "rmse_lateral_m": _metres("as in `evaluations`"),
        "sigma_lateral_m": _metres("the same across it"),
    },
)

CONFORMAL_RADII = Table(
    "conformal_radii",
    "One row per run, class of traffic density, horizon and share: the radius around the prediction that holds it.",
    key=("run", "density", "seconds", "level"),
    partition=(),
    columns={
        **_RUN,
        **_DENSITY,
        **_SECONDS,
        "level": _share("share of true positions that the radius is to hold"),
        "calibration_n": column(pl.Int64, "samples, of half of the vehicles, that the radius is taken from", ge=0),
        "radius_m": _metres("the radius; null: of too few samples"),
        **_COUNTS,
        "coverage": _share("share of the n samples, of the other vehicles, within it", nullable=True),
        **_BOUNDS,
    },
)

FEASIBILITY_RULES = ("overlap", "negative_headway", "high_jerk", "off_road")
"""Rules that jointly predicted scenes are judged by: docs/rules.md has the first three, by their own thresholds."""
ANY_RULE = "any"
"""Name that stands for all of FEASIBILITY_RULES together."""

FEASIBILITY = Table(
    "feasibility",
    "One row per run, rule and horizon: how many predictions of whole scenes break it at a tick up to then.",
    key=("run", "rule", "seconds"),
    partition=(),
    columns={
        **_RUN,
        "rule": column(
            pl.String,
            "overlap of two vehicles; negative_headway to the next vehicle in the lane; high_jerk along the road, from "
            "positions at the protocol's rate, the last three observed ones included; off_road: front centre beside "
            "the carriageway; any of them",
            isin=(*FEASIBILITY_RULES, ANY_RULE),
        ),
        **_SECONDS,
        "n": column(pl.Int64, "predictions", ge=0),
        "scenes": column(pl.Int64, "scenes that they are of", ge=0),
        "share": _share("predictions that break the rule at `seconds` or before"),
        **_BOUNDS,
        "true_share": _share("true futures of the same vehicles that do, at the same ticks: the floor"),
        "scene_share": _share("scenes with such a prediction"),
        "true_scene_share": _share("scenes with such a true future"),
        "rmse_m": _metres("of the same predictions, as in `evaluations`"),
    },
)

COMPARISON_TABLES = (VEHICLE_ERRORS, COMPARISONS, CALIBRATION, DENSITY_ERRORS, CONFORMAL_RADII, FEASIBILITY)
"""Tables that `tracklake evaluate` writes beside `evaluations`."""
