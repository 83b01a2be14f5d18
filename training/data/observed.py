"""Samples as a model may see them, and the truth that it predicts, in separate types."""

from dataclasses import dataclass, fields
from typing import Any, Generic, Literal, NoReturn, TypeVar

from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.batches import Arrays, Batch

ROWS, COLUMNS, ROW_M = 13, 3, 4.572
"""Rows of the grid along the road, 0 hindmost; its columns: left, own and right lane; and the length of a row, in m."""
Reads = Literal["grid", "scene"]
"""Input of a model: `Observed` (grid) or `ObservedScene` (scene)."""
Array = TypeVar("Array")
"""NumPy arrays or torch tensors, of the same shapes, units and order."""


class FutureInputError(TracklakeError, AttributeError):
    """A model reads what is known only after the tick at which it predicts."""


class _Blind(Arrays):
    """Arrays known at the tick of prediction; reading any other is refused."""

    def __getattr__(self, name: str) -> NoReturn:
        """Refuse a name that is no array here, except for Python's own names."""
        if name.startswith("__"):
            raise AttributeError(name)
        known = ", ".join(self.keys())
        raise FutureInputError(
            f"`{name}` is not known when a model predicts: it sees {known}. Futures and maneuvers are for `loss` alone"
        )


@dataclass(frozen=True)
class Observed(_Blind, Generic[Array]):
    """B samples with K neighbors in their grids, over H ticks of history.

    Positions in m, relative to the sample's last one: along the direction of travel, and across, positive to the right.
    """

    history: Array  # (B, H, 2) the last one is (0, 0)
    neighbor_history: Array  # (K, H, 2) where masked, the earliest known position again
    neighbor_mask: Array  # (K, H) True where the position is known
    neighbor_sample: Array  # (K,) position in the batch, increasing
    neighbor_cell: Array  # (K,) cell 0 to 38 of the 13 x 3 grid, increasing within a sample


@dataclass(frozen=True)
class ObservedScene(_Blind, Generic[Array]):
    """B samples (egos), each with the V - 1 vehicles nearest to it in any lane, over H ticks of history.

    Positions in m, all of a scene relative to its ego's last one, axes as in `Observed`. Vehicle 0 is the ego; the
    others stand in order of distance; where there are fewer, rows are masked and hold zeros.

    `lanes` are those left of, under and right of the ego: the centre's offset from the ego's last position (m, positive
    to the right), the width (m), and 1 where the lane exists; all 0 where it does not. `all_lanes` are those of the
    whole carriageway, from the left; M is the most of any carriageway in the tensors. This is knowledge of the map:
    where no markings are known, the rightmost lane is the highest that any vehicle uses during the whole recording
    (`last_lane` of `schemas.tensors`), so that a lane may exist here because a vehicle uses it later.
    """

    history: Array  # (B, V, H, 2) where a tick is masked, the vehicle's earliest known position again
    history_mask: Array  # (B, V, H) True where the position is known; the last one is, of every vehicle that is there
    vehicle_mask: Array  # (B, V) True where there is a vehicle; the first always is
    size_m: Array  # (B, V, 2) length and width; 0 where unknown
    lanes: Array  # (B, 3, 3)
    all_lanes: Array  # (B, M, 3)


@dataclass(frozen=True)
class Truth(Arrays, Generic[Array]):
    """The true futures and maneuvers: for `loss` and for scores, never for a prediction."""

    future: Array  # (B, F, 2) in m, axes and origin as the history's; of scenes (B, V, F, 2)
    future_mask: Array  # (B, F) True where it is known; of scenes (B, V, F)
    lateral: Array  # (B,) position in `schemas.columns.LATERAL_MANEUVERS`
    longitudinal: Array  # (B,) position in `LONGITUDINAL_MANEUVERS`


def part_batch(batch: Batch) -> tuple[Observed[Any], Truth[Any]]:
    """Split a batch into what may be seen of it and the truth; nothing is copied; ValueError for an absolute batch."""
    if batch.absolute:
        raise ValueError("models see positions relative to the sample's last one: gather without `absolute`")
    return (
        Observed(**{own.name: batch[own.name] for own in fields(Observed)}),
        Truth(**{own.name: batch[own.name] for own in fields(Truth)}),
    )
