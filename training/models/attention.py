"""Vehicle and lane attention, which predicts every vehicle of a scene at once (Kim et al. 2020)."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from tracklake.schemas.arrays import Singles
from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.gathers import NEAREST
from tracklake.training.data.observed import ObservedScene, Truth
from tracklake.training.models.gaussians import Gaussian, gaussian_nll, to_gaussian, to_prediction
from tracklake.training.models.motion import count_velocity_ticks
from tracklake.training.models.network import Network, check_choice, check_phase, find_anchored, to_numpy
from tracklake.training.models.prediction import Prediction

VEHICLE_WIDTH, LANE_WIDTH = 16, 4
"""Width of the embeddings of vehicles and lanes."""
VEHICLE_HEAD_WIDTH, LANE_HEAD_WIDTH = 8, 32
"""Width of a query, key or value per head."""
EPSILON = 1e-6
"""Epsilon of the layer normalisation."""
PLACE_SCALE_M, SPEED_SCALE_MPS, DEVIATION_SCALE_M = (50.0, 5.0), (15.0, 1.0), (5.0, 1.0)
"""Divisors of last positions, of velocities and of deviations from constant velocity, along and across the road."""
SIZE_SCALE_M, LANE_SCALE_M = (5.0, 2.0), 4.0
"""Divisors of a vehicle's length and width, and of a lane's offset and width, in m."""
INPUTS, LANES = ("deviations", "positions"), ("adjacent", "all", "none")
"""Ways to describe a vehicle's history, and the lanes that vehicles attend to."""


@dataclass(frozen=True)
class Attention:
    """Attention weights of B scenes; rows sum to 1 over what is present, rows and columns of what is absent are 0.

    Args:
        vehicles: (B, heads, V, V) weights of the encoder; a row's vehicle attends to a column's.
        lanes: (B, heads, V, 3 or M) weights of the encoder for the lanes of `SceneAttention.choose_lanes`.
        decoder: (B, heads, V, V) weights of the decoder.
    """

    vehicles: Singles
    lanes: Singles
    decoder: Singles


class Vehicles(NamedTuple):
    """Vehicles of B scenes; all 0 where there is none."""

    features: Tensor
    """(B, V, 3 H + 6) inputs: last position 2, velocity 2, deviations 2 H, known or not H, size 2.

    Of raw positions (B, V, 2 H + 2): positions in m, size in m.
    """
    place_m: Tensor
    """(B, V, 2) last positions, relative to the ego's."""
    velocity: Tensor
    """(B, V, 2) in m per tick."""


