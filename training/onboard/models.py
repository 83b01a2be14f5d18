"""Models that predict the vehicles around an ego, by name, and the spread of their errors on the training part."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Floats, Singles
from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import V2V
from tracklake.training.models import Phase, Recipe
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.onboard.samples import FEATURE_NUMBER, Samples

CTRV = "ctrv"
"""Name of the model that needs no training."""
NETWORKS = {
    "stacked-lstm": ("StackedLstm", Recipe((Phase("mse", 15),), batch_size=100)),
    "lstm-encoder-decoder": ("RecursiveDecoder", Recipe((Phase("mse", 15),), batch_size=100)),
}
"""Class in `networks` and recipe of each model that learns, by its name in the registry of overhead models."""
MODELS = (CTRV, *NETWORKS)
LEAST_SIGMA_M = 0.01
"""Least standard deviation of an error, m: positions are recorded to the centimetre."""


@dataclass(frozen=True)
class Forecaster:
    """A model that is ready: places (B, F, 2) of samples, and its errors' deviation (F, 2) on the training part, m.

    The standard deviation is constant per tick ahead and axis. The Gaussian with it around the predicted place gives a
    likelihood to models without a density of their own. Errors of a network on samples that it learned from are smaller
    than on others, which its likelihood pays for.
    """

    name: str
    predict: Callable[[Samples], Singles]
    sigma_m: Floats


def make_forecaster(name: str, predict: Callable[[Samples], Singles], train: Samples) -> Forecaster:
    """Make a model ready: check its places of the training part, and measure their errors."""
    place_m = predict_places(name, predict, train)
    sigma_m = np.sqrt(((place_m.astype(np.float64) - train.place_m) ** 2).mean(axis=0))
    return Forecaster(name, predict, np.maximum(sigma_m, LEAST_SIGMA_M))


def predict_places(name: str, predict: Callable[[Samples], Singles], samples: Samples) -> Singles:
    """Predict places (B, F, 2), which must be finite."""
    place_m = predict(samples)
    if not np.isfinite(place_m).all():
        raise NotFiniteError(name, "positions")
    return place_m


def find_network(name: str) -> tuple[str, Recipe]:
    """Return class and recipe of a model that learns; raises UsageError for others."""
    if name == CTRV:
        raise UsageError("ctrv needs no training; `tracklake onboard evaluate ctrv` scores it")
    if name not in NETWORKS:
        raise UsageError(f"unknown model `{name}`: expected one of {', '.join(NETWORKS)}")
    return NETWORKS[name]


def predict_straight(samples: Samples, ticks: int) -> Singles:
    """Predict places (B, F, 2) at constant velocity relative to the ego."""
    last = samples.feature[:, -1, [FEATURE_NUMBER["rel_x_m"], FEATURE_NUMBER["rel_y_m"]]]
    ahead_s = np.arange(1, ticks + 1)[:, None] / V2V.rate_hz
    return (last[:, None] + samples.velocity_mps[:, None] * ahead_s).astype(np.float32)


def predict_turns(samples: Samples, ticks: int = V2V.horizon_ticks) -> Singles:
    """Predict places (B, F, 2) at constant turn rate and velocity (CTRV) of the vehicle, the ego keeping its motion.

    The turn rate is the slope of `rel_heading_deg` over the history, by least squares: relative to the ego, so that on
    a bend which both drive, neither turns. The vehicle leaves the straight place by its arc less the arc's tangent.

    Source: Schubert, Richter and Wanielik 2008, as `training.models.motion`.
    """
    heading = np.unwrap(np.radians(samples.feature[:, :, FEATURE_NUMBER["rel_heading_deg"]].astype(np.float64)), axis=1)
    time_s = np.arange(heading.shape[1]) / V2V.rate_hz
    centred = time_s - time_s.mean()
    turn = (heading @ (centred / (centred**2).sum()))[:, None]  # (B, 1) rad/s, positive to the right
    speed = samples.feature[:, -1, FEATURE_NUMBER["speed_mps"]].astype(np.float64)[:, None]
    ahead_s = np.arange(1, ticks + 1) / V2V.rate_hz
    angle, begin = turn * ahead_s / 2, heading[:, -1:]
    length = speed * ahead_s * np.sinc(angle / np.pi)  # of the chord
    leaves = np.stack(
        [
            length * np.cos(begin + angle) - speed * ahead_s * np.cos(begin),
            length * np.sin(begin + angle) - speed * ahead_s * np.sin(begin),
        ],
        axis=-1,
    )
    places: Singles = (predict_straight(samples, ticks) + leaves).astype(np.float32)
    return places
