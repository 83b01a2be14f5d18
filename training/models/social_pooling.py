"""Convolutional social pooling, with and without maneuvers, and without neighbors (Deo and Trivedi 2018)."""

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy, cross_entropy, leaky_relu, one_hot

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import COLUMNS, ROWS, Observed, Truth
from tracklake.training.models.gaussians import Gaussian, gaussian_nll, to_density, to_gaussian, to_prediction
from tracklake.training.models.network import (
    Network,
    Straight,
    check_choice,
    check_phase,
    mean_squared_distance,
    to_numpy,
)
from tracklake.training.models.prediction import Prediction

SLOPE = 0.1
"""Slope of the leaky ReLUs where the input is negative."""
KERNEL = 3
"""Rows of the grid that each convolution's kernel covers."""
LATERAL, LONGITUDINAL = len(LATERAL_MANEUVERS), len(LONGITUDINAL_MANEUVERS)


class VanillaLstm(Network):
    """Embeds H positions in m (32), encodes them (LSTM, 64), embeds that (32), and unrolls F steps (LSTM, 128).

    Every step gets the same encoding and puts out the five numbers of a bivariate normal density
    (`training.models.gaussians`). Sizes and activations are those of convolutional social pooling (Deo and Trivedi
    2018), without the social tensor and its layers.
    """

    def __init__(self, protocol: Protocol, *, anchoring: str = "both") -> None:
        super().__init__()
        self.steps = protocol.horizon_ticks
        self.straight = Straight(protocol, anchoring=anchoring)
        self.embedding = nn.Linear(2, 32)
        self.encoder = nn.LSTM(32, 64, batch_first=True)
        self.dynamics = nn.Linear(64, 32)
        self.decoder = nn.LSTM(32, 128, batch_first=True)
        self.out = nn.Linear(128, 5)

    def forward(self, history: Tensor) -> Gaussian:
        """Return the density after a history (B, H, 2): mean (B, F, 2) relative to the last position, sigma, rho."""
        _, (state, _) = self.encoder(leaky_relu(self.embedding(history), SLOPE))
        encoding = leaky_relu(self.dynamics(state[-1]), SLOPE)  # (B, 32)
        decoded, _ = self.decoder(encoding[:, None, :].expand(-1, self.steps, -1))  # (B, F, 128)
        mean, sigma, rho = to_gaussian(self.out(decoded))
        return self.straight(history) + mean, sigma, rho

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () in phase `mse` the mean squared distance in m2, in phase `nll` the mean NLL in nats."""
        return _find_loss(self(observed.history), truth, phase)

    def predict_tensors(self, observed: Observed[Tensor]) -> Prediction:
        """Return the means and their density, of one alternative."""
        return to_prediction(self(observed.history))


class SocialPooling(Network):
    """Encodes the vehicle and its neighbors, pools the neighbors over their grid, and unrolls F steps.

    Layers, sizes and names of the weights are those of the published code: positions in m are embedded (32) and encoded
    by one LSTM for all vehicles (64). The neighbors' last hidden states are put into a 13 x 3 grid, which passes a
    3 x 3 convolution (64), a 3 x 1 convolution (16) and a max pool of 2 rows: 80 numbers. The vehicle's own last state
    is embedded (32). Both together, 112 numbers, are the input of the decoder (LSTM, 128) at every step; each step puts
    out the five numbers of a bivariate normal density (`training.models.gaussians`).

    With maneuvers, two heads give the probabilities of the 3 lateral and 2 longitudinal maneuvers from the 112 numbers,
    and the decoder also gets one of each kind, one-hot: in training the true one; in prediction all six combinations
    (2 * lateral + longitudinal), whose weights are the products of the probabilities.

    Differences from the published code: metres, with the axis along the road first; a neighbor with a short history is
    encoded with its earliest known position repeated, where the published reader leaves its cell empty, unless
    `short_histories` is False; the cross-entropies are those of one class out of several, where it averages one binary
    entropy per class, unless `maneuver_loss` is `binary`; means are counted from constant velocity, unless `anchoring`
    is `none` (or from it on one axis only).
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        maneuvers: bool,
        anchoring: str = "both",
        short_histories: bool = True,
        maneuver_loss: str = "categorical",
    ) -> None:
        super().__init__()
        check_choice("maneuver_loss", maneuver_loss, ("categorical", "binary"))
        self.short_histories, self.binary = short_histories, maneuver_loss == "binary"
        self.steps = protocol.horizon_ticks
        self.maneuvers = maneuvers
        self.straight = Straight(protocol, anchoring=anchoring)
        self.ip_emb = nn.Linear(2, 32)
        self.enc_lstm = nn.LSTM(32, 64)
        self.dyn_emb = nn.Linear(64, 32)
        self.soc_conv = nn.Conv2d(64, 64, 3)
        self.conv_3x1 = nn.Conv2d(64, 16, (3, 1))
        self.soc_maxpool = nn.MaxPool2d((2, 1), padding=(1, 0))
        width = 5 * 16 + 32
        self.dec_lstm = nn.LSTM(width + (LATERAL + LONGITUDINAL if maneuvers else 0), 128)
        self.op = nn.Linear(128, 5)
        if maneuvers:
            self.op_lat = nn.Linear(width, LATERAL)
            self.op_lon = nn.Linear(width, LONGITUDINAL)
        self.fast = True
        """Whether to leave out empty cells (same mathematics) where that is faster: in training, on a CPU."""

    @property
    def sparse(self) -> bool:
        """Whether empty cells are left out now; `benchmarks/training_steps.py` measures what that saves."""
        return self.fast and torch.is_grad_enabled() and self.device.type == "cpu"

    def encode(self, observed: Observed[Tensor]) -> Tensor:
        """Return (B, 112): 80 numbers of the neighbors, 32 of the vehicle."""
        samples = len(observed.history)
        around, sample, cell = observed.neighbor_history, observed.neighbor_sample.long(), observed.neighbor_cell.long()
        if not self.short_histories:
            whole = observed.neighbor_mask.all(dim=1)
            around, sample, cell = around[whole], sample[whole], cell[whole]
        positions = torch.cat([observed.history, around]).transpose(0, 1)  # (H, B + K, 2)
        _, (hidden, _) = self.enc_lstm(leaky_relu(self.ip_emb(positions), SLOPE))
        own, neighbors = hidden[-1][:samples], hidden[-1][samples:]  # (B, 64), (K, 64)
        pool = self._pool_sparsely if self.sparse else self._pool_densely
        social = pool(neighbors, sample, cell, samples)
        return torch.cat([social, leaky_relu(self.dyn_emb(own), SLOPE)], dim=1)

    def _pool_densely(self, states: Tensor, sample: Tensor, cell: Tensor, samples: int) -> Tensor:
        """Return (B, 80) of neighbors' states (K, 64), positions in the batch (K,), and cells 13 * column + row (K,).

        Rows along the road are the image's height and lanes its width, as published: the 3 x 3 convolution sees three
        rows of all three lanes, and leaves one column.
        """
        grid = states.new_zeros(samples * ROWS * COLUMNS, states.shape[1])
        grid = grid.index_copy(0, sample * ROWS * COLUMNS + cell, states)  # zeros in empty cells
        grid = grid.view(samples, COLUMNS, ROWS, states.shape[1]).permute(0, 3, 2, 1)  # (B, 64, 13, 3)
        features = leaky_relu(self.conv_3x1(leaky_relu(self.soc_conv(grid), SLOPE)), SLOPE)  # (B, 16, 9, 1)
        pooled: Tensor = self.soc_maxpool(features)  # (B, 16, 5, 1)
        return pooled.flatten(start_dim=1)

    def _pool_sparsely(self, states: Tensor, sample: Tensor, cell: Tensor, samples: int) -> Tensor:
        """Compute `_pool_densely` from occupied cells only: 11 % less time per step with 2.5 neighbors, 5 % with 9.

        A neighbor in row r enters the outputs r - 2, r - 1 and r of the first convolution; those below 0 and above 10
        do not exist and are dropped.
        """
        column, row = cell // ROWS, cell % ROWS
        by_column = torch.argsort(column, stable=True)
        counts = torch.bincount(column, minlength=COLUMNS).tolist()
        weight, bias = self.soc_conv.parameters()
        depth = self.soc_conv.out_channels
        kernels = weight.permute(3, 1, 2, 0).reshape(COLUMNS, -1, KERNEL * depth)  # one for each column
        parts = [part @ kernel for part, kernel in zip(torch.split(states[by_column], counts), kernels, strict=True)]

        span = ROWS + KERNEL - 1  # outputs -2 to 12
        output = (sample * span + row + KERNEL - 1)[by_column]  # where the kernel's row 0 adds to: the output r
        target = output[:, None] - torch.arange(KERNEL, device=cell.device)
        features = bias.expand(samples * span, depth).index_add(0, target.flatten(), torch.cat(parts).view(-1, depth))
        features = leaky_relu(features.view(samples, span, depth)[:, KERNEL - 1 : ROWS], SLOPE)  # (B, 11, 64)

        height = ROWS - 2 * (KERNEL - 1)  # 9
        windows = torch.cat([features[:, at : at + height] for at in range(KERNEL)], dim=2)  # (B, 9, 3 * 64)
        weight, bias = self.conv_3x1.parameters()
        kernel = weight[..., 0].permute(2, 1, 0).flatten(end_dim=1)  # (3 * 64, 16)
        features = leaky_relu(windows @ kernel + bias, SLOPE)
        pairs = torch.maximum(features[:, 1::2], features[:, 2::2])  # the pool's padding leaves row 0 by itself
        return torch.cat([features[:, :1], pairs], dim=1).transpose(1, 2).flatten(start_dim=1)

    def decode(self, encoding: Tensor) -> Tensor:
        """Return the raw numbers (N, F, 5) of encodings (N, 112), with maneuvers (N, 117)."""
        states, _ = self.dec_lstm(encoding.expand(self.steps, -1, -1))
        raw: Tensor = self.op(states)
        return raw.transpose(0, 1)

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () in phase `mse` the mean squared distance in m2, in phase `nll` the mean NLL in nats.

        With maneuvers both are the true one's, and `nll` adds the mean cross-entropies of both kinds in nats.
        """
        encoding = self.encode(observed)
        lateral, longitudinal = truth.lateral.long(), truth.longitudinal.long()
        decoded = encoding
        if self.maneuvers:
            decoded = torch.cat([encoding, _encode_maneuvers(lateral, longitudinal, encoding)], dim=1)
        loss = _find_loss(self._to_gaussian(self.decode(decoded), observed.history), truth, phase)
        if self.maneuvers and phase == "nll":
            for head, true in ((self.op_lat, lateral), (self.op_lon, longitudinal)):
                loss = loss + self._judge_maneuvers(head(encoding), true)
        return loss

    def _judge_maneuvers(self, logits: Tensor, true: Tensor) -> Tensor:
        """Return () the mean cross-entropy in nats of logits (B, C) and true classes (B,)."""
        if not self.binary:
            return cross_entropy(logits, true, reduction="sum") / max(len(true), 1)
        wanted = one_hot(true, logits.shape[1]).to(logits.dtype)
        return binary_cross_entropy(logits.softmax(dim=1), wanted, reduction="sum") / max(wanted.numel(), 1)

    def predict_tensors(self, observed: Observed[Tensor]) -> Prediction:
        """Return the means of the most probable maneuver, the mixture of all, and their probabilities."""
        encoding = self.encode(observed)
        if not self.maneuvers:
            return to_prediction(self._to_gaussian(self.decode(encoding), observed.history))
        lateral, longitudinal = (head(encoding).softmax(dim=1) for head in (self.op_lat, self.op_lon))
        weight = (lateral[:, :, None] * longitudinal[:, None, :]).flatten(start_dim=1)  # (B, 6)
        alternative = torch.arange(LATERAL * LONGITUDINAL, device=encoding.device)
        chosen = _encode_maneuvers(alternative // LONGITUDINAL, alternative % LONGITUDINAL, encoding)  # (6, 5)
        pairs = encoding.repeat_interleave(len(chosen), dim=0), chosen.repeat(len(encoding), 1)
        raw = torch.unflatten(self.decode(torch.cat(pairs, dim=1)), 0, (len(encoding), len(chosen)))  # (B, 6, F, 5)
        mean, sigma, rho = self._to_gaussian(raw, observed.history[:, None])
        likeliest = mean[torch.arange(len(mean), device=mean.device), weight.argmax(dim=1)]
        density = to_density(mean, sigma, rho, weight)
        return Prediction(to_numpy(likeliest), density, to_numpy(lateral), to_numpy(longitudinal))

    def _to_gaussian(self, raw: Tensor, history: Tensor) -> Gaussian:
        """Read (..., F, 5) as means in m relative to the sample's last position, sigma and rho."""
        mean, sigma, rho = to_gaussian(raw)
        return self.straight(history) + mean, sigma, rho


def _find_loss(gaussian: Gaussian, truth: Truth[Tensor], phase: str) -> Tensor:
    """Return () the mean squared distance in m2 (`mse`) or the mean NLL in nats (`nll`) of a density."""
    check_phase(phase, "mse", "nll")
    if phase == "mse":
        return mean_squared_distance(gaussian[0], truth.future, truth.future_mask)
    return gaussian_nll(*gaussian, truth.future, truth.future_mask)


def _encode_maneuvers(lateral: Tensor, longitudinal: Tensor, like: Tensor) -> Tensor:
    """Return (N, 5) one-hot maneuvers, 3 lateral and 2 longitudinal, of their positions (N,), (N,)."""
    return torch.cat([one_hot(lateral, LATERAL), one_hot(longitudinal, LONGITUDINAL)], dim=1).to(like.dtype)
