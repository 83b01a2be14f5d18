"""Constant velocity, the baseline of all models: of the last 0.2 s, and by a Kalman filter, with NumPy only."""

from typing import Any

import numpy as np

from tracklake.schemas.arrays import Floats, Singles
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed
from tracklake.training.models.prediction import Density, Prediction

VELOCITY_S = 0.2
"""Length of history that the velocity is taken from, in seconds."""

MEASUREMENT_M = (0.15, 0.10)
"""Standard deviation of a recorded position in m, along and across the road.

Larger than the jitter from tick to tick (0.03 m and 0.02 m about a cubic over 1.5 s of the public excerpt of US-101),
since the errors of tracking in video last longer than a tick.
"""

ACCELERATION_M2PS3 = (1.0, 0.04)
"""Power spectral density q of the acceleration in m2/s3, along and across the road.

Over T seconds the velocity changes by sqrt(q T): 2.2 m/s along and 0.45 m/s across in 5 s; in the same excerpt, dense
traffic, it is 2.4 m/s and 0.39 m/s.
"""


def velocity_ticks(protocol: Protocol) -> int:
    """Return the ticks of history that the velocity is taken from: one at 5 Hz, two at 10 Hz."""
    return min(max(1, round(VELOCITY_S * protocol.rate_hz)), protocol.history_ticks - 1)


def extrapolate(history: Any, ticks: int, steps: Any) -> Any:  # noqa: ANN401  (NumPy's arrays or torch's tensors, all of one kind)
    """Return (..., F, 2) in m relative to the last position of histories (..., H, 2), for `steps` (F,) ticks ahead.

    The velocity is that of the last `ticks` ticks.
    """
    velocity = (history[..., -1, :] - history[..., -1 - ticks, :]) / ticks  # m per tick
    return velocity[..., None, :] * steps[:, None]


class ConstantVelocity:
    """Continues with the velocity of the last 0.2 s, computed from positions alone.

    A longer window is less noisy, but its velocity is older, which costs more: on the public excerpt of US-101, RMSE
    after 5 s is 7.9 m over 0.2 s, 8.6 m over 1 s, 10.3 m over 3 s.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.ticks = velocity_ticks(protocol)
        self.steps = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float32)

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        return Prediction(position_m=extrapolate(observed.history, self.ticks, self.steps))


class KalmanConstantVelocity:
    """Filters position and velocity of each axis by itself, under white-noise acceleration and noisy observation.

    Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and Navigation: the discretised
    continuous white-noise acceleration model of section 6.2.2, the filter of 5.2.4, begun with the first two positions
    (two-point differencing, 5.5.3). The density is that of the position as it will be recorded, with the variances of
    state and measurement. Gains and variances are the same for all samples.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        measurement_m: tuple[float, float] = MEASUREMENT_M,
        acceleration_m2ps3: tuple[float, float] = ACCELERATION_M2PS3,
    ) -> None:
        self.tick_s = 1.0 / protocol.rate_hz
        self.ahead_s: Floats = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float64) * self.tick_s
        noise = np.square(np.array(measurement_m))  # (2,) m2, by axis
        density = np.array(acceleration_m2ps3)
        self.gains, covariance = _gains(noise, density, self.tick_s, protocol.history_ticks)
        ahead = _predicted(covariance[:, None], density[:, None], self.ahead_s)  # (2, F, 2, 2)
        self.sigma_m: Floats = np.sqrt(ahead[:, :, 0, 0] + noise[:, None]).T  # (F, 2)

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        history = observed.history.astype(np.float64)
        position, velocity = history[:, 1], (history[:, 1] - history[:, 0]) / self.tick_s  # (B, 2) by axis
        for tick, gain in enumerate(self.gains, start=2):
            expected = position + velocity * self.tick_s
            surprise = history[:, tick] - expected
            position, velocity = expected + gain[:, 0] * surprise, velocity + gain[:, 1] * surprise
        predicted = (position[:, None] + velocity[:, None] * self.ahead_s[:, None]).astype(np.float32)  # (B, F, 2)
        samples, steps, _ = predicted.shape
        density = Density(
            weight=np.ones((samples, 1), dtype=np.float32),
            mean_m=predicted[:, None],
            sigma_m=np.tile(self.sigma_m.astype(np.float32), (samples, 1, 1, 1)),
            correlation=np.zeros((samples, 1, steps), dtype=np.float32),
        )
        return Prediction(position_m=predicted, density=density)


def _gains(noise: Floats, density: Floats, tick_s: float, ticks: int) -> tuple[Floats, Floats]:
    """Compute gains (H - 2, 2 axes, 2) from the third position on, and the last covariance (2 axes, 2, 2)."""
    covariance = noise[:, None, None] * np.array([[1.0, 1.0 / tick_s], [1.0 / tick_s, 2.0 / tick_s**2]])
    gains = np.empty((ticks - 2, 2, 2))
    for tick in range(ticks - 2):
        covariance = _predicted(covariance, density, np.array(tick_s))
        column = covariance[:, :, 0]  # (2 axes, 2) of position and velocity with the position
        gains[tick] = column / (column[:, :1] + noise[:, None])
        covariance = covariance - gains[tick][:, :, None] * column[:, None, :]
    return gains, covariance


def _predicted(covariance: Floats, density: Floats, time_s: Floats) -> Floats:
    """Return covariances (..., 2, 2) after a time (...) of white-noise acceleration of a density (...)."""
    shape = np.broadcast_shapes(density.shape, time_s.shape)
    move, added = np.zeros((*shape, 2, 2)), np.zeros((*shape, 2, 2))
    move[..., 0, 0] = move[..., 1, 1] = 1.0
    move[..., 0, 1] = added[..., 1, 1] = time_s
    added[..., 0, 0] = time_s**3 / 3
    added[..., 0, 1] = added[..., 1, 0] = time_s**2 / 2
    added *= density[..., None, None]
    return move @ covariance @ np.swapaxes(move, -1, -2) + added
