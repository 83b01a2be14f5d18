"""Bivariate normal densities of positions, read from five numbers of a network, and their likelihood.

A negative log likelihood here is the negative logarithm of the density in nats, with every constant, of positions in
metres, averaged over the known positions: the mean of `-scipy.stats.multivariate_normal.logpdf`. In training and in
evaluation (`training.evaluation.scores`, which also mixes alternatives) it is the same. The code published with
convolutional social pooling differs in two places, neither repeated here: the branch of its test that mixes
maneuvers halves the second axis's square and the term between the axes twice, and what it subtracts to turn a density
per square foot into one per square metre is 0.516, the decimal logarithm of 3.2808, where it should be 2 ln 3.2808 =
2.376.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from tracklake.training.models.network import to_numpy
from tracklake.training.models.prediction import Density

Gaussian = tuple[Tensor, Tensor, Tensor]
"""Mean (..., F, 2) in m, sigma (..., F, 2) in m, and rho (..., F)."""

SIGMA_LIMITS_M = (0.01, 1000.0)
"""Least and largest standard deviation, in m. Positions are recorded to the centimetre: a narrower density would
describe their rounding, and that of a vehicle at a standstill would have no bound."""

CORRELATION_LIMIT = 0.999
"""Largest absolute correlation; beyond it 1 - rho^2 loses its digits in single precision."""


def to_gaussian(raw: Tensor) -> Gaussian:
    """Read five numbers as a bivariate normal density.

    As published (Graves 2013, and convolutional social pooling's code): two means, the logarithms of 1 / sigma, and rho
    before its tanh. Beyond SIGMA_LIMITS_M and CORRELATION_LIMIT the value stays at the limit; the gradient passes where
    a step against it leads back inside, so that nothing is stuck there.

    Args:
        raw: (..., 5).

    Returns:
        mean (..., 2) in m, sigma (..., 2) in m, and rho (...).
    """
    least, most = SIGMA_LIMITS_M
    log_precision = keep_within(raw[..., 2:4], -math.log(most), -math.log(least))
    bound = math.atanh(CORRELATION_LIMIT)
    return raw[..., :2], torch.exp(-log_precision), torch.tanh(keep_within(raw[..., 4], -bound, bound))


def gaussian_nll(mean: Tensor, sigma: Tensor, rho: Tensor, future: Tensor, mask: Tensor) -> Tensor:
    """Return () the mean negative log density in nats over the known positions; 0 where none is known.

    Args:
        mean: (..., F, 2) in m.
        sigma: (..., F, 2) in m, above 0.
        rho: (..., F) within (-1, 1).
        future: (..., F, 2) in m; masked positions are ignored.
        mask: (..., F) True where the position is known.
    """
    away = torch.where(mask[..., None], future - mean, 0.0) / sigma
    nll = torch.where(mask, -_log_density(away, sigma, rho), 0.0)
    return nll.sum() / mask.sum().clamp(min=1)


def to_density(mean: Tensor, sigma: Tensor, rho: Tensor, weight: Tensor | None = None) -> Density:
    """Convert tensors to the density of a prediction.

    Args:
        mean: (B, A, F, 2) in m; without weights (B, F, 2), of the one alternative.
        sigma: standard deviations of the same shape.
        rho: correlations of the same shape but for the last axis.
        weight: (B, A) probabilities of the alternatives.
    """
    if weight is None:
        weight, mean, sigma, rho = mean.new_ones((len(mean), 1)), mean[:, None], sigma[:, None], rho[:, None]
    return Density(*(to_numpy(part) for part in (weight, mean, sigma, rho)))


def keep_within(value: Tensor, low: float, high: float) -> Tensor:
    """Clamp values; the gradient is dropped only where a step against it would lead further out."""
    clamp: Callable[..., Tensor] = _Within.apply
    return clamp(value, low, high)


def _log_density(away: Tensor, sigma: Tensor, rho: Tensor) -> Tensor:
    """Return the log density (...) of distances in standard deviations (..., 2)."""
    along, across = away[..., 0], away[..., 1]
    rest = (1 - rho) * (1 + rho)
    distance = (along**2 + across**2 - 2 * rho * along * across) / rest
    return -0.5 * (distance + torch.log(rest)) - torch.log(sigma).sum(dim=-1) - math.log(2 * math.pi)


class _Within(Function):
    """A clamp whose gradient leads back inside."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, low: float, high: float) -> Tensor:  # noqa: ANN401  (torch's own context, to which attributes are added)
        ctx.save_for_backward(value)
        ctx.low, ctx.high = low, high
        return value.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401  (as above)
        (value,), (gradient,) = ctx.saved_tensors, gradients
        outwards = ((value < ctx.low) & (gradient > 0)) | ((value > ctx.high) & (gradient < 0))
        return gradient.masked_fill(outwards, 0.0), None, None
