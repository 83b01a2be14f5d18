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
    """The result of an export: numbers of samples and neighbors by part, names of the files, licences as notes.

    `synthetic` describes what is synthetic; None where all was recorded.
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
    """Samples as exported: a batch of B samples with K neighbors, the samples' facts (B,), and the neighbors' ids (K,).

    `subset` is the position in the index's `subsets`; the unknown lane is 0.
    """

    batch: Batch
    subset: npt.NDArray[np.int32]
    vehicle_id: npt.NDArray[np.int32]
    tick: npt.NDArray[np.int32]
    lane: npt.NDArray[np.int16]
    neighbor_id: npt.NDArray[np.int32]
