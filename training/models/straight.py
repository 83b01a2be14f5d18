"""What a network's places are counted from: where constant velocity would be, or the sample's last position."""

import torch
from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.constant_velocity import extrapolate, velocity_ticks


class Straight(nn.Module):
    """Adds up to nothing that is learned: a fixed place per tick ahead, known at the moment of prediction.

    What a network puts out is added to it. A network that is residual is left with what constant velocity does not
    explain (braking, accelerating, changing lanes), and an error of 1 % of the distance driven costs it nothing; the
    layers are the published ones all the same, and a density stays one: only its mean is shifted.
    """

    def __init__(self, protocol: Protocol, *, residual: bool) -> None:
        """Prepare for a protocol's rate and horizon.

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
        """(..., H, 2) -> (..., F, 2) in m relative to the last position."""
        places: Tensor = extrapolate(history, self.ticks, self.steps)
        return places
