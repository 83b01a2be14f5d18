"""Networks of Choi et al. (2021) over 12 features of 20 ticks: stacked LSTM, and a decoder fed with its own output.

Anchored, both predict, standardised, how far a vehicle leaves the place that constant velocity relative to the ego
gives: our choice, as for the networks of overhead tracks. Not anchored, they predict standardised places, as published.
"""

import torch
from torch import Tensor, nn

from tracklake.training.models.lstms import WIDTH, decode_recursively
from tracklake.training.onboard.samples import FEATURE_NUMBER, FEATURES

PLACE_NOW = [FEATURE_NUMBER["rel_x_m"], FEATURE_NUMBER["rel_y_m"]]
"""Positions of the place now among the features."""


class FeatureNetwork(nn.Module):
    """Standardises features (B, H, 12) and scales outputs to metres, with figures of the training part.

    They are buffers, and so are stored with the weights, but for `mean_m`, which is 0 in anchored networks; others are
    not stored. `decode` of a subclass gets standardised features.
    """

    def __init__(self, ticks: int, *, anchored: bool = True) -> None:
        """Build a network for so many ticks ahead, F, that predicts deviations from straight places, or places."""
        super().__init__()
        self.ticks, self.anchored = ticks, anchored
        for name, fill in (("mean", torch.zeros(len(FEATURES))), ("scale", torch.ones(len(FEATURES)))):
            self.register_buffer(name, fill)
        self.register_buffer("scale_m", torch.ones(ticks, 2))
        self.register_buffer("mean_m", torch.zeros(ticks, 2), persistent=False)

    def standardise(self, feature: Tensor, output: Tensor) -> None:
        """Take means and scales from the training part: features (B, H, 12), deviations or places (B, F, 2)."""
        values = feature.flatten(0, 1)
        spread = values.std(dim=0, correction=0)
        self.mean: Tensor = values.mean(dim=0)
        self.scale: Tensor = torch.where(spread > 1e-6, spread, torch.ones_like(spread))  # what never varies stays 0
        self.mean_m: Tensor = torch.zeros_like(output[0]) if self.anchored else output.mean(dim=0)
        self.scale_m: Tensor = (output - self.mean_m).square().mean(dim=0).sqrt().clamp(min=0.01)

    def forward(self, feature: Tensor) -> Tensor:
        """Predict deviations from the straight places, or places, m: (B, F, 2) from (B, H, 12)."""
        output: Tensor = self.decode((feature - self.mean) / self.scale) * self.scale_m + self.mean_m
        return output

    def decode(self, feature: Tensor) -> Tensor:
        """Predict standardised outputs (B, F, 2) from standardised features (B, H, 12)."""
        raise NotImplementedError


class StackedLstm(FeatureNetwork):
    """Two stacked LSTM layers of 256, and a linear layer to all positions."""

    def __init__(self, ticks: int, width: int = WIDTH, *, anchored: bool = True) -> None:
        super().__init__(ticks, anchored=anchored)
        self.encoder = nn.LSTM(len(FEATURES), width, num_layers=2, batch_first=True)
        self.out = nn.Linear(width, 2 * ticks)

    def decode(self, feature: Tensor) -> Tensor:
        """Predict from the last layer's last state."""
        _, (state, _) = self.encoder(feature)
        deviation: Tensor = self.out(state[-1]).unflatten(-1, (-1, 2))
        return deviation


class RecursiveDecoder(FeatureNetwork):
    """Embedding of 256, two LSTM layers of 256 in encoder and decoder, output layer of 256.

    The decoder starts from the encoder's states and from the place now (anchored: 0), and is fed with its own output
    before, in training as in prediction.
    """

    def __init__(self, ticks: int, width: int = WIDTH, *, anchored: bool = True) -> None:
        super().__init__(ticks, anchored=anchored)
        self.embedding, self.embedding_of_place = nn.Linear(len(FEATURES), width), nn.Linear(2, width)
        self.encoder = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.decoder = nn.LSTM(width, width, num_layers=2, batch_first=True)
        self.output, self.place = nn.Linear(width, width), nn.Linear(width, 2)

    def decode(self, feature: Tensor) -> Tensor:
        """Predict tick by tick."""
        _, states = self.encoder(torch.relu(self.embedding(feature)))
        first = None if self.anchored else feature[:, -1:, PLACE_NOW]
        return decode_recursively(self, states, self.ticks, first)
