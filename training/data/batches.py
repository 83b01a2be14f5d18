"""Batches of samples and of whole scenes: names, shapes, units and order of their arrays."""

from collections.abc import Callable
from dataclasses import Field, dataclass, fields
from typing import Any, ClassVar, Self

Array = Any
"""A NumPy array or a torch tensor; those of one batch or call are all of the same kind."""


class Arrays:
    """Arrays of one kind that are found by their names, too: `batch["history"]`, `dict(batch)`.

    Every subclass is a dataclass.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def keys(self) -> list[str]:
        """Return the names of the arrays; not `absolute`, which is none."""
        return [own.name for own in fields(self) if own.name != "absolute"]

    def each(self, change: Callable[[Any], Any]) -> Self:
        """Return a copy with every array changed, for instance to a tensor on a device."""
        return type(self)(**{name: change(self[name]) for name in self.keys()})

    def select(self, which: Any) -> Self:  # noqa: ANN401  (positions, flags or a slice)
        """Select rows of every array."""
        return self.each(lambda array: array[which])

    def __getitem__(self, name: str) -> Array:
        """Return an array by its name."""
        return getattr(self, name)

    def __len__(self) -> int:
        """Return the number of rows: of samples or scenes, B."""
        return len(self[self.keys()[0]])


@dataclass(frozen=True)
class Batch(Arrays):
    """B samples with K neighbors of all of them together, over H ticks of history and F of future.

    Positions are in m, float32: `[..., 0]` along the direction of travel (x_m), `[..., 1]` across it, positive to the
    driver's right (y_m). They are relative to the sample's last known position (that at its own tick), or, where
    `absolute`, measured on the carriageway as in `tracks`.
    """

    sample: Array  # (B,) int64 numbers of the samples in the folder
    history: Array  # (B, H, 2) the sample's own positions; the last one is (0, 0), or `origin` where absolute
    future: Array  # (B, F, 2) at 1, 2, ... ticks; where masked, the last known future position again
    future_mask: Array  # (B, F) bool, True where the position is known
    # (K, H, 2) relative to the SAMPLE's last position; where masked (the track began later), the earliest known again
    neighbor_history: Array
    neighbor_mask: Array  # (K, H) bool, True where the position is known; the last one always is
    neighbor_sample: Array  # (K,) int64 position in the batch, 0 to B - 1, increasing
    neighbor_cell: Array  # (K,) int8 cell, 0 to 38, of the grid, increasing within a sample
    lateral: Array  # (B,) uint8 position in `schemas.columns.LATERAL_MANEUVERS`
    longitudinal: Array  # (B,) uint8 position in `LONGITUDINAL_MANEUVERS`
    origin: Array  # (B, 2) the sample's last position on the carriageway; makes relative positions absolute
    absolute: bool = False


@dataclass(frozen=True)
class SceneBatch(Arrays):
    """B whole scenes: the V vehicles of all of them, samples or not.

    Positions as in `Batch`, each vehicle's relative to its own last position; `origin` says where that is, so that the
    difference of two origins is the distance from one vehicle to the other.
    """

    scene: Array  # (B,) int64 numbers of the scenes in the folder
    vehicle_scene: Array  # (V,) position in the batch, 0 to B - 1, increasing
    vehicle_id: Array  # (V,) unique within the subset, increasing within a scene
    # (V,) int32 number of the sample that the vehicle is at this tick; -1 where it is none (its track is too short
    # before or after, for example): such vehicles are context and are not predicted
    sample: Array
    history: Array  # (V, H, 2) where masked (the track began later), the earliest known position again
    history_mask: Array  # (V, H) True where the position is known; the last one always is
    future: Array  # (V, F, 2) where masked, the last known position again
    future_mask: Array  # (V, F) True where the position is known
    lateral: Array  # (V,) as in `Batch`; -1 where the vehicle is no sample
    longitudinal: Array  # (V,) likewise
    origin: Array  # (V, 2) the vehicle's position on the carriageway
    speed_mps: Array  # (V,) recorded, along the direction of travel
    lane: Array  # (V,) 1 is the driver's leftmost; 0 = unknown
    lane_offset_m: Array  # (V,) from the lane's centre, positive to the right; NaN where no markings are known
    lane_width_m: Array  # (V,) NaN where no markings are known
    has_left: Array  # (V,) whether there is a lane to the left
    has_right: Array  # (V,) whether there is one to the right: `lane` is not the index's `last_lane`
    absolute: bool = False
