"""Models of motion, with NumPy only: constant, damped and Kalman-filtered velocity, and constant turn rate."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from tracklake.schemas.arrays import Floats, Singles
from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed
from tracklake.training.models.fitting import Moments, search
from tracklake.training.models.prediction import Density, Prediction

VELOCITY_S = 0.2
"""Length of history that the velocity is taken from, in seconds."""
DECAY_S = (0.01, 1000.0)
"""Least and largest time in s after which a lateral velocity may have fallen to 37 %."""
MEASUREMENT_RANGE_M, ACCELERATION_RANGE_M2PS3 = (1e-3, 10.0), (1e-6, 100.0)
"""Ranges that the Kalman filter's noise is fitted in."""
AXES = ("longitudinal", "lateral")
"""Names of the axes of positions, as in the names of parameters."""
TURN_S = 1.0
"""Duration of each of the two displacements whose directions give a constant turn rate, in seconds."""
LEAST_SPEED_MPS = 2.0
"""Least speed over both of these displacements, in m/s; a slower vehicle is taken to drive straight on."""


def count_velocity_ticks(protocol: Protocol) -> int:
    """Return the ticks of history that the velocity is taken from: one at 5 Hz, two at 10 Hz."""
    return min(max(1, round(VELOCITY_S * protocol.rate_hz)), protocol.history_ticks - 1)


def extrapolate(history: Any, ticks: int, steps: Any) -> Any:  # noqa: ANN401  (NumPy's arrays or torch's tensors, all of one kind)
    """Return (..., F, 2) in m relative to the last position of histories (..., H, 2), for `steps` (F, 1 or 2) ticks.

    The velocity is that of the last `ticks` ticks; steps are the same for both axes, or of each axis.
    """
    velocity = (history[..., -1, :] - history[..., -1 - ticks, :]) / ticks  # m per tick
    return velocity[..., None, :] * steps


