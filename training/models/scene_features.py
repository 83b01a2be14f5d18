"""Inputs of attention networks: one row of numbers per vehicle, and one per lane."""

from dataclasses import dataclass

import torch
from torch import Tensor

from tracklake.training.data.observed import ObservedScene

PLACE_SCALE_M = (50.0, 5.0)
"""Divisors of last positions in m, along and across the road, so that inputs are of the order of 1."""
SPEED_SCALE_MPS = (15.0, 1.0)
"""Divisors of velocities in m/s, along and across the road."""
DEVIATION_SCALE_M = (5.0, 1.0)
"""Divisors of deviations from constant velocity in m, along and across the road."""
SIZE_SCALE_M = (5.0, 2.0)
"""Divisors of length and width in m."""
LANE_SCALE_M = 4.0
"""Divisor of a lane's offset and width in m."""


def count_features(history_ticks: int) -> int:
    """Return D, the numbers per vehicle: position 2, velocity 2, deviations 2 H, known or not H, size 2."""
    return 3 * history_ticks + 6


@dataclass(frozen=True)
class Vehicles:
    """Vehicles of B scenes as inputs of the network; all 0 where there is none.

    Args:
        features: (B, V, D) inputs of the network.
        place_m: (B, V, 2) last positions, relative to the ego's.
        velocity: (B, V, 2) m per tick.
    """

    features: Tensor
    place_m: Tensor
    velocity: Tensor


def describe_vehicles(observed: ObservedScene[Tensor], ticks: int, rate_hz: float) -> Vehicles:
    """Convert positions of H ticks to last position, velocity and deviations from it.

    Position, velocity and its changes differ by orders of magnitude (100 m, 5 m a tick, 0.1 m), and a layer on the
    plain positions would have to learn their differences first. Nothing is lost where history is
    known: position at tick -k = place - k velocity + deviation.

    A velocity is the displacement over the last `ticks` ticks, or over as many of them as are known. A vehicle of
    which only the last position is known is taken to go with its scene: the mean velocity of those that have one.

    Args:
        observed: the scenes; masked values are ignored.
        ticks: ticks of history that velocities are taken from.
        rate_hz: ticks a second.
    """
    present = observed.vehicle_mask
    known = observed.history_mask & present[..., None]  # (B, V, H)
    history = observed.history.masked_fill(~known[..., None], 0.0)
    place_m = history[..., -1, :]
    velocity = _find_velocities(history, known, ticks).masked_fill(~present[..., None], 0.0)

    back = torch.arange(1 - history.shape[2], 1, device=history.device, dtype=history.dtype)
    straight = place_m[..., None, :] + velocity[..., None, :] * back[:, None]  # (B, V, H, 2)
    deviation = (history - straight).masked_fill(~known[..., None], 0.0)
    features = torch.cat(
        [
            place_m / history.new_tensor(PLACE_SCALE_M),
            velocity * rate_hz / history.new_tensor(SPEED_SCALE_MPS),
            (deviation / history.new_tensor(DEVIATION_SCALE_M)).flatten(start_dim=2),
            known.to(history.dtype),
            observed.size_m.masked_fill(~present[..., None], 0.0) / history.new_tensor(SIZE_SCALE_M),
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


def describe_lanes(observed: ObservedScene[Tensor]) -> tuple[Tensor, Tensor]:
    """Return (B, 3, 3) scaled offset, width and existence of lanes, and (B, 3) which exist."""
    exists = observed.lanes[..., 2] > 0
    scale = observed.lanes.new_tensor([LANE_SCALE_M, LANE_SCALE_M, 1.0])
    return (observed.lanes / scale).masked_fill(~exists[..., None], 0.0), exists
