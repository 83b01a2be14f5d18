"""Augmentation: the road mirrored sideways, and positions shifted along it.

`tracklake train` uses none of it: its networks learn the samples as recorded. In a training loop of one's own,
`training.data.torch_batches.BatchStream(folder, part, size, change=...)` calls a function of a batch for every batch
as it is read: one that returns `mirror(folder, batch, draw_mirrored(len(batch), random))`, for instance. (How it is to
draw where there are workers stands there.) The lane-change forest mirrors and shifts its own features
(`training.lane_changes`).
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.training.data.batches import Batch, Flags, Floats, SceneBatch
from tracklake.training.data.tensor_folder import TensorFolder

COLUMN = 13
"""Cells in a column of the grid; columns are left, own, right."""

_OTHER_SIDE = np.array([{"left": "right", "right": "left"}.get(name, name) for name in LATERAL_MANEUVERS])
SWAPPED = np.array([LATERAL_MANEUVERS.index(name) for name in _OTHER_SIDE], dtype=np.int8)
"""Each lateral maneuver's counterpart on the mirrored road."""


def draw_mirrored(count: int, random: np.random.Generator, share: float = 0.5) -> Flags:
    """(count,) which samples or scenes to mirror."""
    flags: Flags = random.random(count) < share
    return flags


def mirror(folder: TensorFolder, batch: Batch, mirrored: Flags) -> Batch:
    """Mirror samples about the carriageway's middle.

    Relative positions across the road change sign; those on the carriageway (`origin`, and all of an absolute batch)
    are measured from the other edge: width - y, with the index's `width_m`. Left and right maneuvers and the grid's
    outer columns are swapped. The neighbors of a mirrored sample are put in order by their new cells, so that cells
    increase within a sample as in any batch.

    Args:
        folder: the batch's.
        batch: as gathered; mirrored twice it is the same but for rounding.
        mirrored: (B,) which of its samples.
    """
    width = folder.lanes.width_m[folder.subset_of(batch.sample)]
    cell = np.where(mirrored[batch.neighbor_sample], _mirror_cells(batch.neighbor_cell), batch.neighbor_cell)
    order = np.lexsort((cell, batch.neighbor_sample))
    around = mirrored[batch.neighbor_sample]
    edge = width if batch.absolute else np.zeros_like(width)
    neighbor_history = _flip(batch.neighbor_history, around, edge[batch.neighbor_sample])
    lateral = np.where(mirrored, SWAPPED[batch.lateral], batch.lateral).astype(np.uint8)
    return replace(
        batch,
        history=_flip(batch.history, mirrored, edge),
        future=_flip(batch.future, mirrored, edge),
        neighbor_history=neighbor_history[order],
        neighbor_mask=batch.neighbor_mask[order],
        neighbor_cell=cell[order].astype(np.int8),
        lateral=lateral,
        origin=_flip(batch.origin[:, None], mirrored, width)[:, 0],
    )


def mirror_scenes(folder: TensorFolder, batch: SceneBatch, mirrored: Flags) -> SceneBatch:
    """Mirror whole scenes about the carriageway's middle.

    Positions and maneuvers as in `mirror`; lanes are counted from the other side, lane offsets change sign, and the
    lanes beside are swapped.

    Args:
        folder: the batch's.
        batch: as gathered; the order of vehicles stays.
        mirrored: (B,) which of its scenes.
    """
    which = mirrored[batch.vehicle_scene]
    subset = folder.run_subset[folder.runs_of(folder.scene_row[folder.scene_offset[batch.scene]])][batch.vehicle_scene]
    width, last = folder.lanes.width_m[subset], folder.lanes.last[subset]
    edge = width if batch.absolute else np.zeros_like(width)
    swapped = np.where(batch.lateral < 0, batch.lateral, SWAPPED[batch.lateral])
    return replace(
        batch,
        history=_flip(batch.history, which, edge),
        future=_flip(batch.future, which, edge),
        origin=_flip(batch.origin[:, None], which, width)[:, 0],
        lateral=np.where(which, swapped, batch.lateral).astype(np.int8),
        lane=np.where(which & (batch.lane > 0), last + 1 - batch.lane, batch.lane).astype(np.int16),
        lane_offset_m=np.where(which, -batch.lane_offset_m, batch.lane_offset_m),
        has_left=np.where(which, batch.has_right, batch.has_left),
        has_right=np.where(which, batch.has_left, batch.has_right),
    )


def shift(batch: Batch, shift_m: Floats) -> Batch:
    """Move samples and all around them along the road; scenes: `shift_scenes`.

    Relative positions do not change; `origin` does, and so do all positions of an absolute batch.

    Args:
        batch: as gathered.
        shift_m: (B,) how far, m; positive in the direction of travel.
    """
    moved = _move(shift_m)
    shifted = replace(batch, origin=batch.origin + moved[:, 0])
    if not batch.absolute:
        return shifted
    return replace(
        shifted,
        history=batch.history + moved,
        future=batch.future + moved,
        neighbor_history=batch.neighbor_history + moved[batch.neighbor_sample],
    )


def shift_scenes(batch: SceneBatch, shift_m: Floats) -> SceneBatch:
    """Move whole scenes along the road, each with all its vehicles; positions as in `shift`.

    Args:
        batch: as gathered.
        shift_m: (B,) how far, m; positive in the direction of travel.
    """
    moved = _move(shift_m)[batch.vehicle_scene]
    shifted = replace(batch, origin=batch.origin + moved[:, 0])
    if not batch.absolute:
        return shifted
    return replace(shifted, history=batch.history + moved, future=batch.future + moved)


def _move(shift_m: Floats) -> Floats:
    """(B, 1, 2) what is added to positions."""
    moved = np.zeros((len(shift_m), 1, 2), dtype=np.float32)
    moved[:, 0, 0] = shift_m
    return moved


def _mirror_cells(cell: npt.NDArray[np.int8]) -> npt.NDArray[np.int8]:
    """The same row in the column of the other side."""
    column, row = np.divmod(cell, np.int8(COLUMN))
    mirrored: npt.NDArray[np.int8] = (2 - column) * np.int8(COLUMN) + row
    return mirrored


def _flip(positions: Floats, which: Flags, edge_m: npt.NDArray[np.float64]) -> Floats:
    """A copy of positions (M, T, 2) with y = edge - y where chosen (M,)."""
    flipped = positions.copy()
    flipped[which, :, 1] = edge_m[which, None] - positions[which, :, 1]
    return flipped
