"""Constant velocity: the simplest prediction and the baseline of all others, with NumPy only."""

from typing import Any

import numpy as np

from tracklake.schemas.arrays import Singles
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed
from tracklake.training.models.prediction import Prediction

VELOCITY_S = 0.2
"""Length of history that the velocity is taken from, in seconds."""


def velocity_ticks(protocol: Protocol) -> int:
    """Return the ticks of history that the velocity is taken from: one at 5 Hz, two at 10 Hz."""
    return min(max(1, round(VELOCITY_S * protocol.rate_hz)), protocol.history_ticks - 1)


def extrapolate(history: Any, ticks: int, steps: Any) -> Any:  # noqa: ANN401  (NumPy's arrays or torch's tensors, all of one kind)
    """Continue histories in a straight line, with NumPy arrays or torch tensors.

    Args:
        history: (..., H, 2) positions in m.
        ticks: ticks of history that the velocity is taken from.
        steps: (F,) numbers of ticks ahead.

    Returns:
        (..., F, 2) positions in m relative to the last one.
    """
    velocity = (history[..., -1, :] - history[..., -1 - ticks, :]) / ticks  # m per tick
    return velocity[..., None, :] * steps[:, None]


class ConstantVelocity:
    """Continues with the last velocity.

    The velocity is the displacement over the last 0.2 s, along and across the road alike. Only positions are used, so
    it means the same for every source. It is the strongest of the simple choices: a longer window is less noisy, but
    its velocity is older, which costs more (on the public excerpt of US-101, RMSE after 5 s: 7.9 m over 0.2 s, 8.6 m
    over 1 s, 10.3 m over 3 s).
    """

    def __init__(self, protocol: Protocol) -> None:
        self.ticks = velocity_ticks(protocol)
        self.steps = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float32)

    def predict(self, observed: Observed[Singles]) -> Prediction:
        """Predict the positions of B samples."""
        return Prediction(position_m=extrapolate(observed.history, self.ticks, self.steps))
