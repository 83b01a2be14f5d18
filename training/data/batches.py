"""Batches of samples and of whole scenes: names, shapes, units and order of their arrays, and how they are gathered."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Integers
from tracklake.training.data.positions import (
    Array,
    Folder,
    cast,
    expand_groups,
    find_runs,
    locate_rows,
    read_future,
    read_history,
    to_absolute,
    to_relative,
)

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


@dataclass(frozen=True)
class Batch:
    """B samples with K neighbors of all of them together, over H ticks of history and F of future.

    Positions are in m, float32: `[..., 0]` along the direction of travel (x_m), `[..., 1]` across it, positive to the
    driver's right (y_m). They are relative to the sample's last known position (that at its own tick), or, where
    `absolute`, measured on the carriageway as in `tracks`.

    Args:
        sample: (B,) int64 numbers of the samples in the folder.
        history: (B, H, 2) the sample's own positions; the last one is (0, 0), or `origin` where absolute.
        future: (B, F, 2) its positions at 1, 2, ... ticks; where masked, its last known future position again.
        future_mask: (B, F) bool, True where the position is known.
        neighbor_history: (K, H, 2) relative to the SAMPLE's last position; where masked (the neighbor's track began
            later), its earliest known position again.
        neighbor_mask: (K, H) bool, True where the position is known; the last one always is.
        neighbor_sample: (K,) int64 position in the batch, 0 to B - 1, increasing.
        neighbor_cell: (K,) int8 cell, 0 to 38, of the grid, increasing within a sample.
        lateral: (B,) uint8 position in `schemas.columns.LATERAL_MANEUVERS`.
        longitudinal: (B,) uint8 position in `LONGITUDINAL_MANEUVERS`.
        origin: (B, 2) the sample's last position on the carriageway; adding it makes relative positions absolute.
        absolute: whether positions are measured on the carriageway.
    """

    sample: Array
    history: Array
    future: Array
    future_mask: Array
    neighbor_history: Array
    neighbor_mask: Array
    neighbor_sample: Array
    neighbor_cell: Array
    lateral: Array
    longitudinal: Array
    origin: Array
    absolute: bool = False

    def __len__(self) -> int:
        """Return the number of samples, B."""
        return len(self.sample)


@dataclass(frozen=True)
class SceneBatch:
    """B whole scenes: the V vehicles of all of them, samples or not.

    Positions as in `Batch`, each vehicle's relative to its own last position; `origin` says where that is, so that the
    difference of two origins is the distance from one vehicle to the other.

    Args:
        scene: (B,) int64 numbers of the scenes in the folder.
        vehicle_scene: (V,) position in the batch, 0 to B - 1, increasing.
        vehicle_id: (V,) unique within the subset, increasing within a scene.
        sample: (V,) int32 number of the sample that the vehicle is at this tick; -1 where it is none (its track is too
            short before or after, for example): such vehicles are context and are not predicted.
        history: (V, H, 2) where masked (the track began later), the earliest known position again.
        history_mask: (V, H) True where the position is known; the last one always is.
        future: (V, F, 2) where masked, the last known position again.
        future_mask: (V, F) True where the position is known.
        lateral: (V,) as in `Batch`; -1 where the vehicle is no sample.
        longitudinal: (V,) likewise.
        origin: (V, 2) the vehicle's position on the carriageway.
        speed_mps: (V,) recorded, along the direction of travel.
        lane: (V,) 1 is the driver's leftmost; 0 = unknown.
        lane_offset_m: (V,) from the lane's centre, positive to the right; NaN where no markings are known.
        lane_width_m: (V,) NaN where no markings are known.
        has_left: (V,) whether there is a lane to the left.
        has_right: (V,) whether there is one to the right: `lane` is not the index's `last_lane`.
        absolute: whether positions are measured on the carriageway.
    """

    scene: Array
    vehicle_scene: Array
    vehicle_id: Array
    sample: Array
    history: Array
    history_mask: Array
    future: Array
    future_mask: Array
    lateral: Array
    longitudinal: Array
    origin: Array
    speed_mps: Array
    lane: Array
    lane_offset_m: Array
    lane_width_m: Array
    has_left: Array
    has_right: Array
    absolute: bool = False

    def __len__(self) -> int:
        """Return the number of scenes, B."""
        return len(self.scene)


def gather_samples(folder: Folder, sample: Array, *, absolute: bool = False) -> Batch:
    """Read samples by their numbers (B,) int64, in any order; the arrays are of the folder's kind and device."""
    row = cast(folder.sample_row[sample], "int64")
    pair, owner = expand_groups(folder.neighbor_offset, sample)
    neighbor_row = cast(folder.neighbor_row[pair], "int64")
    history, _ = read_history(folder, row, row + 1 - folder.protocol.history_ticks)  # complete by definition
    future, future_mask = read_future(folder, row, row + cast(folder.sample_future[sample], "int64"))
    neighbor_first = neighbor_row + 1 - cast(folder.neighbor_known[pair], "int64")
    neighbor_history, neighbor_mask = read_history(folder, neighbor_row, neighbor_first)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
        neighbor_history = to_absolute(folder, neighbor_history, neighbor_row)
    else:
        origin = folder.position_m[row]
        history, future = to_relative(folder, history, origin), to_relative(folder, future, origin)
        neighbor_history = to_relative(folder, neighbor_history, origin[owner])
    return Batch(
        sample=sample,
        history=history,
        future=future,
        future_mask=future_mask,
        neighbor_history=neighbor_history,
        neighbor_mask=neighbor_mask,
        neighbor_sample=owner,
        neighbor_cell=folder.neighbor_cell[pair],
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
        origin=locate_rows(folder, row),
        absolute=absolute,
    )


