"""Batches: what a model is given. Shapes, units and order of every array."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Batch:
    """Samples as arrays. B samples, K neighbors of all of them together, H ticks of history, F of future.

    Positions are in m, float32: `[..., 0]` along the direction of travel (x_m), `[..., 1]` across it, positive to the
    driver's right (y_m). They are relative to the sample's last known position (that at its own tick), or, where
    `absolute`, measured on the carriageway as in `tracks`.

    Args:
        sample: (B,) which samples of the folder these are.
        history: (B, H, 2) the sample's own positions; the last one is (0, 0), or `origin` where absolute.
        future: (B, F, 2) its positions at 1, 2, ... ticks; where masked, its last known future position again.
        future_mask: (B, F) True where the position is known.
        neighbor_history: (K, H, 2) relative to the SAMPLE's last position; where masked (the neighbor's track began
            later), its earliest known position again.
        neighbor_mask: (K, H) True where the position is known; the last one always is.
        neighbor_sample: (K,) position in the batch, 0 to B - 1, increasing.
        neighbor_cell: (K,) cell 0 to 38 of the grid, increasing within a sample.
        lateral: (B,) the maneuver's position in `schemas.columns.LATERAL_MANEUVERS`.
        longitudinal: (B,) likewise in `LONGITUDINAL_MANEUVERS`.
        origin: (B, 2) the sample's last position on the carriageway; adding it makes relative positions absolute.
        absolute: whether they are.
    """

    sample: Integers
    history: Floats
    future: Floats
    future_mask: Flags
    neighbor_history: Floats
    neighbor_mask: Flags
    neighbor_sample: Integers
    neighbor_cell: npt.NDArray[np.int8]
    lateral: Bytes
    longitudinal: Bytes
    origin: Floats
    absolute: bool = False

    def __len__(self) -> int:
        """B."""
        return len(self.sample)


@dataclass(frozen=True)
class SceneBatch:
    """Whole scenes as arrays: every vehicle of each moment, sample or not. B scenes, V vehicles of all of them.

    Positions as in `Batch`, each vehicle's relative to its own last position; `origin` says where that is, so that the
    difference of two origins is the way from one vehicle to the other.

    Args:
        scene: (B,) which scenes of the folder these are.
        vehicle_scene: (V,) position in the batch, 0 to B - 1, increasing.
        vehicle_id: (V,) unique within the subset, increasing within a scene.
        sample: (V,) number of the sample that the vehicle is at this moment; -1 where it is none (too short a track
            before or after, for example): such vehicles are context, and not to be predicted.
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

    scene: Integers
    vehicle_scene: Integers
    vehicle_id: npt.NDArray[np.int32]
    sample: npt.NDArray[np.int32]
    history: Floats
    history_mask: Flags
    future: Floats
    future_mask: Flags
    lateral: npt.NDArray[np.int8]
    longitudinal: npt.NDArray[np.int8]
    origin: Floats
    speed_mps: Floats
    lane: npt.NDArray[np.int16]
    lane_offset_m: Floats
    lane_width_m: Floats
    has_left: Flags
    has_right: Flags
    absolute: bool = False

    def __len__(self) -> int:
        """B."""
        return len(self.scene)
