"""Tensor folders on disk: `arrays.safetensors` and `index.json`, written subset by subset."""

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tensors.arrays import Arrays, SubsetTensors, count_sizes, join_after
from tracklake.pipeline.transforms.tensors.index import describe_subset, describe_tensors
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, ARRAYS_FILE, INDEX_FILE, SAFETENSORS_DTYPES


def write_tensors(
    folder: Path,
    subsets: Iterable[tuple[Mapping[str, Any], SubsetTensors]],
    splits: pl.DataFrame,
    protocol: Protocol,
    *,
    storage: str,
    split_recipe: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write a tensor folder; no more than one subset is held in memory at a time.

    Args:
        folder: exists and is empty; the lake makes it visible, whole, afterwards.
        subsets: facts (dataset, subset, frame_rate_hz, lane_markings_m) and tensors of each, in the split's order.
        splits: the split's rows of `schemas.splits.SPLITS`.
        protocol: of the samples.
        storage: of positions, one of `schemas.tensors.POSITION_STORAGES`, as `subsets` were built.
        split_recipe: what the split is made by: digest, parameters, left_out_vehicles; None: not known.

    Returns:
        What `index.json` holds.

    Raises:
        ValueError: an array is missing, not of the declared dtype or shape, or there are too many rows.
    """
    spooled = {array.name: folder / f"{array.name}.part" for array in ARRAYS}
    sizes = dict.fromkeys(("N", "R", "S", "K", "C", "M"), 0)
    described: list[dict[str, Any]] = []
    by_part = np.zeros(len(PARTS), dtype=np.int64)
    worst, squares = np.zeros(2), np.zeros(2)
    files = {name: path.open("wb") for name, path in spooled.items()}
    try:
        for facts, tensors in subsets:
            _check_arrays(tensors.arrays, storage, f"{facts['dataset']}/{facts['subset']}")
            for name, values in join_after(tensors.arrays, sizes, len(described)).items():
                values.tofile(files[name])
            own = count_sizes(tensors.arrays)
            sizes = {letter: count + own[letter] for letter, count in sizes.items()}
            by_part += np.bincount(tensors.arrays["sample_part"], minlength=len(PARTS))
            worst = np.maximum(worst, tensors.max_error_m)
            squares += tensors.squared_error_m2
            described.append(describe_subset(facts, tensors))
        if not described:
            for array in ARRAYS:  # offsets of nothing
                files[array.name].write(bytes(8) if array.shape[0].endswith("+1") else b"")
    finally:
        for file in files.values():
            file.close()
    _join_files(folder / ARRAYS_FILE, spooled, sizes, storage)
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


def make_header(sizes: Mapping[str, int], storage: str) -> bytes:
    """Return the head of a safetensors file: its length, and dtype, shape and offsets of every array, in order.

    Padded with blanks, so that the arrays begin at a multiple of 8 bytes, and arrays of wide elements stay aligned.
    """
    header: dict[str, Any] = {"__metadata__": {"format": "np"}}
    start = 0
    for array in ARRAYS:
        dtype, shape = array.stored_as(storage), array.sizes(dict(sizes))
        end = start + int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        header[array.name] = {
            "dtype": SAFETENSORS_DTYPES[dtype],
            "shape": list(shape),
            "data_offsets": [start, end],
        }
        start = end
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _join_files(target: Path, spooled: Mapping[str, Path], sizes: Mapping[str, int], storage: str) -> None:
    """Put the header and the spooled arrays into one file; each is deleted when it has been copied."""
    with target.open("wb") as out:
        out.write(make_header(sizes, storage))
        for array in ARRAYS:
            with spooled[array.name].open("rb") as values:
                shutil.copyfileobj(values, out, 4 * 2**20)
            spooled[array.name].unlink()


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
