"""LSTM encoder-decoder that predicts the deviation from constant velocity."""

import torch
from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.constant_velocity import velocity_ticks
from tracklake.training.models.network import PlaceNetwork

SPEED_SCALE_MPS = 15.0
"""Divisor of speeds, in m/s: motorway traffic then lies between 0 and about 3."""


class DeviationLstm(PlaceNetwork):
    """Encodes H positions, unrolls F steps, and predicts the deviation from constant velocity.

    Constant velocity (as in the model of this name) explains nearly all of the future position; the network is left
    with braking, accelerating and changing lanes. Its last layer starts at zero, so an untrained network predicts
    constant velocity exactly and training starts from there.

    Inputs per tick of history, 6: the deviation from where constant velocity would have been (along, across) in m, its
    change since the tick before in m/s (along, across), and the constant velocity itself (along, across), scaled.
    Outputs per tick of future, 2: the change of the deviation; summed up over the ticks. `hidden` is the width of
    encoder and decoder.
    """

    def __init__(self, protocol: Protocol, *, hidden: int = 48) -> None:
        super().__init__()
        self.rate_hz = protocol.rate_hz
        self.ticks = velocity_ticks(protocol)
        self.steps = protocol.horizon_ticks
        self.encoder = nn.LSTM(6, hidden, batch_first=True)
        self.decoder = nn.LSTM(hidden, hidden, batch_first=True)
        self.out = nn.Linear(hidden, 2)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, history: Tensor) -> Tensor:
        """Predict (B, F, 2) from a history (B, H, 2): positions in m relative to the sample's last one."""
        velocity = (history[:, -1:] - history[:, -1 - self.ticks : -self.ticks]) / self.ticks  # (B, 1, 2) m per tick
        back = torch.arange(1 - history.shape[1], 1, device=history.device, dtype=history.dtype)
        deviation = history - velocity * back[:, None]  # (B, H, 2) m
        change = torch.diff(deviation, dim=1, prepend=deviation[:, :1]) * self.rate_hz  # (B, H, 2) m/s
        speed = (velocity * self.rate_hz / SPEED_SCALE_MPS).expand(-1, history.shape[1], -1)
        features = torch.cat([deviation, change, speed], dim=-1)  # (B, H, 6)

        _, (state, cell) = self.encoder(features)
        encoding = state[-1][:, None, :].expand(-1, self.steps, -1)  # the encoding again at every step
        decoded, _ = self.decoder(encoding, (state, cell))  # (B, F, hidden)
        ahead = torch.arange(1, self.steps + 1, device=history.device, dtype=history.dtype)
        return velocity * ahead[:, None] + torch.cumsum(self.out(decoded), dim=1)
