"""Training samples on a mirrored road, or at another place among their neighbors, as NumPy arrays or torch tensors."""

from dataclasses import replace
from typing import Any

from tracklake.training.data.batches import Array
from tracklake.training.data.gathers import cast, count_from, find_namespace
from tracklake.training.data.observed import COLUMNS, ROW_M, ROWS, Observed, ObservedScene, Truth

Samples = tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]


def augment(observed: Observed[Any] | ObservedScene[Any], truth: Truth[Any], mirrored: Array, rows: Array) -> Samples:
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
    xp = find_namespace(rows)
    sign = cast(1 - 2 * cast(mirrored, "int64"), "float32")
    factors = xp.stack((xp.ones_like(sign), sign), -1)  # (B, 2)
    moved_m = xp.stack((cast(rows, "float32") * ROW_M, xp.zeros_like(sign)), -1)  # (B, 2)
    # keep, left, right: 0, 1, 2 become 0, 2, 1
    lateral = xp.where(mirrored, cast((3 - cast(truth.lateral, "int64")) % 3, "uint8"), truth.lateral)
    if isinstance(observed, Observed):
        future = truth.future * factors[:, None]
        return _augment_grid(observed, mirrored, rows, factors, moved_m), replace(truth, future=future, lateral=lateral)

    others = cast(observed.vehicle_mask, "float32")
    others[:, 0] = 0.0
    back_m = (others[..., None] * moved_m[:, None])[:, :, None]  # (B, V, 1, 2)
    scene = replace(
        observed,
        history=observed.history * factors[:, None, None] - back_m,
        lanes=xp.where(mirrored[:, None, None], _mirror_lanes(observed.lanes[:, [2, 1, 0]]), observed.lanes),
        all_lanes=_reverse_lanes(observed.all_lanes, mirrored),
    )
    return scene, replace(truth, future=truth.future * factors[:, None, None] - back_m, lateral=lateral)


def _augment_grid(
    observed: Observed[Any], mirrored: Array, rows: Array, factors: Array, moved_m: Array
) -> Observed[Any]:
    """Return samples with a grid, with their neighbors by increasing cell again."""
    xp, owner = find_namespace(rows), cast(observed.neighbor_sample, "int64")
    cell = cast(observed.neighbor_cell, "int64")
    column, row = cell // ROWS, cell % ROWS - rows[owner]
    column = xp.where(mirrored[owner], COLUMNS - 1 - column, column)
    inside = (row >= 0) & (row < ROWS)
    cell = ROWS * column + row
    last = ROWS * COLUMNS * len(rows)
    order = xp.argsort(xp.where(inside, ROWS * COLUMNS * owner + cell, last))[: int(inside.sum())]
    around = observed.neighbor_history * factors[owner][:, None] - moved_m[owner][:, None]
    return Observed(
        history=observed.history * factors[:, None],
        neighbor_history=around[order],
        neighbor_mask=observed.neighbor_mask[order],
        neighbor_sample=observed.neighbor_sample[order],
        neighbor_cell=cast(cell[order], "int8"),
    )


def _mirror_lanes(lanes: Array) -> Array:
    """Return lanes (B, M, 3) with their offsets to the other side."""
    return find_namespace(lanes).stack((-lanes[..., 0], lanes[..., 1], lanes[..., 2]), -1)


def _reverse_lanes(lanes: Array, mirrored: Array) -> Array:
    """Return lanes (B, M, 3), of which the first few of each row exist, from the other side where mirrored (B,)."""
    xp = find_namespace(lanes)
    place = count_from(0, lanes.shape[1], mirrored)[None]
    count = (lanes[..., 2] > 0).sum(1)[:, None]
    reverse = xp.where(mirrored[:, None] & (place < count), count - 1 - place, place)
    reversed_lanes = lanes[count_from(0, len(lanes), mirrored)[:, None], reverse]
    return xp.where(mirrored[:, None, None], _mirror_lanes(reversed_lanes), reversed_lanes)
