"""Convolutional social pooling, with and without maneuvers (Deo and Trivedi 2018)."""

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, leaky_relu, one_hot, pad

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.gaussians import gaussian_nll, to_gaussian
from tracklake.training.models.network import Network, check_phase, mean_squared_distance, to_numpy
from tracklake.training.models.prediction import Density, Prediction
from tracklake.training.models.recurrence import last_state, unroll
from tracklake.training.models.social_grid import fill_grid, pool_densely, pool_sparsely
from tracklake.training.models.straight import Straight

SLOPE = 0.1
"""Of the leaky ReLUs where the input is negative."""

ALIGNED = 16
"""Numbers in the 64 bytes of a cache line."""

LATERAL, LONGITUDINAL = len(LATERAL_MANEUVERS), len(LONGITUDINAL_MANEUVERS)
Gaussian = tuple[Tensor, Tensor, Tensor]


class SocialPooling(Network):
    """Encodes the vehicle and its neighbors, pools the neighbors over their grid, and unrolls F steps.

    Layers, sizes and names of the weights are those of the published code: positions in m are embedded (32) and encoded
    by one LSTM for all vehicles (64); the neighbors' last states stand in a 13 x 3 grid, over which go a 3 x 3
    convolution (64), a 3 x 1 convolution (16) and a max pool of 2 rows (see `training.models.social_grid`): 80 numbers;
    the vehicle's own last state is embedded (32); both together, 112 numbers, are given to the decoder (LSTM, 128) at
    every step, each of which puts out the five numbers of a bivariate normal density (`training.models.gaussians`).

    With maneuvers, two heads say from the 112 numbers how probable the 3 lateral and 2 longitudinal maneuvers are, and
    the decoder is given a maneuver of each kind beside them as ones and zeros: in training the true one, which only
    `loss` knows; in prediction all six combinations, whose weights are the products of the probabilities.
    Alternative 2 * lateral + longitudinal, positions in LATERAL_MANEUVERS and LONGITUDINAL_MANEUVERS.

    What differs from the published code: metres, with the axis along the road first; a neighbor with a short history
    is encoded with its earliest known position repeated, where the published reader takes its cell for empty; the
    cross-entropies are those of one class out of several, where it averages one of every class by itself; means are
    counted from constant velocity, unless `residual` is False.
    """

    def __init__(self, protocol: Protocol, *, maneuvers: bool, residual: bool = True) -> None:
        """Prepare for a protocol's rate, history and horizon.

        Args:
            protocol: gives H and F.
            maneuvers: whether it has the two heads and a density for each combination.
            residual: means are counted from constant velocity, see `training.models.straight`.
        """
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
        """Whether to train with the quicker step (same mathematics) where that helps: on a processor."""

    @property
    def sparse(self) -> bool:
        """Whether the step now taken is the quicker one, in which empty cells are left out."""
        return self.fast and torch.is_grad_enabled() and self.device.type == "cpu"

    @property
    def by_hand(self) -> bool:
        """Whether the LSTMs are the quicker ones too: on one thread; several lose on small steps what they gain."""
        return self.sparse and torch.get_num_threads() == 1

    def encode(self, observed: Observed[Tensor]) -> Tensor:
        """(B, 112): 80 numbers of the surroundings, 32 of the vehicle."""
        samples = len(observed.history)
        positions = torch.cat([observed.history, observed.neighbor_history])  # (B + K, H, 2)
        states = self._encode_fast(positions) if self.by_hand else self._encode_plainly(positions)  # (B + K, 64)
        around = states[samples:]
        sample, cell = observed.neighbor_sample.long(), observed.neighbor_cell.long()
        if self.sparse:
            social = pool_sparsely(self.soc_conv, self.conv_3x1, SLOPE, around, sample, cell, samples)
        else:
            grid = fill_grid(around, sample, cell, samples)
            social = pool_densely(self.soc_conv, self.conv_3x1, self.soc_maxpool, SLOPE, grid)
        return torch.cat([social, leaky_relu(self.dyn_emb(states[:samples]), SLOPE)], dim=1)

    def decode(self, given: Tensor) -> Tensor:
        """(N, 112), with maneuvers (N, 117) -> (N, F, 5) as the last layer puts them out."""
        if self.by_hand:
            return (self.op.weight @ unroll(self.dec_lstm, given, self.steps)).permute(2, 0, 1) + self.op.bias
        states, _ = self.dec_lstm(given.expand(self.steps, -1, -1))
        raw: Tensor = self.op(states)
        return raw.transpose(0, 1)

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """() in phase `mse` the mean squared distance of the means in m2, in phase `nll` the mean NLL in nats.

        With maneuvers both are those of the true one's density, and `nll` adds the mean cross-entropies in nats of the
        lateral and the longitudinal maneuver.
        """
        check_phase(phase, "mse", "nll")
        encoding = self.encode(observed)
        lateral, longitudinal = truth.lateral.long(), truth.longitudinal.long()
        given = encoding
        if self.maneuvers:
            given = torch.cat([encoding, _as_ones(lateral, longitudinal, encoding)], dim=1)
        mean, sigma, rho = self._place(self.decode(given), observed.history)
        if phase == "mse":
            return mean_squared_distance(mean, truth.future, truth.future_mask)
        missed = gaussian_nll(mean, sigma, rho, truth.future, truth.future_mask)
        if self.maneuvers:
            heads = (self.op_lat(encoding), lateral), (self.op_lon(encoding), longitudinal)
            for odds, true in heads:
                missed = missed + cross_entropy(odds, true, reduction="sum") / max(len(true), 1)
        return missed

    def say(self, observed: Observed[Tensor]) -> Prediction:
        """Means of the most probable maneuver, the mixture of all, and how probable each is."""
        encoding = self.encode(observed)
        if not self.maneuvers:
            mean, sigma, rho = self._place(self.decode(encoding), observed.history)
            weight = encoding.new_ones(len(encoding), 1)
            return Prediction(to_numpy(mean), _to_density(weight, (mean[:, None], sigma[:, None], rho[:, None])))
        lateral, longitudinal = (head(encoding).softmax(dim=1) for head in (self.op_lat, self.op_lon))
        weight = (lateral[:, :, None] * longitudinal[:, None, :]).flatten(start_dim=1)  # (B, 6)
        alternative = torch.arange(LATERAL * LONGITUDINAL, device=encoding.device)
        chosen = _as_ones(alternative // LONGITUDINAL, alternative % LONGITUDINAL, encoding)  # (6, 5)
        given = torch.cat(
            [encoding.repeat_interleave(len(chosen), dim=0), chosen.repeat(len(encoding), 1)], dim=1
        )  # (B * 6, 117)
        raw = torch.unflatten(self.decode(given), 0, (len(encoding), len(chosen)))  # (B, 6, F, 5)
        mean, sigma, rho = self._place(raw, observed.history[:, None])
        likeliest = mean[torch.arange(len(mean), device=mean.device), weight.argmax(dim=1)]
        density = _to_density(weight, (mean, sigma, rho))
        return Prediction(to_numpy(likeliest), density, to_numpy(lateral), to_numpy(longitudinal))

    def _place(self, raw: Tensor, history: Tensor) -> Gaussian:
        """(..., F, 5) as means in m relative to the sample's last position, sigma and rho."""
        mean, sigma, rho = to_gaussian(raw)
        return self.straight(history) + mean, sigma, rho

    def _encode_plainly(self, positions: Tensor) -> Tensor:
        """(N, H, 2) -> (N, 64), by PyTorch's layers."""
        _, (state, _) = self.enc_lstm(leaky_relu(self.ip_emb(positions.transpose(0, 1)), SLOPE))
        return torch.as_tensor(state[-1])

    def _encode_fast(self, positions: Tensor) -> Tensor:
        """The same with features as rows; the embedding's last row is always 1 and carries the encoder's biases."""
        weight = torch.cat([self.ip_emb.weight, self.ip_emb.bias[:, None]], dim=1)
        weight = torch.cat([weight, weight.new_tensor([[0.0, 0.0, 1.0]])])  # (33, 3)
        # With zeros up to a multiple of ALIGNED, rows begin where vector instructions like them to.
        given = pad(positions.permute(1, 2, 0), (0, -len(positions) % ALIGNED))
        given = torch.cat([given, given.new_ones(len(given), 1, given.shape[2])], dim=1)  # (H, 3, N)
        embedded = leaky_relu(weight @ given, SLOPE)  # (H, 33, N)
        return last_state(self.enc_lstm, embedded)[: len(positions)]


def _as_ones(lateral: Tensor, longitudinal: Tensor, like: Tensor) -> Tensor:
    """(N,), (N,) -> (N, 5) ones and zeros: 3 of the lateral maneuver, 2 of the longitudinal."""
    both = one_hot(lateral, LATERAL), one_hot(longitudinal, LONGITUDINAL)
    return torch.cat(both, dim=1).to(like.dtype)


def _to_density(weight: Tensor, gaussian: Gaussian) -> Density:
    return Density(*(to_numpy(part) for part in (weight, *gaussian)))