class ConstantVelocity:
    """Continues with the velocity of the last 0.2 s, computed from positions alone.

    A longer window is less noisy, but its velocity is older, which costs more: on the public excerpt of US-101 (in
    blocks of 225 s, all samples), RMSE after 5 s is 7.8 m over 0.2 s, 8.3 m over 1 s, 10.0 m over 3 s.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.ticks = count_velocity_ticks(protocol)
        self.steps = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float32)[:, None]

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        return Prediction(position_m=extrapolate(observed.history, self.ticks, self.steps))


class DampedVelocity(ConstantVelocity):
    """Constant velocity along the road, while the lateral velocity decays: y(t) = v_y T (1 - exp(-t / T)).

    Vehicles end a lane change, and what a tracker's noise adds to a lateral velocity does not last either. `decay_s` is
    T; fitted, it has the least sum of squared lateral errors over all known positions ahead.
    """

    bounds: ClassVar = {"decay_s": DECAY_S}

    def __init__(self, protocol: Protocol, *, decay_s: float) -> None:
        super().__init__(protocol)
        _require_positive(decay_s=decay_s)
        across = _damp(self.steps, decay_s * protocol.rate_hz)
        self.steps = np.concatenate([self.steps, across], axis=1).astype(np.float32)

    @staticmethod
    def fit(protocol: Protocol, moments: Moments, given: Mapping[str, float]) -> dict[str, float]:
        """Return `decay_s`, unless it is given."""
        if "decay_s" in given:
            return {}
        ticks, steps = count_velocity_ticks(protocol), np.arange(1.0, protocol.horizon_ticks + 1)
        velocity = np.zeros(protocol.history_ticks)
        velocity[-1], velocity[-1 - ticks] = 1 / ticks, -1 / ticks

        def measure(decay_s: Floats) -> Floats:
            weights = _damp(steps, decay_s * protocol.rate_hz)[..., None] * velocity
            squares: Floats = moments.sum_squared_errors(1, weights).sum(axis=1)
            return squares

        (decay_s,) = search(measure, *zip(DECAY_S, strict=True))
        return {"decay_s": float(decay_s)}


def _damp(steps: Any, decay: Any) -> Any:  # noqa: ANN401  (arrays that fit each other)
    """Return the ticks of full velocity that ticks of a decaying one are worth; both times in ticks."""
    return -decay * np.expm1(-steps / decay)


class KalmanConstantVelocity:
    """Filters position and velocity of each axis by itself, under white-noise acceleration and noisy observation.

    Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and Navigation: the discretised
    continuous white-noise acceleration model of section 6.2.2, the filter of 5.2.4, begun with the first two positions
    (two-point differencing, 5.5.3). The density is that of the position as it will be recorded, with the variances of
    state and measurement. Gains and variances are the same for all samples, so that predictions are linear in the
    history.

    Fitted, the noise of each axis has the greatest likelihood of the positions ahead: the sum of the log densities of
    all known ones, each by itself (a composite likelihood, as positions of one future depend on each other). It is not
    that of the innovations, which would fit the next tick and be too sure of those after 5 s.

    The defaults are for dense traffic. 0.15 m and 0.1 m are larger than the jitter from tick to tick (0.03 m and 0.02 m
    about a cubic over 1.5 s of the public excerpt of US-101), since the errors of tracking in video last longer than a
    tick. Over T seconds a density q changes the velocity by sqrt(q T): 1 m2/s3 and 0.04 m2/s3 by 2.2 m/s along the road
    and 0.45 m/s across it in 5 s; in the same excerpt it is 2.4 m/s and 0.39 m/s.

    Args:
        protocol: rate, history and horizon.
        measurement_longitudinal_m: standard deviation of a recorded position along the road.
        measurement_lateral_m: the same across the road.
        acceleration_longitudinal_m2ps3: power spectral density of the acceleration along the road.
        acceleration_lateral_m2ps3: the same across the road.
    """

    bounds: ClassVar = {
        **{f"measurement_{axis}_m": MEASUREMENT_RANGE_M for axis in AXES},
        **{f"acceleration_{axis}_m2ps3": ACCELERATION_RANGE_M2PS3 for axis in AXES},
    }

    def __init__(self, protocol: Protocol, **noise: float) -> None:
        _require_positive(**noise)
        sigma_m, density = np.array([noise[name] for name in self.bounds]).reshape(2, 2)
        weights, variance = _filter(protocol, sigma_m, density)
        self.weights: Floats = weights  # (2, F, H)
        self.sigma_m: Floats = np.sqrt(variance).T  # (F, 2)

    @staticmethod
    def fit(protocol: Protocol, moments: Moments, given: Mapping[str, float]) -> dict[str, float]:
        """Return the noise that is not given, of both axes."""
        fitted: dict[str, float] = {}
        bounds = KalmanConstantVelocity.bounds
        for axis, axis_name in enumerate(AXES):

            def measure(noise: Floats, axis: int = axis) -> Floats:
                weights, variance = _filter(protocol, noise[:, 0], noise[:, 1])
                squares = moments.sum_squared_errors(axis, weights)
                nats: Floats = ((moments.count * np.log(variance) + squares / variance) / 2).sum(axis=1)
                return nats

            names = f"measurement_{axis_name}_m", f"acceleration_{axis_name}_m2ps3"
            spans = ((given[own], given[own]) if own in given else bounds[own] for own in names)
            low, high = zip(*spans, strict=True)
            found = dict(zip(names, search(measure, low, high).tolist(), strict=True))
            fitted |= {own: value for own, value in found.items() if own not in given}
        return fitted

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        by_axis = np.moveaxis(observed.history, -1, 0).astype(np.float64)  # (2, B, H)
        predicted = np.moveaxis(by_axis @ np.swapaxes(self.weights, 1, 2), 0, -1).astype(np.float32)  # (B, F, 2)
        samples, steps, _ = predicted.shape
        density = Density(
            weight=np.ones((samples, 1), dtype=np.float32),
            mean_m=predicted[:, None],
            sigma_m=np.tile(self.sigma_m.astype(np.float32), (samples, 1, 1, 1)),
            correlation=np.zeros((samples, 1, steps), dtype=np.float32),
        )
        return Prediction(position_m=predicted, density=density)


def _require_positive(**parameters: float) -> None:
    """Raise UsageError for a parameter that is not above 0."""
    for name, value in parameters.items():
        if not value > 0:
            raise UsageError(f"parameter `{name}`: expected a number above 0, got {value:g}")


def _filter(protocol: Protocol, measurement_m: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Run A filters with noise (A,), (A,): weights (A, F, H) of past positions in those ahead, and variances (A, F)."""
    tick_s, past = 1.0 / protocol.rate_hz, np.eye(protocol.history_ticks)
    ahead_s: Floats = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float64) * tick_s
    move = np.array([[1.0, tick_s], [0.0, 1.0]])
    added = density[:, None, None] * np.array([[tick_s**3 / 3, tick_s**2 / 2], [tick_s**2 / 2, tick_s]])
    noise = np.square(measurement_m)
    covariance = noise[:, None, None] * np.array([[1.0, 1.0 / tick_s], [1.0 / tick_s, 2.0 / tick_s**2]])
    position = np.tile(past[1], (len(noise), 1))  # (A, H): a weight for each past position
    velocity = np.tile((past[1] - past[0]) / tick_s, (len(noise), 1))
    for recorded in past[2:]:
        covariance = move @ covariance @ move.T + added
        column = covariance[:, :, 0]  # (A, 2) of position and velocity with the position
        gain = column / (column[:, :1] + noise[:, None])
        covariance = covariance - gain[:, :, None] * column[:, None, :]
        position = position + velocity * tick_s
        surprise = recorded - position
        position, velocity = position + gain[:, :1] * surprise, velocity + gain[:, 1:] * surprise
    (place, shared), (_, speed) = np.moveaxis(covariance, 0, -1)[..., None]  # (A, 1) each
    variance = place + 2 * shared * ahead_s + speed * ahead_s**2 + density[:, None] * ahead_s**3 / 3
    return position[:, None] + velocity[:, None] * ahead_s[:, None], variance + noise[:, None]


