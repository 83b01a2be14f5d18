"""Networks of Choi et al. (2021) over 12 features of 20 ticks: stacked LSTM, and a decoder fed with its own output.

Both predict, standardised, how far a vehicle leaves the place that constant velocity relative to the ego gives: our
choice (the publication predicts places), as for the networks of overhead tracks, whose positions are residual, too.
"""

import torch
from torch import Tensor, nn

from tracklake.training.models.lstms import WIDTH, decode_recursively
from tracklake.training.onboard.samples import FEATURES


class FeatureNetwork(nn.Module):
    """Standardises features (B, H, 12) and scales outputs to metres, with figures of the training part.

    They are buffers, and so are stored with the weights. `decode` of a subclass gets standardised features.
    """

    def __init__(self, ticks: int) -> None:
        """Build a network for so many ticks ahead, F."""
        super().__init__()
        self.ticks = ticks
        for name, fill in (("mean", torch.zeros(len(FEATURES))), ("scale", torch.ones(len(FEATURES)))):
            self.register_buffer(name, fill)
        self.register_buffer("scale_m", torch.ones(ticks, 2))

    def standardise(self, feature: Tensor, deviation: Tensor) -> None:
        """Take means and scales from the training part: features (B, H, 12) and deviations from straight (B, F, 2)."""
        values = feature.flatten(0, 1)
        spread = values.std(dim=0, correction=0)
        self.mean: Tensor = values.mean(dim=0)
        self.scale: Tensor = torch.where(spread > 1e-6, spread, torch.ones_like(spread))  # what never varies stays 0
        self.scale_m: Tensor = deviation.square().mean(dim=0).sqrt().clamp(min=0.01)

    def forward(self, feature: Tensor) -> Tensor:
        """Predict deviations from the straight places, m: (B, F, 2) from (B, H, 12)."""
        deviation: Tensor = self.decode((feature - self.mean) / self.scale) * self.scale_m
        return deviation

    def decode(self, feature: Tensor) -> Tensor:
        """Predict standardised deviations (B, F, 2) from standardised features (B, H, 12)."""
        raise NotImplementedError


class StackedLstm(FeatureNetwork):
    """Two stacked LSTM layers of 256, and a linear layer to all positions."""

    def __init__(self, ticks: int, width: int = WIDTH) -> None:
        super().__init__(ticks)
        self.encoder = nn.LSTM(len(FEATURES), width, num_layers=2, batch_first=True)
        self.out = nn.Linear(width, 2 * ticks)

    def decode(self, feature: Tensor) -> Tensor:
        """Predict from the last layer's last state."""
        _, (state, _) = self.encoder(feature)
        deviation: Tensor = self.out(state[-1]).unflatten(-1, (-1, 2))
        return deviation


class RecursiveDecoder(FeatureNetwork):
    """Embedding of 256, two LSTM layers of 256 in encoder and decoder, output layer of 256.

    The decoder starts from the encoder's states and from 0, the place now, and is fed with its own output before, in
    training as in prediction.
    """

    def __init__(self, ticks: int, width: int = WIDTH) -> None:
        super().__init__(ticks)
        self.embedding, self.embedding_of_place = nn.Linear(len(FEATURES), width), nn.Linear(2, width)
        self.encoder = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.decoder = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.output, self.place = nn.Linear(width, width), nn.Linear(width, 2)

    def decode(self, feature: Tensor) -> Tensor:
        """Predict tick by tick."""
        _, states = self.encoder(torch.relu(self.embedding(feature)))
        return decode_recursively(self, states, self.ticks)
