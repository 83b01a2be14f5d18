"""Arrays of a tensor folder, mapped and checked against their declaration and the index.

Whatever is absent, unreadable, cut short or not as declared raises TensorError.
"""

import errno
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import MORE_FILES, FileAccessError
from tracklake.schemas.tensor_index import TensorError
from tracklake.schemas.tensors import ARRAYS


def map_arrays(path: Path, index: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Map every array of ARRAYS read-only, and check it against its declaration and the index."""
    arrays = {}
    for array in ARRAYS:
        file = path / array.file
        dtype, shape = np.dtype(array.stored_as(index["storage"])), array.sizes(index["sizes"])
        try:
            mapped = np.lib.format.open_memmap(file, mode="r")
        except Exception as broken:
            if isinstance(broken, OSError) and broken.errno == errno.EMFILE:
                raise FileAccessError(f"{file}: {broken.strerror}. {MORE_FILES}") from broken
            raise TensorError.at(file, f"cannot be read ({broken})") from broken
        if (mapped.dtype, mapped.shape) != (dtype, shape):
            raise TensorError.at(file, f"expected {dtype} of shape {shape}, got {mapped.dtype} of shape {mapped.shape}")
        size, wanted = file.stat().st_size, mapped.offset + mapped.nbytes
        if size != wanted:
            raise TensorError.at(file, f"expected {wanted:,} bytes, got {size:,}")
        arrays[array.name] = mapped.view(np.ndarray)  # indexing np.memmap itself runs Python code for every result
    _check_values(path, index, arrays)
    return arrays


def _check_values(path: Path, index: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Refuse offsets, subsets and parts that do not agree with the index, and would give wrong values.

    Only arrays by run, sample and scene are read, once each: a few ms for a million samples.
    """
    for array in ARRAYS:
        if not array.shape[0].endswith("+1"):
            continue
        what, offset, end = f"{path}: array `{array.name}`", arrays[array.name], index["sizes"][array.counts]
        if (offset[0], offset[-1]) != (0, end):
            raise TensorError.at(what, f"expected offsets from 0 to {end}, got {offset[0]} to {offset[-1]}")
        falls = offset[1:] < offset[:-1]
        if falls.any():
            at = int(falls.argmax())
            falling = f"{offset[at + 1]} after {offset[at]} at {at + 1}"
            raise TensorError.at(what, f"expected offsets that never fall, got {falling}")
    subset, last = arrays["run_subset"], len(index["subsets"]) - 1
    if len(subset) and (subset.min() < 0 or subset.max() > last):
        found = f"{subset.min()} to {subset.max()}"
        raise TensorError.at(path, f"array `run_subset`: expected 0 to {last}, the index's subsets, got {found}")
    part, what = arrays["sample_part"], f"{path}: array `sample_part`"
    for number, name in enumerate(PARTS):
        expected, got = index["samples_by_part"][name], np.count_nonzero(part == number)
        if got != expected:
            raise TensorError.at(what, f"expected {expected:,} samples of {name}, as the index counts, got {got:,}")
    others = np.count_nonzero(part >= len(PARTS))
    if others:
        raise TensorError.at(what, f"expected 0 to {len(PARTS) - 1}, got {part.max()} ({others:,} samples of no part)")
