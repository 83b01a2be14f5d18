"""Positions along the road: smoothed, within the bounds of motion, and behind the leaders."""

from functools import partial

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.number_store import MakeStore
from tracklake.pipeline.transforms.reconstruction.config import DEFAULT_CLASS, ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.estimates import Estimates
from tracklake.pipeline.transforms.reconstruction.motion import Problem, bound_motion
from tracklake.pipeline.transforms.reconstruction.platoons import (
    ClassLimits,
    Platoons,
    find_leaders,
    keep_behind_leaders,
)
from tracklake.pipeline.transforms.reconstruction.shares import AllPieces, Share, Shares
from tracklake.pipeline.transforms.reconstruction.smoothing import make_penalty, smooth_robustly
from tracklake.schemas.arrays import Integers

OUTLIER = 4.0
"""Residuals, in standard deviations of the noise, beyond which Huber's distance is linear."""
LEAST_OUTLIER_M = {"x_m": 1.0, "y_m": 4e-6}
"""Least such residual by coordinate, in m. Along the road smaller ones can be motion that the penalty cuts off, such as
hard braking, and noise that is greater for some vehicles, such as those that crawl and are recorded in steps."""


def smooth_share(share: Share, estimates: Estimates, column: str) -> Problem:
    """Smooth one coordinate of a share's pieces without bounds."""
    noise, known = estimates.noise[column], share.pieces.recorded.astype(np.float64)
    limit_m = max(OUTLIER * noise.noise_m, LEAST_OUTLIER_M[column])
    penalty = make_penalty(share.series, noise.weight_s6)
    smoothed, weights = smooth_robustly(penalty, estimates.place(share, column), known, limit_m)
    return Problem(share.series, smoothed, weights, noise.weight_s6)


def solve_along(
    shares: Shares,
    estimates: Estimates,
    vehicles: pl.DataFrame,
    config: ReconstructionConfig,
    make_store: MakeStore,
    at_once: int,
) -> Platoons:
    """Return the positions of all points along the road, with what they were found by."""
    limits = ClassLimits(list(config.bounds.values()), _find_classes(shares.all, vehicles, config))
    smoothed, weights, x, accel_mps2 = (make_store("float64") for _ in range(4))
    leader = make_store("int64")
    for share in shares:
        problem = smooth_share(share, estimates, "x_m")
        bounded, own_limits = bound_motion(problem, partial(limits.find, share.own_pieces, share.series))
        for store, values in (
            (smoothed, problem.smoothed[:]),
            (weights, problem.weights[:]),
            (x, bounded),
            (accel_mps2, own_limits.accel_mps2),
            (leader, find_leaders(share.pieces, shares.all)),
        ):
            store.append(values)
    platoons = Platoons(
        pieces=shares.all,
        problem=Problem(shares.all.series, smoothed, weights, estimates.noise["x_m"].weight_s6),
        limits=limits,
        length_m=shares.all.read_trait(vehicles, "length_m"),
        x=x,
        accel_mps2=accel_mps2,
        leader=leader,
        is_bounding=make_store("bool"),
        at_once=at_once,
    )
    platoons.find_bounding()
    keep_behind_leaders(platoons)
    return platoons


def _find_classes(pieces: AllPieces, vehicles: pl.DataFrame, config: ReconstructionConfig) -> Integers:
    """Return the position of each piece's class among those with bounds, (P,)."""
    names = list(config.bounds)
    ids = pl.DataFrame({"vehicle_id": pieces.vehicle_id}).cast({"vehicle_id": vehicles.schema["vehicle_id"]})
    classes = ids.join(vehicles.select("vehicle_id", "class"), on="vehicle_id", how="left", maintain_order="left")[
        "class"
    ]
    place = classes.fill_null(DEFAULT_CLASS).replace_strict(
        names, range(len(names)), default=names.index(DEFAULT_CLASS)
    )
    return place.to_numpy().astype(np.int64)
