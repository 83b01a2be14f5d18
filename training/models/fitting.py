"""Models whose parameters are fitted on the training part in one pass, with NumPy only."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tracklake.schemas.arrays import Floats, Integers
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Model

FITTED_SAMPLES = 200_000
"""Most samples that a model is fitted on, evenly spread over the training part."""
BATCH = 4096
"""Samples that are read at once."""
POINTS, ROUNDS = 25, 6
"""Points of a search grid along each parameter, and grids; each spans four steps of the one before."""


@dataclass(frozen=True)
class Moments:
    """Sums over samples, from which the squared error of any prediction that is linear in the history follows.

    The sums at a tick ahead are over the samples whose position is known there. Positions are relative to the sample's
    last one. Axis 0 is along the road, axis 1 across it.
    """

    count: Floats
    """(F,) samples."""
    past: Floats
    """(2, F, H, H) products of past positions with each other, in m2."""
    cross: Floats
    """(2, F, H) products of past positions with the future one, in m2."""
    square: Floats
    """(2, F) squares of the future position, in m2."""

    def sum_squared_errors(self, axis: int, weights: Floats) -> Floats:
        """Return (C, F) sums in m2, of predictions that are sums of past positions with weights (C, F, H)."""
        by_tick = np.swapaxes(weights, 0, 1)  # (F, C, H)
        explained = ((by_tick @ self.past[axis]) * by_tick).sum(axis=-1)
        common = (by_tick @ self.cross[axis][..., None])[..., 0]
        sums: Floats = (self.square[axis][:, None] - 2 * common + explained).T
        return np.maximum(sums, 0.0)  # rounding may leave less than 0


@dataclass(frozen=True)
class Fit:
    """Parameters of a fitted model, and the number of samples that they are fitted on.

    Those in `given` were set. Those in `at_bounds` are the least or the largest value that was searched: a better one
    may lie beyond.
    """

    model: str
    samples: int
    parameters: Mapping[str, float]
    given: Sequence[str] = ()
    at_bounds: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values for JSON."""
        return asdict(self)


def fit_model(model: Model, folder: TensorFolder, samples: Integers, given: Mapping[str, float]) -> Fit:
    """Fit a model's parameters on samples of the training part; those that are given stay as they are.

    Without samples, parameters stay at their defaults.
    """
    chosen = samples[:: -(-len(samples) // FITTED_SAMPLES) or 1]
    fitted: dict[str, float] = {**model.parameters, **given}
    builder = type(model.build(folder.protocol, **fitted))  # refuses parameters that are wrong
    found = builder.fit(folder.protocol, sum_moments(folder, chosen), given) if len(chosen) else {}
    rounded = {name: float(f"{value:.4g}") for name, value in (fitted | found).items()}
    at_bounds = sorted(name for name in found if rounded[name] in builder.bounds[name])
    return Fit(model.name, len(chosen), rounded | dict(given), sorted(given), at_bounds)


def sum_moments(folder: TensorFolder, samples: Integers) -> Moments:
    """Sum up samples by their numbers (S,)."""
    past, future = folder.protocol.history_ticks, folder.protocol.horizon_ticks
    # By the number of known positions ahead, so that each history is multiplied once.
    count, products = np.zeros(future + 1), np.zeros((2, future + 1, past, past))
    cross, square = np.zeros((2, future, past)), np.zeros((2, future))
    for first in range(0, len(samples), BATCH):
        batch = folder.gather(samples[first : first + BATCH])
        history = np.moveaxis(batch.history, -1, 0).astype(np.float64)  # (2, B, H)
        ahead = np.moveaxis(batch.future, -1, 0) * batch.future_mask.astype(np.float64)  # (2, B, F)
        known = batch.future_mask.sum(axis=1)
        count += np.bincount(known, minlength=future + 1)
        for ticks in np.unique(known):
            own = history[:, known == ticks]
            products[:, ticks] += np.swapaxes(own, 1, 2) @ own
        cross += np.swapaxes(ahead, 1, 2) @ history
        square += (ahead**2).sum(axis=1)
    return Moments(_sum_from(count, 0)[1:], _sum_from(products, 1)[:, 1:], cross, square)


def _sum_from(values: Floats, axis: int) -> Floats:
    """Return at each place the sum from there to the end of an axis."""
    return np.flip(np.cumsum(np.flip(values, axis), axis), axis)


def search(loss: Callable[[Floats], Floats], low: Sequence[float], high: Sequence[float]) -> Floats:
    """Find P numbers above 0, between bounds (P,), of least loss: on a logarithmic grid, then on finer ones.

    `loss` takes candidates (C, P) and returns (C,).
    """
    lowest, highest = np.log(low), np.log(high)
    begin, end = lowest, highest
    for _ in range(ROUNDS):
        axes = [np.linspace(*span, POINTS if span[0] < span[1] else 1) for span in zip(begin, end, strict=True)]
        candidates = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        best = candidates[np.argmin(loss(np.exp(candidates)))]
        reach = 2 * (end - begin) / (POINTS - 1)
        begin, end = np.maximum(best - reach, lowest), np.minimum(best + reach, highest)
    found: Floats = np.exp(best)
    return found
