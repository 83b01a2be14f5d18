"""LSTM encoder-decoder: two stacked layers that read the history, two that unroll the future."""

import torch
from torch import Tensor, nn

from tracklake.schemas.protocols import Protocol
from tracklake.training.models.network import PlaceNetwork
from tracklake.training.models.straight import Straight

WIDTH = 256
"""Width of the embedding, of every LSTM layer and of the output layer (Choi et al. 2021)."""


class EncoderDecoder(PlaceNetwork):
    """Embeds H positions in m (256, ReLU), encodes them (2 x 256), decodes F steps (2 x 256) to positions.

    The output layer has 256 units (ReLU) and is followed by the linear one to 2 numbers. The decoder starts from the
    encoder's states, layer by layer, and gets the encoder's last output at every step. That input is our choice: with
    its own last position instead, as in translation, it would run step by step, and an early error would be carried
    on.
    """

    def __init__(self, protocol: Protocol, *, residual: bool = True) -> None:
        super().__init__()
        self.steps = protocol.horizon_ticks
        self.straight = Straight(protocol, residual=residual)
        self.embedding = nn.Linear(2, WIDTH)
        self.encoder = nn.LSTM(WIDTH, WIDTH, num_layers=2, batch_first=True)
        self.decoder = nn.LSTM(WIDTH, WIDTH, num_layers=2, batch_first=True)
        self.output = nn.Linear(WIDTH, WIDTH)
        self.place = nn.Linear(WIDTH, 2)

    def forward(self, history: Tensor) -> Tensor:
        """Predict (B, F, 2) from a history (B, H, 2): positions in m relative to the sample's last one."""
        _, states = self.encoder(torch.relu(self.embedding(history)))
        encoding = states[0][-1][:, None, :].expand(-1, self.steps, -1)  # (B, F, 256)
        decoded, _ = self.decoder(encoding, states)  # (B, F, 256)
        positions: Tensor = self.straight(history) + self.place(torch.relu(self.output(decoded)))
        return positions