class MultiHeadAttention(nn.Module):
    """Queries attend to keys in several heads; the result is added to them and normalised.

    Per head, queries, keys and values are projected to `head_width` numbers; weights are the softmax of the products
    of queries and keys, divided by sqrt(head_width). The heads' sums of values are mapped back to the queries' width,
    pass dropout and are added to the queries; layer normalisation follows (Vaswani et al. 2017; Kim et al. 2020).
    """

    def __init__(self, query_width: int, key_width: int, *, heads: int, head_width: int, dropout: float) -> None:
        super().__init__()
        if heads < 1:
            raise UsageError(f"attention with {heads} heads: expected at least 1")
        self.heads, self.head_width = heads, head_width
        self.query = nn.Linear(query_width, heads * head_width)
        self.key = nn.Linear(key_width, heads * head_width)
        self.value = nn.Linear(key_width, heads * head_width)
        self.back = nn.Linear(heads * head_width, query_width)
        self.dropout = nn.Dropout(dropout)
        self.norm = nn.LayerNorm(query_width, eps=EPSILON)

    def forward(self, queries: Tensor, keys: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Return queries (B, Q, query_width) with the result added, and the weights (B, heads, Q, K).

        Keys (B, K, key_width) are finite, also where absent. Where none is present (B, K), nothing is added.
        """
        query, key, value = (self._split(of) for of in (self.query(queries), self.key(keys), self.value(keys)))
        scores = query @ key.transpose(-1, -2) / math.sqrt(self.head_width)
        absent = ~present[:, None, None, :]
        # The least number, not minus infinity: a row without any key would turn into NaN, and so would its gradient.
        weights = torch.softmax(scores.masked_fill(absent, torch.finfo(scores.dtype).min), dim=-1)
        weights = weights.masked_fill(absent, 0.0)
        joined = (weights @ value).transpose(1, 2).flatten(start_dim=2)  # (B, Q, heads * head_width)
        found = self.back(joined).masked_fill(~present.any(dim=-1)[:, None, None], 0.0)
        return self.norm(queries + self.dropout(found)), weights

    def _split(self, projected: Tensor) -> Tensor:
        """Reshape (B, N, heads * head_width) to (B, heads, N, head_width)."""
        return torch.unflatten(projected, -1, (self.heads, self.head_width)).transpose(1, 2)


class SceneAttention(Network):
    """Vehicles attend to each other and to the ego's lanes, then once more to each other.

    As published: vehicle embeddings of 16 numbers over past positions, length and width, and lane embeddings of 4 over
    the centre's offset, the width, and whether the lane exists. In the encoder vehicles attend to vehicles (8 numbers
    per head) and to lanes (32 per head); both results together, 32 numbers, are the encoding. In the decoder vehicles
    attend to vehicles once more (8 per head). Its output gives the five numbers of a bivariate normal density per tick
    (`training.models.gaussians`). No layer knows which vehicle is the ego, or the order of the vehicles.

    What the publication leaves open, and the choices made here:

    * The weights of the loss, both 1: nats and metres are then of the same order.
    * The layers between positions and embedding, and between the decoder's output and positions: one hidden layer each.
    * Whether 0.7 is dropped or kept: dropped. On simulated recordings (4 heads, 2,000 steps of 128 scenes, two seeds)
      RMSE at 5 s is then 3.00 and 3.17 m as against 2.95 and 3.03 m with 0.7 kept, NLL 0.73 and 0.74 as against 0.70
      and 0.73 nats; constant velocity has 3.43 m. `dropout` = 0.3 is the other reading.

    Differences: positions are given as last position, velocity and deviations (`describe_vehicles`) unless `inputs` is
    `positions`; of all lanes only those at the ego unless `lanes` is `all`; and means are counted from every vehicle's
    own constant velocity, and an untrained network predicts it, unless `anchoring` is `none` (or one axis).

    Args:
        hidden: width of the hidden layers in the vehicle embedding and before the output; 0: none.
        dropout: probability of dropping a number of an attention's output in training.
        nll_weight: weight of the negative log likelihood (nats) in the loss.
        distance_weight: weight of the distance (m) in the loss.
        inputs: `deviations`, or `positions`, raw and in m.
        sizes: whether the vehicles' lengths and widths are given; otherwise they are 0, as where they are unknown.
        lanes: `adjacent` (those left of, under and right of the ego), `all` of the carriageway, or `none`.
        nearest: most vehicles around the ego in training; a prediction sees all that it is given.
        range_m: distance along the road from the ego at which vehicles are left out; 0: none is.
        ego_only: whether the loss covers the ego's positions alone.
    """

    def __init__(
        self,
        protocol: Protocol,
        *,
        heads: int,
        hidden: int = 128,
        dropout: float = 0.7,
        nll_weight: float = 1.0,
        distance_weight: float = 1.0,
        anchoring: str = "both",
        inputs: str = "deviations",
        sizes: bool = True,
        lanes: str = "adjacent",
        nearest: int = NEAREST,
        range_m: float = 0.0,
        ego_only: bool = False,
    ) -> None:
        super().__init__()
        check_choice("inputs", inputs, INPUTS)
        check_choice("lanes", lanes, LANES)
        if nearest > NEAREST:
            raise UsageError(
                f"parameter `nearest`: expected 0 to {NEAREST}, the most that a training reads, got {nearest}"
            )
        self.raw, self.sizes, self.lanes = inputs == "positions", sizes, lanes
        self.nearest, self.range_m, self.ego_only = nearest, range_m, ego_only
        self.rate_hz = protocol.rate_hz
        self.ticks = count_velocity_ticks(protocol)
        self.nll_weight, self.distance_weight = nll_weight, distance_weight
        ahead = torch.arange(1, protocol.horizon_ticks + 1, dtype=torch.float32)
        self.ahead: Tensor
        self.register_buffer("ahead", ahead, persistent=False)
        self.anchored: Tensor
        self.register_buffer("anchored", find_anchored(anchoring), persistent=False)
        encoded = 2 * VEHICLE_WIDTH
        common = partial(MultiHeadAttention, heads=heads, dropout=dropout)
        ticks = protocol.history_ticks
        self.embed_vehicle = perceptron(2 * ticks + 2 if self.raw else 3 * ticks + 6, hidden, VEHICLE_WIDTH)
        self.embed_lane = nn.Linear(3, LANE_WIDTH)
        self.vehicle_attention = common(VEHICLE_WIDTH, VEHICLE_WIDTH, head_width=VEHICLE_HEAD_WIDTH)
        self.lane_attention = common(VEHICLE_WIDTH, LANE_WIDTH, head_width=LANE_HEAD_WIDTH)
        self.decoder = common(encoded, encoded, head_width=VEHICLE_HEAD_WIDTH)
        self.out = perceptron(encoded, hidden, 5 * protocol.horizon_ticks)
        if anchoring != "none":
            for weights in self.out[-1].parameters():
                nn.init.zeros_(weights)

    def forward(self, observed: ObservedScene[Tensor]) -> Gaussian:
        """Return mean (B, V, F, 2) in m relative to the ego's last position, sigma (B, V, F, 2) in m, rho (B, V, F)."""
        decoded, _, vehicles = self._attend(observed)
        raw = torch.unflatten(self.out(decoded), -1, (len(self.ahead), 5))
        mean, sigma, rho = to_gaussian(raw.masked_fill(~self.limit(observed).vehicle_mask[..., None, None], 0.0))
        place_m, velocity = vehicles.place_m * self.anchored, vehicles.velocity * self.anchored
        return mean + place_m[..., None, :] + velocity[..., None, :] * self.ahead[:, None], sigma, rho

    def supervised(self, observed: ObservedScene[Tensor], truth: Truth[Tensor]) -> Tensor:
        """Return the known positions (B, V, F) of the vehicles that the training sees, or of the ego alone."""
        there: Tensor = self.limit(observed, 0 if self.ego_only else self.nearest).vehicle_mask
        return truth.future_mask & there[..., None]

    def loss(self, observed: ObservedScene[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () nll_weight x mean NLL + distance_weight x mean distance over all supervised positions."""
        check_phase(phase, "both")
        mean, sigma, rho = self(self.limit(observed, self.nearest))
        known = self.supervised(observed, truth)
        nll = gaussian_nll(mean, sigma, rho, truth.future, known)
        return self.nll_weight * nll + self.distance_weight * mean_distance(mean, truth.future, known)

    def predict_tensors(self, observed: ObservedScene[Tensor]) -> Prediction:
        """Return the ego's mean and density."""
        mean, sigma, rho = (part[:, 0] for part in self(observed))
        return to_prediction((mean, sigma, rho))

    def predict_vehicles(self, observed: ObservedScene[Any]) -> Prediction:
        """Predict all vehicles that `limit` leaves of scenes of NumPy arrays, scene by scene."""
        present = torch.from_numpy(self.limit(observed).vehicle_mask)
        mean, sigma, rho = (part.cpu()[present] for part in self.infer(observed, self))
        return to_prediction((mean, sigma, rho))

    def read_attention(self, observed: ObservedScene[Any]) -> Attention:
        """Return the attention weights for scenes of NumPy arrays."""
        _, weights, _ = self.infer(observed, self._attend)
        absent = ~np.asarray(self.limit(observed).vehicle_mask)[:, None, :, None]
        return Attention(*(np.where(absent, np.float32(0), to_numpy(part)) for part in weights))

    def limit(self, observed: ObservedScene[Any], nearest: int | None = None) -> ObservedScene[Any]:
        """Mark vehicles beyond the range, or all but the ego and the `nearest`, as absent."""
        present = observed.vehicle_mask
        if self.range_m > 0:
            present = present & (abs(observed.history[:, :, -1, 0]) < self.range_m)
        if nearest is not None and nearest + 1 < present.shape[1]:
            present = present.clone()
            present[:, nearest + 1 :] = False
        return replace(observed, vehicle_mask=present)

    def choose_lanes(self, observed: ObservedScene[Any]) -> Any:  # noqa: ANN401  (NumPy's arrays or torch's tensors)
        """Return (B, 3 or M, 3) offset, width and existence of the lanes that vehicles attend to."""
        if self.lanes == "none":
            return 0 * observed.lanes
        return observed.all_lanes if self.lanes == "all" else observed.lanes

    def _attend(self, observed: ObservedScene[Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], Vehicles]:
        """Return (B, V, 32), the weights of the vehicles, the lanes and the decoder, and the vehicles' features."""
        observed = self.limit(observed)
        if not self.sizes:
            observed = replace(observed, size_m=0 * observed.size_m)
        present, vehicles = observed.vehicle_mask, describe_vehicles(observed, self.ticks, self.rate_hz, raw=self.raw)
        lanes, exists = describe_lanes(self.choose_lanes(observed))
        embedded = self.embed_vehicle(vehicles.features)
        to_vehicles, vehicle_weights = self.vehicle_attention(embedded, embedded, present)
        to_lanes, lane_weights = self.lane_attention(embedded, self.embed_lane(lanes), exists)
        encoded = torch.cat([to_vehicles, to_lanes], dim=-1)
        decoded, decoder_weights = self.decoder(encoded, encoded, present)
        return decoded, (vehicle_weights, lane_weights, decoder_weights), vehicles


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return one hidden layer with ReLU and a linear layer; where `hidden` is 0, the linear layer alone."""
    first = (nn.Linear(inputs, hidden), nn.ReLU()) if hidden else ()
    return nn.Sequential(*first, nn.Linear(hidden or inputs, outputs))


def mean_distance(predicted: Tensor, future: Tensor, known: Tensor) -> Tensor:
    """Return () the mean distance in m, not squared, over known positions: (..., F, 2), (..., F, 2), (..., F)."""
    away = torch.where(known[..., None], predicted - future, 0.0)
    # At distance 0 the gradient of a square root is infinite; that of this norm is 0.
    distances: Tensor = torch.linalg.vector_norm(away, dim=-1)
    return distances.sum() / known.sum().clamp(min=1)


def describe_vehicles(observed: ObservedScene[Tensor], ticks: int, rate_hz: float, *, raw: bool = False) -> Vehicles:
    """Convert positions of H ticks to last position, velocity and the deviations from going straight on.

    A velocity is the displacement over the last `ticks` ticks, or over as many of them as are known; where none is, the
    mean velocity of the scene's others. `rate_hz` is in ticks a second. Masked values are ignored. `raw` features
    are the positions themselves (before a vehicle came its earliest one again) and the sizes.
    """
    present = observed.vehicle_mask
    known = observed.history_mask & present[..., None]  # (B, V, H)
    history = observed.history.masked_fill(~known[..., None], 0.0)
    place_m = history[..., -1, :]
    velocity = _find_velocities(history, known, ticks).masked_fill(~present[..., None], 0.0)
    size_m = observed.size_m.masked_fill(~present[..., None], 0.0)
    if raw:
        positions = observed.history.masked_fill(~present[..., None, None], 0.0)
        return Vehicles(torch.cat([positions.flatten(start_dim=2), size_m], dim=-1), place_m, velocity)

    back = torch.arange(1 - history.shape[2], 1, device=history.device, dtype=history.dtype)
    straight = place_m[..., None, :] + velocity[..., None, :] * back[:, None]  # (B, V, H, 2)
    deviation = (history - straight).masked_fill(~known[..., None], 0.0)
    features = torch.cat(
        [
            place_m / history.new_tensor(PLACE_SCALE_M),
            velocity * rate_hz / history.new_tensor(SPEED_SCALE_MPS),
            (deviation / history.new_tensor(DEVIATION_SCALE_M)).flatten(start_dim=2),
            known.to(history.dtype),
            size_m / history.new_tensor(SIZE_SCALE_M),
        ],
        dim=-1,
    )
    return Vehicles(features, place_m, velocity)


def _find_velocities(history: Tensor, known: Tensor, ticks: int) -> Tensor:
    """Return (B, V, 2) in m per tick, of histories (B, V, H, 2) and where they are known (B, V, H)."""
    steps = known[..., -1 - ticks : -1].sum(dim=-1)  # (B, V): known ticks are the last ones, without a gap
    begin = (history.shape[2] - 1 - steps)[..., None, None].expand(-1, -1, 1, 2)
    moved = history[..., -1, :] - history.gather(2, begin)[..., 0, :]
    has = (steps > 0)[..., None]
    own = moved / steps.clamp(min=1)[..., None]
    mean = (own * has).sum(dim=1, keepdim=True) / has.sum(dim=1, keepdim=True).clamp(min=1)
    return torch.where(has, own, mean)


def describe_lanes(lanes: Tensor) -> tuple[Tensor, Tensor]:
    """Return (B, M, 3) scaled offset, width and existence of M lanes, and (B, M) which exist."""
    exists = lanes[..., 2] > 0
    scale = lanes.new_tensor([LANE_SCALE_M, LANE_SCALE_M, 1.0])
    return (lanes / scale).masked_fill(~exists[..., None], 0.0), exists
