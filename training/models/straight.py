"""The positions that a network's outputs are counted from: constant velocity, or the last position."""

import torch
from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.constant_velocity import extrapolate, velocity_ticks


class Straight(nn.Module):
    """A fixed position per tick ahead, known at the tick of prediction; nothing in it is learned.

    The output of a network is added to it. A residual network is left with what constant velocity does not explain
    (braking, accelerating, changing lanes), and an error of 1 % of the distance driven costs it nothing. Its layers are
    the published ones, and of a density only the mean is shifted.
    """

    def __init__(self, protocol: Protocol, *, residual: bool) -> None:
        """Build the layers for a protocol's rate and horizon.

        Args:
            protocol: gives F and the ticks that the velocity is taken from.
            residual: count from constant velocity; False: from the sample's last position, as published.
        """
        super().__init__()
        self.ticks = velocity_ticks(protocol)
        steps = torch.arange(1, protocol.horizon_ticks + 1, dtype=torch.float32)
        self.steps: Tensor
        self.register_buffer("steps", steps if residual else torch.zeros_like(steps), persistent=False)

    def forward(self, history: Tensor) -> Tensor:
        """Return (..., F, 2) in m relative to the last position of histories (..., H, 2)."""
        positions: Tensor = extrapolate(history, self.ticks, self.steps)
        return positions
