"""Checks of an opened tensor folder: kinds of the index's values, and arrays that agree with the index."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import FiniteFloat, NonNegativeInt, TypeAdapter, ValidationError, conlist

from tracklake.schemas.arrays import Integers
from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS, INDEX_KEYS, SUBSET_KEYS

AGAIN = "run `tracklake tensors` again"


class TensorError(TracklakeError):
    """A tensor folder is absent, unfinished or not what its index says."""


KINDS: dict[str, TypeAdapter[Any]] = {
    "text": TypeAdapter(str),
    "a whole number": TypeAdapter(int),
    "a number": TypeAdapter(FiniteFloat),
    "two numbers": TypeAdapter(conlist(FiniteFloat, min_length=2, max_length=2)),
    "numbers or null": TypeAdapter(list[FiniteFloat] | None),
    "an object": TypeAdapter(dict[str, Any]),
    "an object or null": TypeAdapter(dict[str, Any] | None),
    "objects": TypeAdapter(list[dict[str, Any]]),
    "counts by name": TypeAdapter(dict[str, NonNegativeInt]),
}
"""Type of each kind of value that `schemas.tensors` declares for keys; checked strictly, as true is no number."""


def check_index(file: Path, index: Mapping[str, Any]) -> None:
    """Refuse an index that lacks a key, or whose values are not of the kinds declared.

    Raises:
        TensorError: names the first such value, or the missing keys.
    """
    _check_kinds(file, "", index, INDEX_KEYS)
    subsets = index.get("subsets", [])
    for number, subset in enumerate(subsets):
        _check_kinds(file, f"subsets[{number}].", subset, SUBSET_KEYS)
    letters = dict.fromkeys(axis[0] for array in ARRAYS for axis in array.shape if axis[0].isalpha())
    missing = [key for key in INDEX_KEYS if key not in index]
    missing += [f"subsets: {key}" for subset in subsets for key in SUBSET_KEYS if key not in subset]
    missing += [f"sizes: {letter}" for letter in letters if letter not in index.get("sizes", letters)]
    missing += [f"samples_by_part: {part}" for part in PARTS if part not in index.get("samples_by_part", PARTS)]
    if missing:
        raise TensorError(f"{file}: lacks {', '.join(missing[:5])}; {AGAIN}")


def _check_kinds(file: Path, where: str, found: Mapping[str, Any], kinds: Mapping[str, str]) -> None:
    for key, kind in kinds.items():
        try:
            if key in found:
                KINDS[kind].validate_python(found[key], strict=True)
        except ValidationError:
            got = str(found[key])[:60]
            raise TensorError(f"{file}: `{where}{key}`: expected {kind}, got {got}; {AGAIN}") from None


def check_arrays(path: Path, index: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Refuse arrays that do not agree with each other or with the index, and would give wrong values.

    Only arrays by run, sample and scene are read, once each: a few ms for a million samples.

    Raises:
        TensorError: offsets do not begin at 0, fall, or do not end where what they count ends; a run is of a subset
            that the index does not name; or the parts' samples are not those that the index counts.
    """
    for array in ARRAYS:
        if array.shape[0].endswith("+1"):
            _check_offsets(f"{path}: array `{array.name}`", arrays[array.name], index["sizes"][array.counts])
    subset, last = arrays["run_subset"], len(index["subsets"]) - 1
    if len(subset) and (subset.min() < 0 or subset.max() > last):
        raise TensorError(
            f"{path}: array `run_subset`: expected 0 to {last}, the index's subsets, got {subset.min()} to "
            f"{subset.max()}; {AGAIN}"
        )
    part = arrays["sample_part"]
    for number, name in enumerate(PARTS):
        expected, got = index["samples_by_part"][name], np.count_nonzero(part == number)
        if got != expected:
            raise TensorError(
                f"{path}: array `sample_part`: expected {expected:,} samples of {name}, as the index counts, got "
                f"{got:,}; {AGAIN}"
            )
    others = len(part) - sum(index["samples_by_part"][name] for name in PARTS)
    if others:
        raise TensorError(
            f"{path}: array `sample_part`: expected 0 to {len(PARTS) - 1}, got {part.max()} ({others:,} samples of no "
            f"part); {AGAIN}"
        )


def _check_offsets(what: str, offset: Integers, end: int) -> None:
    if (offset[0], offset[-1]) != (0, end):
        raise TensorError(f"{what}: expected offsets from 0 to {end}, got {offset[0]} to {offset[-1]}; {AGAIN}")
    falls = offset[1:] < offset[:-1]
    if falls.any():
        at = int(falls.argmax())
        raise TensorError(
            f"{what}: expected offsets that never fall, got {offset[at + 1]} after {offset[at]} at {at + 1}; {AGAIN}"
        )
