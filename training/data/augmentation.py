"""Training samples on a mirrored road, or at another place among their neighbors."""

from dataclasses import replace

import torch
from torch import Tensor

from tracklake.training.data.observed import COLUMNS, ROW_M, ROWS, Observed, ObservedScene, Truth

Samples = tuple[Observed[Tensor] | ObservedScene[Tensor], Truth[Tensor]]


def augment(
    observed: Observed[Tensor] | ObservedScene[Tensor], truth: Truth[Tensor], mirrored: Tensor, rows: Tensor
) -> Samples:
    """Mirror samples sideways and move them along the road among the other vehicles, which stay where they are.

    A mirrored road has left and right exchanged: lateral positions, columns of the grid, lanes, lateral maneuvers. The
    sample itself is at the origin wherever it stands, so that moving it by whole rows of the grid moves the others back
    by as many; neighbors beyond the grid are left out, and none comes into it. A sample's own history and future are
    those of its vehicle, as recorded.

    Args:
        observed: B samples.
        truth: their futures and maneuvers.
        mirrored: (B,) which are mirrored.
        rows: (B,) int64 rows of the grid by which each is moved ahead.
    """
    sign = 1 - 2 * mirrored.float()
    factors = torch.stack((torch.ones_like(sign), sign), -1)  # (B, 2)
    moved_m = torch.stack((rows.float() * ROW_M, torch.zeros_like(sign)), -1)  # (B, 2)
    lateral = torch.where(mirrored, (3 - truth.lateral) % 3, truth.lateral)  # keep, left, right: 0, 1, 2 become 0, 2, 1
    if isinstance(observed, Observed):
        future = truth.future * factors[:, None]
        return _augment_grid(observed, mirrored, rows, factors, moved_m), replace(truth, future=future, lateral=lateral)

    others = observed.vehicle_mask.float()
    others[:, 0] = 0.0
    back_m = (others[..., None] * moved_m[:, None])[:, :, None]  # (B, V, 1, 2)
    scene = replace(
        observed,
        history=observed.history * factors[:, None, None] - back_m,
        lanes=torch.where(mirrored[:, None, None], _mirror_lanes(observed.lanes[:, [2, 1, 0]]), observed.lanes),
        all_lanes=_reverse_lanes(observed.all_lanes, mirrored),
    )
    return scene, replace(truth, future=truth.future * factors[:, None, None] - back_m, lateral=lateral)


def _augment_grid(
    observed: Observed[Tensor], mirrored: Tensor, rows: Tensor, factors: Tensor, moved_m: Tensor
) -> Observed[Tensor]:
    """Return samples with a grid, with their neighbors by increasing cell again."""
    owner, cell = observed.neighbor_sample.long(), observed.neighbor_cell.long()
    column, row = cell // ROWS, cell % ROWS - rows[owner]
    column = torch.where(mirrored[owner], COLUMNS - 1 - column, column)
    inside = (row >= 0) & (row < ROWS)
    cell = ROWS * column + row
    last = ROWS * COLUMNS * len(rows)
    order = torch.argsort(torch.where(inside, ROWS * COLUMNS * owner + cell, last))[: int(inside.sum())]
    around = observed.neighbor_history * factors[owner][:, None] - moved_m[owner][:, None]
    return Observed(
        history=observed.history * factors[:, None],
        neighbor_history=around[order],
        neighbor_mask=observed.neighbor_mask[order],
        neighbor_sample=observed.neighbor_sample[order],
        neighbor_cell=cell[order].to(torch.int8),
    )


def _mirror_lanes(lanes: Tensor) -> Tensor:
    """Return lanes (B, M, 3) with their offsets to the other side."""
    return lanes * lanes.new_tensor([-1.0, 1.0, 1.0])


def _reverse_lanes(lanes: Tensor, mirrored: Tensor) -> Tensor:
    """Return lanes (B, M, 3), of which the first few of each row exist, from the other side where mirrored (B,)."""
    place = torch.arange(lanes.shape[1], device=lanes.device)[None]
    count = (lanes[..., 2] > 0).sum(1)[:, None]
    reverse = torch.where(mirrored[:, None] & (place < count), count - 1 - place, place)
    reversed_lanes = lanes[torch.arange(len(lanes), device=lanes.device)[:, None], reverse]
    return torch.where(mirrored[:, None, None], _mirror_lanes(reversed_lanes), reversed_lanes)
