"""Negative log-likelihood (NLL) of true places under a predicted density."""

import numpy as np

from tracklake.schemas.arrays import Floats, Singles
from tracklake.training.models.prediction import Density


def find_nll(density: Density, future: Singles) -> Floats:
    """Compute -ln p of each true place in nats, p in 1/m2: (B, F); not finite where there is no density (sigma 0).

    A mixture's density is the weighted sum of its alternatives' densities; with one alternative it is the bivariate
    normal density itself. The sum is computed in logarithms, so that a place far out gives a large number and not
    infinity.

    Args:
        density: predicted density of B samples.
        future: (B, F, 2) true places relative to the sample's last position, m.

    Source: the density of the bivariate normal distribution; Bishop 1994, Mixture density networks, for the mixture.
    """
    sigma = density.sigma_m.astype(np.float64)
    correlation = density.correlation.astype(np.float64)
    with np.errstate(all="ignore"):  # no density gives NaN or infinity, which the scores refuse
        away = (future[:, None].astype(np.float64) - density.mean_m) / sigma
        along, across = away[..., 0], away[..., 1]
        rest = (1.0 - correlation) * (1.0 + correlation)
        squared = (along**2 - 2.0 * correlation * along * across + across**2) / rest
        log_normal = -0.5 * squared - np.log(2.0 * np.pi * sigma[..., 0] * sigma[..., 1]) - 0.5 * np.log(rest)
        weighted = log_normal + np.log(density.weight.astype(np.float64))[:, :, None]
        highest = weighted.max(axis=1)
        nll: Floats = -highest - np.log(np.exp(weighted - highest[:, None]).sum(axis=1))
    return nll
