"""Samples on tracks with findings, so that scores of clean samples can be given beside those of all."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags
from tracklake.schemas.columns import SEVERITIES
from tracklake.training.data.positions import check_numbers

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


def mark_flagged(folder: "TensorFolder", samples: npt.ArrayLike, severity: str) -> Flags:
    """Return (B,) whether the sample's own vehicle breaks a rule within its history or its known future.

    `finding` in `schemas.tensors.ARRAYS` says which frames a row stands for: the first row of a history also stands for
    the frames since the tick before it.

    Args:
        folder: tensors to read from.
        samples: (B,) numbers of samples, in any order.
        severity: one of `schemas.columns.SEVERITIES`; worse ones count as well.

    Raises:
        IndexError: a number is below 0 or not below S.
        ValueError: no such severity.
    """
    if severity not in SEVERITIES:
        raise ValueError(f"unknown severity `{severity}`: expected one of {', '.join(SEVERITIES)}")
    sample = check_numbers(samples, len(folder.sample_row), "sample")
    row = folder.sample_row[sample].astype(np.intp)
    first = row - (folder.protocol.history_ticks - 1)
    end = row + folder.sample_future[sample] + 1
    marked = (folder.finding > 0) & (folder.finding <= 1 + SEVERITIES.index(severity))
    before = np.zeros(len(marked) + 1, dtype=np.int32)
    np.cumsum(marked, out=before[1:])
    found: Flags = before[end] > before[first]
    return found
