"""Which samples stand on tracks with findings: scores of clean samples can then be told from those of all."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tracklake.schemas.columns import SEVERITIES
from tracklake.training.data.batches import Flags
from tracklake.training.data.windows import check_numbers

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


def touched(folder: "TensorFolder", samples: npt.ArrayLike, severity: str) -> Flags:
    """(B,) whether the sample's own vehicle breaks a rule within its history or its known future.

    What a row of tensors counts as its frames, see `finding` in `schemas.tensors.ARRAYS`: the first row of a history
    also answers for the frames since the tick before it.

    Args:
        folder: where from.
        samples: (B,) numbers of samples, in any order.
        severity: of `schemas.columns.SEVERITIES`; worse ones count as well.

    Raises:
        IndexError: a number below 0, or not below S.
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
