"""LSTM networks over a sample's own history, which predict positions."""

from typing import Any

import torch
from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.motion import count_velocity_ticks
from tracklake.training.models.network import PlaceNetwork, Straight

SPEED_SCALE_MPS = 15.0
"""Divisor of speeds, in m/s: motorway traffic then lies between 0 and about 3."""
WIDTH = 256
"""Width of the encoder-decoder's embedding, of its LSTM layers and of its output layer (Choi et al. 2021)."""


class DeviationLstm(PlaceNetwork):
    """Encodes H positions, unrolls F steps (both LSTMs), and predicts the deviation from constant velocity.

    Inputs per tick of history, 6: the deviation from constant velocity in m, its change since the tick before in m/s,
    and the constant velocity itself, scaled; each along and across. Outputs per tick of future, 2: the change of the
    deviation, summed up over the ticks. The last layer starts at zero: an untrained network predicts constant velocity.
    """

    def __init__(self, protocol: Protocol, *, hidden: int = 48, anchoring: str = "both") -> None:
        super().__init__()
        self.rate_hz = protocol.rate_hz
        self.ticks = count_velocity_ticks(protocol)
        self.straight = Straight(protocol, anchoring=anchoring)
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
        positions: Tensor = self.straight(history) + torch.cumsum(self.out(decoded), dim=1)
        return positions


class StackedLstm(PlaceNetwork):
    """Encodes H positions in m, and predicts F positions from its last state; as in Choi et al. 2021, but the width."""

    def __init__(self, protocol: Protocol, *, hidden: int = 128, anchoring: str = "both") -> None:
        super().__init__()
        self.straight = Straight(protocol, anchoring=anchoring)
        self.encoder = nn.LSTM(2, hidden, num_layers=2, batch_first=True)
        self.out = nn.Linear(hidden, protocol.horizon_ticks * 2)

    def forward(self, history: Tensor) -> Tensor:
        """Predict (B, F, 2) from a history (B, H, 2): positions in m relative to the sample's last one."""
        _, (state, _) = self.encoder(history)
        positions: Tensor = self.straight(history) + self.out(state[-1]).unflatten(-1, (-1, 2))  # (B, F, 2)
        return positions


class EncoderDecoder(PlaceNetwork):
    """Embeds H positions in m (256, ReLU), encodes them (2 x 256), decodes F steps (2 x 256) to positions.

    The output layer has 256 units (ReLU) and is followed by the linear one to 2 numbers. The decoder starts from the
    encoder's states, layer by layer, and gets the encoder's last output at every step. That input is our choice:
    `recursive`, it is as published and gets its own output of the step before, embedded (256, ReLU), at first 0. It
    then runs step by step and carries early errors on.
    """

    def __init__(self, protocol: Protocol, *, anchoring: str = "both", recursive: bool = False) -> None:
        super().__init__()
        self.steps = protocol.horizon_ticks
        self.straight = Straight(protocol, anchoring=anchoring)
        self.embedding = nn.Linear(2, WIDTH)
        self.encoder = nn.LSTM(WIDTH, WIDTH, num_layers=2, batch_first=True)
        self.decoder = nn.LSTM(WIDTH, WIDTH, num_layers=2, batch_first=True)
        self.output = nn.Linear(WIDTH, WIDTH)
        self.place = nn.Linear(WIDTH, 2)
        self.embedding_of_place = nn.Linear(2, WIDTH) if recursive else None

    def forward(self, history: Tensor) -> Tensor:
        """Predict (B, F, 2) from a history (B, H, 2): positions in m relative to the sample's last one."""
        _, states = self.encoder(torch.relu(self.embedding(history)))
        if self.embedding_of_place is not None:
            places: Tensor = self.straight(history) + decode_recursively(self, states, self.steps)
            return places
        encoding = states[0][-1][:, None, :].expand(-1, self.steps, -1)  # (B, F, 256)
        decoded, _ = self.decoder(encoding, states)  # (B, F, 256)
        positions: Tensor = self.straight(history) + self.place(torch.relu(self.output(decoded)))
        return positions


def decode_recursively(
    network: Any,  # noqa: ANN401  (a network of these layers)
    states: tuple[Tensor, Tensor],
    steps: int,
    first: Tensor | None = None,
) -> Tensor:
    """Decode places (B, steps, 2), each from the one before, at first from `first` (B, 1, 2) or 0.

    In training as in prediction. The network has the layers `embedding_of_place`, `decoder` (an LSTM with these
    states), `output` and `place`.
    """
    place = states[0].new_zeros(states[0].shape[1], 1, 2) if first is None else first
    places = []
    for _ in range(steps):
        decoded, states = network.decoder(torch.relu(network.embedding_of_place(place)), states)
        place = network.place(torch.relu(network.output(decoded)))
        places.append(place)
    return torch.cat(places, dim=1)
