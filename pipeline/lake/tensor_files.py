"""Tensor folders on disk: a .npy file for each array, and `index.json`, written subset by subset."""

import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tensors.arrays import Arrays, SubsetTensors, count_sizes, join_after
from tracklake.pipeline.transforms.tensors.index import describe_subset, describe_tensors
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, INDEX_FILE, Array


def write_tensors(
    folder: Path,
    subsets: Iterable[tuple[Mapping[str, Any], Iterable[SubsetTensors]]],
    splits: pl.DataFrame,
    protocol: Protocol,
    *,
    storage: str,
    split_recipe: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write a tensor folder and return its index; no more than one part of a subset is held in memory.

    The folder is empty; the lake makes it visible afterwards. `subsets` are facts (dataset, subset, origin,
    frame_rate_hz, lane_markings_m) and tensors of each, in one part or several, in the split's order; `split_recipe`
    has digest, parameters, left_out_vehicles.

    Raises:
        ValueError: an array is missing, not of the declared dtype or shape, or there are too many rows.
    """
    sizes = dict.fromkeys(("N", "R", "S", "K", "C", "M"), 0)
    described: list[dict[str, Any]] = []
    by_part = np.zeros(len(PARTS), dtype=np.int64)
    worst, squares = np.zeros(2), np.zeros(2)
    with ExitStack() as opened:
        files = {array.name: opened.enter_context((folder / array.file).open("wb")) for array in ARRAYS}
        for array in ARRAYS:
            _write_header(files[array.name], array, storage, sizes)
        for facts, parts in subsets:
            earlier: dict[str, int] | None = None
            for tensors in parts:
                _check_arrays(tensors.arrays, storage, f"{facts['dataset']}/{facts['subset']}")
                for name, values in join_after(tensors.arrays, sizes, len(described), earlier).items():
                    values.tofile(files[name])
                own = count_sizes(tensors.arrays)
                earlier = {letter: count + (earlier or {}).get(letter, 0) for letter, count in own.items()}
                by_part += np.bincount(tensors.arrays["sample_part"], minlength=len(PARTS))
            sizes = {letter: count + (earlier or {})[letter] for letter, count in sizes.items()}
            worst = np.maximum(worst, tensors.max_error_m)
            squares += tensors.squared_error_m2
            described.append(describe_subset(facts, tensors))
        for array in ARRAYS:
            if not described and array.shape[0].endswith("+1"):
                files[array.name].write(bytes(8))  # the one offset of no groups
            _write_header(files[array.name], array, storage, sizes)
    index = describe_tensors(
        described,
        splits,
        protocol,
        storage=storage,
        sizes=sizes,
        samples_by_part=by_part.tolist(),
        max_error_m=worst.tolist(),
        squared_error_m2=squares.tolist(),
        split_recipe=split_recipe,
    )
    (folder / INDEX_FILE).write_text(json.dumps(index, indent=1, allow_nan=False), encoding="utf-8")
    return index


def _write_header(file: BinaryIO, array: Array, storage: str, sizes: Mapping[str, int]) -> None:
    """Write an array's header at the file's begin; it is as long for any number of rows, so that it can be replaced."""
    file.seek(0)
    descr = np.lib.format.dtype_to_descr(np.dtype(array.stored_as(storage)))
    header = {"descr": descr, "fortran_order": False, "shape": array.sizes(dict(sizes))}
    np.lib.format.write_array_header_1_0(file, header)


def _check_arrays(arrays: Arrays, storage: str, where: str) -> None:
    """Refuse arrays that are not as declared."""
    missing = [array.name for array in ARRAYS if array.name not in arrays]
    if missing:
        raise ValueError(f"{where}: array `{missing[0]}` is missing")
    letters = count_sizes(arrays)
    for array in ARRAYS:
        found = arrays[array.name]
        expected = (np.dtype(array.stored_as(storage)), array.sizes(letters))
        if (found.dtype, found.shape) != expected:
            raise ValueError(
                f"{where}: array `{array.name}`: expected {expected[0]} of shape {expected[1]}, got {found.dtype} of "
                f"shape {found.shape}"
            )
