"""Exported windows, and the result of an export of them."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tracklake.training.data.batches import Batch

Format = Literal["parquet", "npz"]


@dataclass(frozen=True)
class WindowsExport:
    """The result of an export.

    Args:
        out: folder of the files.
        format: format of the files.
        absolute: whether positions are those on the carriageway.
        samples: number of samples by part.
        neighbors: number of neighbors by part.
        files: names of the files.
        notes: licences of the datasets.
        synthetic: description of what is synthetic; None where all was recorded.
    """

    out: Path
    format: Format
    absolute: bool
    samples: dict[str, int]
    neighbors: dict[str, int]
    files: tuple[str, ...]
    notes: tuple[str, ...]
    synthetic: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return asdict(self) | {"out": str(self.out)}


@dataclass(frozen=True)
class Windows:
    """Samples as exported: a batch, and the ids of its samples and neighbors.

    Args:
        batch: B samples with K neighbors.
        subset: (B,) position in the index's `subsets`.
        vehicle_id: (B,) vehicle of the sample.
        tick: (B,) tick of the sample.
        lane: (B,) lane at the tick; 0 = unknown.
        neighbor_id: (K,) vehicle_id of each neighbor.
    """

    batch: Batch
    subset: npt.NDArray[np.int32]
    vehicle_id: npt.NDArray[np.int32]
    tick: npt.NDArray[np.int32]
    lane: npt.NDArray[np.int16]
    neighbor_id: npt.NDArray[np.int32]
