"""Constant velocity: the plainest prediction, which every other one has to beat. NumPy only."""

import numpy as np
import numpy.typing as npt

from schemas.protocols import Protocol
from training.tensors import Batch

VELOCITY_S = 0.2
"""Seconds of history that the velocity is taken from."""


def velocity_ticks(protocol: Protocol) -> int:
    """Ticks of history that the velocity is taken from: one at 5 Hz, two at 10 Hz."""
    return min(max(1, round(VELOCITY_S * protocol.rate_hz)), protocol.history_ticks - 1)


class ConstantVelocity:
    """Goes on as it went last.

    The velocity is the displacement over the last 0.2 s, along and across the road alike. Only positions are used, so
    it means the same for every source. It is the strongest of the plain choices: a longer window is less noisy, but
    its velocity is older, which costs more (on the public excerpt of US-101, RMSE after 5 s: 7.9 m over 0.2 s, 8.6 m
    over 1 s, 10.3 m over 3 s).
    """

    def __init__(self, protocol: Protocol) -> None:
        """Prepare for a protocol's rate and horizon."""
        self.ticks = velocity_ticks(protocol)
        self.steps = np.arange(1, protocol.horizon_ticks + 1, dtype=np.float32)

    def predict(self, batch: Batch) -> npt.NDArray[np.float32]:
        """(B, F, 2) positions in m relative to the sample's last one."""
        velocity = (batch.history[:, -1] - batch.history[:, -1 - self.ticks]) / np.float32(self.ticks)  # m per tick
        predicted: npt.NDArray[np.float32] = velocity[:, None, :] * self.steps[:, None]
        return predicted
