"""Checks of an opened tensor folder: kinds of the index's values, and arrays that agree with the index."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Integers
from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS, INDEX_KEYS, SUBSET_KEYS

AGAIN = "run `tracklake tensors` again"


class TensorError(TracklakeError):
    """A tensor folder is absent, unfinished or not what its index says."""


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)  # JSON's true and false are no numbers


def _is_number(value: object) -> bool:
    return _is_whole(value) or (isinstance(value, float) and math.isfinite(value))


def _are_numbers(value: object) -> TypeGuard[list[Any]]:
    return isinstance(value, list) and all(map(_is_number, value))


KINDS: dict[str, Callable[[Any], bool]] = {
    "text": lambda value: isinstance(value, str),
    "a whole number": _is_whole,
    "a number": _is_number,
    "two numbers": lambda value: _are_numbers(value) and len(value) == 2,
    "numbers or null": lambda value: value is None or _are_numbers(value),
    "an object": lambda value: isinstance(value, dict),
    "an object or null": lambda value: value is None or isinstance(value, dict),
    "objects": lambda value: isinstance(value, list) and all(isinstance(one, dict) for one in value),
    "counts by name": lambda value: (
        isinstance(value, dict) and all(_is_whole(count) and count >= 0 for count in value.values())
    ),
}
"""Test of each kind of value that `schemas.tensors` declares for keys."""


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
        if key in found and not KINDS[kind](found[key]):
            raise TensorError(f"{file}: `{where}{key}`: expected {kind}, got {str(found[key])[:60]}; {AGAIN}")


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
