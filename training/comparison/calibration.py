"""Calibration of predicted densities: how often the truth lies in regions that are said to hold it with a probability.

The region of a probability is the smallest one: the places at which the density exceeds a bound (Hyndman 1996,
Computing and Graphing Highest Density Regions, The American Statistician 50). The level of a true place is the
probability of the smallest region that just holds it. Of a calibrated model, levels are uniform between 0 and 1.
"""

import math

import numpy as np

from tracklake.schemas.arrays import Floats, Singles
from tracklake.training.evaluation.scores import find_nll
from tracklake.training.models.prediction import Density

POINTS = 128
"""Points of each alternative by which the probability of a mixture's region is measured; it errs by up to 0.004."""
LEAST_WEIGHT = 1e-3
"""Weight of an alternative below which it has no points."""


def find_levels(density: Density, place_m: Singles) -> Floats:
    """Find the probability of the smallest region of a density that holds each place (B, T, 2): (B, T), 0 to 1.

    Of one normal density it is 1 - exp(-d2 / 2), with d2 the squared Mahalanobis distance. Of a mixture it is the share
    of points with a higher density, POINTS of each alternative, evenly spread over its probability.
    """
    nll = find_nll(density, place_m)
    if density.weight.shape[1] == 1:
        rest = 1.0 - density.correlation[:, 0].astype(np.float64) ** 2
        peak = np.log(2 * np.pi * density.sigma_m[:, 0].astype(np.float64).prod(axis=-1)) + np.log(rest) / 2
        level: Floats = -np.expm1(peak - nll)
        return np.clip(level, 0.0, 1.0)
    sample, own = np.nonzero(density.weight >= LEAST_WEIGHT)
    spread = _spread_points()
    sigma = density.sigma_m[sample, own].astype(np.float64)[:, :, None]  # (P, T, 1, 2)
    slant = density.correlation[sample, own].astype(np.float64)[:, :, None]
    along = spread[:, 0]
    across = slant * along + np.sqrt(1.0 - slant**2) * spread[:, 1]
    away = np.stack([np.broadcast_to(along, across.shape), across], axis=-1) * sigma
    points = density.mean_m[sample, own][:, :, None] + away  # (P, T, POINTS, 2)
    pairs, ticks = points.shape[:2]
    each = Density(
        density.weight[sample],
        *(np.repeat(part[sample], POINTS, axis=2) for part in vars(density).values() if part.ndim > 2),
    )
    place = points.reshape(pairs, -1, 2).astype(np.float32)
    higher = find_nll(each, place).reshape(pairs, ticks, POINTS) < nll[sample][..., None]
    weight = density.weight[sample, own].astype(np.float64)
    inside = np.zeros(nll.shape)
    np.add.at(inside, sample, weight[:, None] * higher.mean(axis=-1))
    found: Floats = inside / np.bincount(sample, weight, minlength=len(nll))[:, None]
    return found


def _spread_points() -> Floats:
    """Spread POINTS evenly over the probability of the standard normal density of the plane: (POINTS, 2).

    Their distances are quantiles, their directions a golden angle apart (Vogel 1979, Mathematical Biosciences 44).
    """
    number = np.arange(POINTS)
    radius = np.sqrt(-2.0 * np.log1p(-(number + 0.5) / POINTS))
    angle = number * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def find_variance(density: Density) -> Floats:
    """Find the variances of a density along and across the road, in m2: (B, T, 2)."""
    weight = density.weight.astype(np.float64)[:, :, None, None]
    mean = (weight * density.mean_m).sum(axis=1, keepdims=True)
    variance: Floats = (weight * (density.sigma_m.astype(np.float64) ** 2 + (density.mean_m - mean) ** 2)).sum(axis=1)
    return variance
