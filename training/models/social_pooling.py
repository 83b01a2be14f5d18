"""Convolutional social pooling, with and without maneuvers (Deo and Trivedi 2018)."""

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, leaky_relu, one_hot

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.gaussians import Gaussian, gaussian_nll, to_density, to_gaussian
from tracklake.training.models.network import Network, check_phase, mean_squared_distance, to_numpy
from tracklake.training.models.prediction import Prediction
from tracklake.training.models.social_grid import fill_grid, pool_densely, pool_sparsely
from tracklake.training.models.straight import Straight

SLOPE = 0.1
"""Slope of the leaky ReLUs where the input is negative."""

LATERAL, LONGITUDINAL = len(LATERAL_MANEUVERS), len(LONGITUDINAL_MANEUVERS)


class SocialPooling(Network):
    """Encodes the vehicle and its neighbors, pools the neighbors over their grid, and unrolls F steps.

    Layers, sizes and names of the weights are those of the published code: positions in m are embedded (32) and encoded
    by one LSTM for all vehicles (64). The neighbors' last hidden states are put into a 13 x 3 grid, which passes a
    3 x 3 convolution (64), a 3 x 1 convolution (16) and a max pool of 2 rows (see `training.models.social_grid`): 80
    numbers. The vehicle's own last state is embedded (32). Both together, 112 numbers, are the input of the decoder
    (LSTM, 128) at every step; each step puts out the five numbers of a bivariate normal density
    (`training.models.gaussians`).

    With maneuvers, two heads give the probabilities of the 3 lateral and 2 longitudinal maneuvers from the 112 numbers,
    and the decoder also gets one maneuver of each kind, one-hot: in training the true one, which only `loss` knows; in
    prediction all six combinations, whose weights are the products of the probabilities. Alternative
    2 * lateral + longitudinal, positions in LATERAL_MANEUVERS and LONGITUDINAL_MANEUVERS.

    Differences from the published code: metres, with the axis along the road first; a neighbor with a short history is
    encoded with its earliest known position repeated, where the published reader leaves its cell empty; the
    cross-entropies are those of one class out of several, where it averages one binary entropy per class; means are
    counted from constant velocity, unless `residual` is False.
    """

    def __init__(self, protocol: Protocol, *, maneuvers: bool, residual: bool = True) -> None:
        super().__init__()
        self.steps = protocol.horizon_ticks
        self.maneuvers = maneuvers
        self.straight = Straight(protocol, residual=residual)
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
        positions = torch.cat([observed.history, observed.neighbor_history]).transpose(0, 1)  # (H, B + K, 2)
        _, (hidden, _) = self.enc_lstm(leaky_relu(self.ip_emb(positions), SLOPE))
        own, neighbors = hidden[-1][:samples], hidden[-1][samples:]  # (B, 64), (K, 64)
        sample, cell = observed.neighbor_sample.long(), observed.neighbor_cell.long()
        if self.sparse:
            social = pool_sparsely(self.soc_conv, self.conv_3x1, SLOPE, neighbors, sample, cell, samples)
        else:
            grid = fill_grid(neighbors, sample, cell, samples)
            social = pool_densely(self.soc_conv, self.conv_3x1, self.soc_maxpool, SLOPE, grid)
        return torch.cat([social, leaky_relu(self.dyn_emb(own), SLOPE)], dim=1)

    def decode(self, encoding: Tensor) -> Tensor:
        """Return the raw numbers (N, F, 5) of encodings (N, 112), with maneuvers (N, 117)."""
        states, _ = self.dec_lstm(encoding.expand(self.steps, -1, -1))
        raw: Tensor = self.op(states)
        return raw.transpose(0, 1)

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () in phase `mse` the mean squared distance in m2, in phase `nll` the mean NLL in nats.

        With maneuvers both are those of the true one's density, and `nll` adds the mean cross-entropies in nats of the
        lateral and the longitudinal maneuver.
        """
        check_phase(phase, "mse", "nll")
        encoding = self.encode(observed)
        lateral, longitudinal = truth.lateral.long(), truth.longitudinal.long()
        decoded = encoding
        if self.maneuvers:
            decoded = torch.cat([encoding, _encode_maneuvers(lateral, longitudinal, encoding)], dim=1)
        mean, sigma, rho = self._to_gaussian(self.decode(decoded), observed.history)
        if phase == "mse":
            return mean_squared_distance(mean, truth.future, truth.future_mask)
        loss = gaussian_nll(mean, sigma, rho, truth.future, truth.future_mask)
        if self.maneuvers:
            heads = (self.op_lat(encoding), lateral), (self.op_lon(encoding), longitudinal)
            for logits, true in heads:
                loss = loss + cross_entropy(logits, true, reduction="sum") / max(len(true), 1)
        return loss

    def predict_tensors(self, observed: Observed[Tensor]) -> Prediction:
        """Return the means of the most probable maneuver, the mixture of all, and their probabilities."""
        encoding = self.encode(observed)
        if not self.maneuvers:
            mean, sigma, rho = self._to_gaussian(self.decode(encoding), observed.history)
            return Prediction(to_numpy(mean), to_density(mean, sigma, rho))
        lateral, longitudinal = (head(encoding).softmax(dim=1) for head in (self.op_lat, self.op_lon))
        weight = (lateral[:, :, None] * longitudinal[:, None, :]).flatten(start_dim=1)  # (B, 6)
        alternative = torch.arange(LATERAL * LONGITUDINAL, device=encoding.device)
        chosen = _encode_maneuvers(alternative // LONGITUDINAL, alternative % LONGITUDINAL, encoding)  # (6, 5)
        decoded = torch.cat(
            [encoding.repeat_interleave(len(chosen), dim=0), chosen.repeat(len(encoding), 1)], dim=1
        )  # (B * 6, 117)
        raw = torch.unflatten(self.decode(decoded), 0, (len(encoding), len(chosen)))  # (B, 6, F, 5)
        mean, sigma, rho = self._to_gaussian(raw, observed.history[:, None])
        likeliest = mean[torch.arange(len(mean), device=mean.device), weight.argmax(dim=1)]
        density = to_density(mean, sigma, rho, weight)
        return Prediction(to_numpy(likeliest), density, to_numpy(lateral), to_numpy(longitudinal))

    def _to_gaussian(self, raw: Tensor, history: Tensor) -> Gaussian:
        """Read (..., F, 5) as means in m relative to the sample's last position, sigma and rho."""
        mean, sigma, rho = to_gaussian(raw)
        return self.straight(history) + mean, sigma, rho


def _encode_maneuvers(lateral: Tensor, longitudinal: Tensor, like: Tensor) -> Tensor:
    """Return (N, 5) one-hot maneuvers, 3 lateral and 2 longitudinal, of their positions (N,), (N,)."""
    both = one_hot(lateral, LATERAL), one_hot(longitudinal, LONGITUDINAL)
    return torch.cat(both, dim=1).to(like.dtype)
