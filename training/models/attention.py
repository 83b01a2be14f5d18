"""Vehicle and lane attention, which predicts every vehicle of a scene at once (Kim et al. 2020)."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tracklake.schemas.arrays import Flags, Singles
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import ObservedScene, Truth
from tracklake.training.models.attention_layers import MultiHeadAttention, perceptron
from tracklake.training.models.constant_velocity import velocity_ticks
from tracklake.training.models.gaussians import Gaussian, gaussian_nll, to_density, to_gaussian
from tracklake.training.models.network import Network, check_phase, to_numpy
from tracklake.training.models.prediction import Prediction
from tracklake.training.models.scene_features import Vehicles, count_features, describe_lanes, describe_vehicles

VEHICLE_WIDTH, LANE_WIDTH = 16, 4
"""Width of the embeddings of vehicles and lanes."""
VEHICLE_HEAD_WIDTH, LANE_HEAD_WIDTH = 8, 32
"""Width of a query, key or value per head."""
EPSILON = 1e-6
"""Epsilon of the layer normalisation."""
DROPOUT = 0.7
"""Probability of dropping a number; `SceneAttention` says how the published value is read."""


@dataclass(frozen=True)
class Attention:
    """Attention weights of B scenes; rows sum to 1 over the vehicles or lanes that are present.

    Rows and columns of absent vehicles and lanes are 0, and so are all rows of `lanes` where no lane is present.

    Args:
        vehicles: (B, heads, V, V) weights of the encoder; a row's vehicle attends to a column's.
        lanes: (B, heads, V, 3) weights of the encoder for the lanes left of, under and right of the ego.
        decoder: (B, heads, V, V) weights of the decoder.
    """

    vehicles: Singles
    lanes: Singles
    decoder: Singles


@dataclass(frozen=True)
class SceneForecast:
    """Densities of the position of every vehicle of B scenes at F ticks, relative to the ego's last position.

    Args:
        mean_m: (B, V, F, 2) 0 where there is no vehicle.
        covariance_m2: (B, V, F, 2, 2) the unit matrix where there is no vehicle.
        vehicle_mask: (B, V) True where there is a vehicle.
    """

    mean_m: Singles
    covariance_m2: Singles
    vehicle_mask: Flags


class SceneAttention(Network):
    """Vehicles attend to each other and to the ego's lanes, then once more to each other.

    As published: vehicle embeddings of 16 numbers over past positions, length and width, and lane embeddings of 4 over
    the centre's offset, the width, and whether the lane exists. In the encoder vehicles attend to vehicles (8 numbers
    per head) and to lanes (32 per head), each as in `training.models.attention_layers`; both results together, 32
    numbers, are the encoding. In the decoder vehicles attend to vehicles once more (8 per head). Its output gives the
    five numbers of a bivariate normal density per tick (`training.models.gaussians`). No layer knows which vehicle is
    the ego, or the order of the vehicles: any number of them, in any order, is predicted at once.

    The loss is nll_weight x NLL + distance_weight x distance (not squared), both means over the known positions of
    all vehicles of the batch.

    What the publication leaves open, and the choices made here:

    * The weights of the loss, both 1: nats and metres are then of the same order.
    * The layers between positions and embedding, and between the decoder's output and positions: one hidden layer each.
    * Whether 0.7 is dropped or kept: dropped. On simulated recordings (4 heads, 2,000 steps of 128 scenes, two seeds)
      RMSE of the samples themselves at 5 s is then 3.00 and 3.17 m as against 2.95 and 3.03 m with 0.7 kept, NLL 0.73
      and 0.74 as against 0.70 and 0.73 nats; constant velocity has 3.43 m. `dropout` = 0.3 is the other reading.

    Differences: positions are given as last position, velocity and deviations (`training.models.scene_features`), and
    means are counted from every vehicle's own constant velocity unless `residual` is False; an untrained network then
    predicts constant velocity.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        heads: int,
        hidden: int = 128,
        dropout: float = DROPOUT,
        nll_weight: float = 1.0,
        distance_weight: float = 1.0,
        residual: bool = True,
    ) -> None:
        """Build the layers for a protocol's rate, history and horizon.

        Args:
            protocol: gives H and F.
            heads: number of heads of every attention.
            hidden: width of the hidden layers in the vehicle embedding and before the output; 0: none.
            dropout: probability of dropping a number of an attention's output in training.
            nll_weight: weight of the negative log likelihood (nats) in the loss.
            distance_weight: weight of the distance (m) in the loss.
            residual: count means from constant velocity; False: from the ego's last position, as published.

        Raises:
            UsageError: there are no heads.
        """
        super().__init__()
        self.rate_hz = protocol.rate_hz
        self.ticks = velocity_ticks(protocol)
        self.nll_weight, self.distance_weight = nll_weight, distance_weight
        self.residual = residual
        ahead = torch.arange(1, protocol.horizon_ticks + 1, dtype=torch.float32)
        self.ahead: Tensor
        self.register_buffer("ahead", ahead, persistent=False)
        encoded = 2 * VEHICLE_WIDTH
        common = partial(MultiHeadAttention, heads=heads, dropout=dropout, epsilon=EPSILON)
        self.embed_vehicle = perceptron(count_features(protocol.history_ticks), hidden, VEHICLE_WIDTH)
        self.embed_lane = nn.Linear(3, LANE_WIDTH)
        self.vehicle_attention = common(VEHICLE_WIDTH, VEHICLE_WIDTH, head_width=VEHICLE_HEAD_WIDTH)
        self.lane_attention = common(VEHICLE_WIDTH, LANE_WIDTH, head_width=LANE_HEAD_WIDTH)
        self.decoder = common(encoded, encoded, head_width=VEHICLE_HEAD_WIDTH)
        self.out = perceptron(encoded, hidden, 5 * protocol.horizon_ticks)
        if residual:
            for weights in self.out[-1].parameters():
                nn.init.zeros_(weights)

    def forward(self, observed: ObservedScene[Tensor]) -> Gaussian:
        """Return mean (B, V, F, 2) in m relative to the ego's last position, sigma (B, V, F, 2) in m, rho (B, V, F)."""
        vehicles = self._describe(observed)
        decoded, _ = self._attend(observed, vehicles)
        raw = torch.unflatten(self.out(decoded), -1, (len(self.ahead), 5))
        mean, sigma, rho = to_gaussian(raw.masked_fill(~observed.vehicle_mask[..., None, None], 0.0))
        if self.residual:
            mean = mean + vehicles.place_m[..., None, :] + vehicles.velocity[..., None, :] * self.ahead[:, None]
        return mean, sigma, rho

    def loss(self, observed: ObservedScene[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () nll_weight x mean NLL + distance_weight x mean distance over all known positions."""
        check_phase(phase, "both")
        mean, sigma, rho = self(observed)
        known = truth.future_mask & observed.vehicle_mask[..., None]
        nll = gaussian_nll(mean, sigma, rho, truth.future, known)
        return self.nll_weight * nll + self.distance_weight * mean_distance(mean, truth.future, known)

    def predict_tensors(self, observed: ObservedScene[Tensor]) -> Prediction:
        """Return the ego's mean and density."""
        mean, sigma, rho = (part[:, 0] for part in self(observed))
        return Prediction(to_numpy(mean), to_density(mean, sigma, rho))

    def predict_scene(self, observed: ObservedScene[Any]) -> SceneForecast:
        """Return means and covariances of all vehicles of scenes of NumPy arrays."""
        mean, sigma, rho = self.infer(observed, self)
        covariance = sigma[..., :, None] * sigma[..., None, :]  # (B, V, F, 2, 2)
        covariance[..., 0, 1] *= rho
        covariance[..., 1, 0] *= rho
        return SceneForecast(to_numpy(mean), to_numpy(covariance), np.asarray(observed.vehicle_mask))

    def read_attention(self, observed: ObservedScene[Any]) -> Attention:
        """Return the attention weights for scenes of NumPy arrays."""
        _, weights = self.infer(observed, lambda tensors: self._attend(tensors, self._describe(tensors)))
        absent = ~np.asarray(observed.vehicle_mask)[:, None, :, None]
        return Attention(*(np.where(absent, np.float32(0), to_numpy(part)) for part in weights))

    def _describe(self, observed: ObservedScene[Tensor]) -> Vehicles:
        return describe_vehicles(observed, self.ticks, self.rate_hz)

    def _attend(self, observed: ObservedScene[Tensor], vehicles: Vehicles) -> tuple[Tensor, Gaussian]:
        """Return (B, V, 32), and the weights of the vehicles, the lanes and the decoder."""
        present = observed.vehicle_mask
        lanes, exists = describe_lanes(observed)
        embedded = self.embed_vehicle(vehicles.features)
        to_vehicles, vehicle_weights = self.vehicle_attention(embedded, embedded, present)
        to_lanes, lane_weights = self.lane_attention(embedded, self.embed_lane(lanes), exists)
        encoded = torch.cat([to_vehicles, to_lanes], dim=-1)
        decoded, decoder_weights = self.decoder(encoded, encoded, present)
        return decoded, (vehicle_weights, lane_weights, decoder_weights)


def mean_distance(predicted: Tensor, future: Tensor, known: Tensor) -> Tensor:
    """Return () the mean distance in m, not squared, over the known positions; 0 where none is known.

    Args:
        predicted: (..., F, 2) in m.
        future: (..., F, 2) in m; masked positions are ignored.
        known: (..., F) True where the position is known.
    """
    away = torch.where(known[..., None], predicted - future, 0.0)
    # At distance 0 the gradient of a square root is infinite; that of this norm is 0.
    distances: Tensor = torch.linalg.vector_norm(away, dim=-1)
    return distances.sum() / known.sum().clamp(min=1)
