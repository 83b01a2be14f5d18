"""Errors of satellite positioning: position, speed and heading as a vehicle's receiver states them.

The error of a position has three parts, each the same size in every direction: one that all vehicles near each other
share (orbits, clocks and atmosphere), one of the receiver's own that changes within half a minute (reflections), and
white noise. The first two are Gauss-Markov processes of first order.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Floats
from tracklake.schemas.drives import TICK_RATE_HZ


@dataclass(frozen=True)
class Receiver:
    """Standard deviations of a kind of receiver, of positions per axis; times are those of the correlation."""

    common_m: float
    own_m: float
    white_m: float
    speed_mps: float
    common_s: float = 600.0
    own_s: float = 30.0

    @property
    def accuracy_m(self) -> float:
        """Standard deviation of a position per axis, which messages state as both axes of the error ellipse."""
        return float(np.sqrt(self.common_m**2 + self.own_m**2 + self.white_m**2))


RECEIVERS: Mapping[str, Receiver] = {
    "plain": Receiver(common_m=1.5, own_m=1.2, white_m=0.1, speed_mps=0.1),
    "dgps": Receiver(common_m=0.1, own_m=0.35, white_m=0.05, speed_mps=0.05),
}
"""Receivers by name.

`plain`: 1.9 m per axis; 95 % of the positions lie within 4.7 m. GPS.gov names 4.9 m for phones under open sky (van
Diggelen and Enge, 2015); a user range error of 0.64 m (95 %, 20 April 2021) is the satellites' part alone. `dgps`:
0.37 m per axis, 0.9 m (95 %): a reference station removes what all receivers share; reflections and noise remain.
"""
HEADING_NOISE_DEG = 0.2
"""Standard deviation of the white noise of headings, in degrees."""


def draw_positions(random: np.random.Generator, receiver: Receiver, ticks: int, vehicles: int) -> Floats:
    """Draw position errors in m, (T, V, 2)."""
    common = _draw_process(random, receiver.common_m, receiver.common_s, (ticks, 1, 2))
    own = _draw_process(random, receiver.own_m, receiver.own_s, (ticks, vehicles, 2))
    return common + own + receiver.white_m * random.standard_normal((ticks, vehicles, 2))


def _draw_process(
    random: np.random.Generator, deviation: float, correlation_s: float, shape: tuple[int, ...]
) -> Floats:
    """Draw a Gauss-Markov process of first order along the first axis, stationary from its start."""
    kept = np.exp(-1 / (correlation_s * TICK_RATE_HZ))
    values = deviation * random.standard_normal(shape)
    values[1:] *= np.sqrt(1 - kept**2)
    for tick in range(1, len(values)):
        values[tick] += kept * values[tick - 1]
    return values


def draw_headings(random: np.random.Generator, error_deg: float, ticks: int, vehicles: int) -> Floats:
    """Draw heading errors in degrees, (T, V): a constant one per vehicle, to the left or right by chance, and noise."""
    bias_deg = error_deg * np.where(random.random(vehicles) < 0.5, -1.0, 1.0)
    return bias_deg + HEADING_NOISE_DEG * random.standard_normal((ticks, vehicles))
