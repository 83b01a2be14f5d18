"""How likely a model held what came: the negative logarithm of its density at the true places."""

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Singles as Floats
from tracklake.training.models.prediction import Density


def find_nll(density: Density, future: Floats) -> npt.NDArray[np.float64]:
    """(B, F) -ln p of each place in nats, p in 1/m2; not finite where the density is none (sigma 0, say).

    A mixture's density is the sum of its alternatives', each with its weight; with one alternative it is the bivariate
    normal density itself. All in logarithms, so that a place far out gives a great number and not infinity.

    Args:
        density: of B samples.
        future: (B, F, 2) places in m, relative to the sample's last position.

    Source: the density of the bivariate normal distribution; Bishop 1994, Mixture density networks, of the mixture.
    """
    sigma = density.sigma_m.astype(np.float64)
    correlation = density.correlation.astype(np.float64)
    with np.errstate(all="ignore"):  # what is no density gives NaN or infinity, which whoever scores refuses
        away = (future[:, None].astype(np.float64) - density.mean_m) / sigma
        along, across = away[..., 0], away[..., 1]
        rest = (1.0 - correlation) * (1.0 + correlation)
        squared = (along**2 - 2.0 * correlation * along * across + across**2) / rest
        log_normal = -0.5 * squared - np.log(2.0 * np.pi * sigma[..., 0] * sigma[..., 1]) - 0.5 * np.log(rest)
        weighted = log_normal + np.log(density.weight.astype(np.float64))[:, :, None]
        highest = weighted.max(axis=1)
        nll: npt.NDArray[np.float64] = -highest - np.log(np.exp(weighted - highest[:, None]).sum(axis=1))
    return nll
