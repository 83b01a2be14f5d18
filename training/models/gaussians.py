"""Bivariate normal densities of positions, read from five numbers of a network, and their likelihood.

A negative log likelihood here is the negative logarithm of the density in nats, with every constant, of positions in
metres, averaged over the known positions: the mean of `-scipy.stats.multivariate_normal.logpdf`, in training as in
evaluation (`training.evaluation.scores`). The code published with convolutional social pooling differs in two
places: where its test mixes maneuvers, the second axis's square and the term between the axes are halved twice; and to
turn a density per square foot into one per square metre it subtracts 0.516 = lg 3.2808 instead of 2 ln 3.2808 = 2.376.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from tracklake.training.models.network import to_numpy
from tracklake.training.models.prediction import Density, Prediction

Gaussian = tuple[Tensor, Tensor, Tensor]
"""Mean (..., F, 2) in m, sigma (..., F, 2) in m, and rho (..., F)."""

SIGMA_LIMITS_M = (0.01, 1000.0)
"""Least and largest standard deviation, in m; positions are recorded to the centimetre."""
CORRELATION_LIMIT = 0.999
"""Largest absolute correlation; beyond it 1 - rho^2 loses its digits in single precision."""


def to_gaussian(raw: Tensor) -> Gaussian:
    """Read five numbers (..., 5) as mean (..., 2) in m, sigma (..., 2) in m, and rho (...) of a density.

    As published (Graves 2013, and convolutional social pooling's code): two means, the logarithms of 1 / sigma, and rho
    before its tanh. Values stay within SIGMA_LIMITS_M and CORRELATION_LIMIT (`keep_within`).
    """
    least, most = SIGMA_LIMITS_M
    log_precision = keep_within(raw[..., 2:4], -math.log(most), -math.log(least))
    bound = math.atanh(CORRELATION_LIMIT)
    return raw[..., :2], torch.exp(-log_precision), torch.tanh(keep_within(raw[..., 4], -bound, bound))


def gaussian_nll(mean: Tensor, sigma: Tensor, rho: Tensor, future: Tensor, mask: Tensor) -> Tensor:
    """Return () the mean negative log density in nats of futures (..., F, 2) in m where `mask` (..., F) is True.

    It is 0 where no position is known. Masked positions are ignored.
    """
    away = torch.where(mask[..., None], future - mean, 0.0) / sigma
    along, across = away[..., 0], away[..., 1]
    rest = (1 - rho) * (1 + rho)
    distance = (along**2 + across**2 - 2 * rho * along * across) / rest
    log_density = -0.5 * (distance + torch.log(rest)) - torch.log(sigma).sum(dim=-1) - math.log(2 * math.pi)
    return torch.where(mask, -log_density, 0.0).sum() / mask.sum().clamp(min=1)


def to_density(mean: Tensor, sigma: Tensor, rho: Tensor, weight: Tensor | None = None) -> Density:
    """Convert mean and sigma (B, A, F, 2), rho (B, A, F) and weight (B, A); without weights, there is no axis A."""
    if weight is None:
        weight, mean, sigma, rho = mean.new_ones((len(mean), 1)), mean[:, None], sigma[:, None], rho[:, None]
    return Density(*(to_numpy(part) for part in (weight, mean, sigma, rho)))


def to_prediction(gaussian: Gaussian) -> Prediction:
    """Convert a density of one alternative (B, F) to a prediction: its means and itself."""
    return Prediction(to_numpy(gaussian[0]), to_density(*gaussian))


def keep_within(value: Tensor, low: float, high: float) -> Tensor:
    """Clamp values; the gradient is dropped only where a step against it would lead further out."""
    clamp: Callable[..., Tensor] = _Within.apply
    return clamp(value, low, high)


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