class ConstantTurnRate:
    """Continues with the last speed and yaw rate.

    Speed and heading are those of the last 0.2 s, as in `constant-velocity`. The yaw rate is the angle between the
    displacements of the last second and the second before, per second; noise of 0.1 m then makes an acceleration across
    the road of sqrt(6) x 0.1 m / (1 s)^2 = 0.24 m/s2, 3 m after 5 s (over half a second it would be 12 m).

    From the last chord d of duration s, the position at time t is t sinc(w t / 2) / (s sinc(w s / 2)) times d, turned
    by w (t + s) / 2, where w is the yaw rate and sinc(a) = sin(a) / a. This is the closed form of Schubert, Richter and
    Wanielik 2008, written so that w = 0 is no special case.

    On the public excerpt of US-101 its RMSE after 5 s is 18 % larger than constant velocity's: on a freeway vehicles
    hardly turn, and the turn in their positions is mostly noise.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.rate_hz = protocol.rate_hz
        self.ticks = count_velocity_ticks(protocol)
        self.turn_ticks = min(max(1, round(TURN_S * protocol.rate_hz)), (protocol.history_ticks - 1) // 2)
        self.ahead_s = np.arange(1, protocol.horizon_ticks + 1) / protocol.rate_hz

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        history = observed.history.astype(np.float64)
        chord, duration_s = history[:, -1] - history[:, -1 - self.ticks], self.ticks / self.rate_hz
        turn = self._yaw_rate(history)[:, None]  # (B, 1) rad/s, positive to the right
        half = turn / (2 * np.pi)  # np.sinc(a) is sin(pi a) / (pi a)
        length = self.ahead_s * np.sinc(half * self.ahead_s) / (duration_s * np.sinc(half * duration_s))  # (B, F)
        angle = turn * (self.ahead_s + duration_s) / 2
        cos, sin = length * np.cos(angle), length * np.sin(angle)
        along, across = chord[:, :1], chord[:, 1:]
        position = np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)
        return Prediction(position_m=position.astype(np.float32))

    def _yaw_rate(self, history: np.ndarray) -> np.ndarray:
        """Return (B,) yaw rates of histories (B, H, 2) in rad/s, positive to the right."""
        ticks = self.turn_ticks
        if ticks == 0:  # two positions show no turn
            return np.zeros(len(history))
        last, before = history[:, -1] - history[:, -1 - ticks], history[:, -1 - ticks] - history[:, -1 - 2 * ticks]
        cross = before[:, 0] * last[:, 1] - before[:, 1] * last[:, 0]
        dot = (before * last).sum(axis=1)
        duration_s = ticks / self.rate_hz
        slowest = np.minimum(np.hypot(*last.T), np.hypot(*before.T)) / duration_s
        return np.where(slowest < LEAST_SPEED_MPS, 0.0, np.arctan2(cross, dot) / duration_s)