def gather_scenes(folder: "TensorFolder", scene: Integers, *, absolute: bool = False) -> SceneBatch:
    """Read scenes by their numbers (B,), in any order."""
    member, vehicle_scene = expand_groups(folder.scene_offset, scene)
    row, sample = folder.scene_row[member].astype(np.int64), folder.scene_sample[member]
    run = find_runs(folder, row)
    history, history_mask = read_history(folder, row, folder.run_first_row[run])
    future, future_mask = read_future(folder, row, folder.run_first_row[run + 1] - 1)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
    else:
        stored = folder.position_m[row]
        history, future = to_relative(folder, history, stored), to_relative(folder, future, stored)
    origin, subset = locate_rows(folder, row), folder.run_subset[run]
    lane, lanes = folder.lane[row], folder.lanes
    known_lane = np.clip(lane, 0, lanes.centre_m.shape[1] - 1)
    return SceneBatch(
        scene=scene,
        vehicle_scene=vehicle_scene,
        vehicle_id=folder.run_vehicle_id[run],
        sample=sample,
        history=history,
        history_mask=history_mask,
        future=future,
        future_mask=future_mask,
        lateral=_read_maneuvers(folder.sample_lateral, sample),
        longitudinal=_read_maneuvers(folder.sample_longitudinal, sample),
        origin=origin,
        speed_mps=folder.speed_mps[row],
        lane=lane,
        lane_offset_m=(origin[:, 1] - lanes.centre_m[subset, known_lane]).astype(np.float32),
        lane_width_m=lanes.lane_width_m[subset, known_lane].astype(np.float32),
        has_left=lane > 1,
        has_right=(lane > 0) & (lane < lanes.last[subset]),
        absolute=absolute,
    )


def _read_maneuvers(values: Bytes, sample: npt.NDArray[np.int32]) -> npt.NDArray[np.int8]:
    """Return (V,) the maneuvers of vehicles that are samples, -1 for the others."""
    found = np.full(len(sample), -1, dtype=np.int8)
    found[sample >= 0] = values[sample[sample >= 0]]
    return found
