"""Opening tensor folders: both files checked against their declaration; of the arrays, only their index is read."""

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import (
    ARRAYS,
    ARRAYS_FILE,
    INDEX_FILE,
    POSITION_STORAGES,
    SAFETENSORS_DTYPES,
    STEPS_M,
    TENSORS_VERSION,
)
from tracklake.training.data.checks import AGAIN, TensorError, check_arrays, check_index, is_pair, is_whole


def read_index(path: Path) -> dict[str, Any]:
    """`index.json` of a folder: of this version, keys of their kinds, rounding errors that its storage can have.

    Raises:
        TensorError: it is absent, or not so.
    """
    file = path / INDEX_FILE
    if not file.is_file():
        raise TensorError(f"{path}: no tensors here (no {INDEX_FILE}); run `tracklake tensors`")
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as broken:
        raise TensorError(f"{file}: not readable as JSON ({broken}); {AGAIN}") from broken
    if not isinstance(index, dict) or index.get("version") != TENSORS_VERSION:
        found = index.get("version") if isinstance(index, dict) else type(index).__name__
        raise TensorError(f"{file}: expected version {TENSORS_VERSION} of tensors, got {found}; {AGAIN}")
    check_index(file, index)
    _check_storage(file, index)
    return index


def _check_storage(file: Path, index: dict[str, Any]) -> None:
    """Refuse rounding errors beyond half a step: centres or steps are then not those of the arrays."""
    storage, errors = index["storage"], index["max_error_m"]
    if storage not in POSITION_STORAGES:
        raise TensorError(f"{file}: expected storage {' or '.join(POSITION_STORAGES)}, got {storage!r}; {AGAIN}")
    for axis, error, step in zip(("along", "across"), errors, STEPS_M.get(storage, (0.0, 0.0)), strict=True):
        most = step / 2 + 1e-3  # float32 rounds as well: 0.5 mm at 8 km
        if error > most:
            raise TensorError(
                f"{file}: expected a rounding error {axis} the road of at most {most:g} m for {storage}, got {error}; "
                f"{AGAIN}"
            )


def read_protocol(path: Path, index: dict[str, Any]) -> Protocol:
    """The protocol whose parameters the index holds.

    Raises:
        TensorError: they are others than this version's, or do not give the digest beside them.
    """
    file = path / INDEX_FILE
    parameters = {name: value for name, value in index["protocol"].items() if name != "digest"}
    known = {field.name for field in fields(Protocol)}
    if set(parameters) != known:
        raise TensorError(
            f"{file}: expected a protocol of {', '.join(sorted(known))}, got {', '.join(sorted(parameters))}; {AGAIN}"
        )
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in parameters.items()
    }
    protocol = Protocol(**given)  # JSON has no tuples
    if protocol.digest != index["protocol"].get("digest"):
        raise TensorError(
            f"{file}: the protocol's digest is {index['protocol'].get('digest')}, its parameters give "
            f"{protocol.digest}; {AGAIN}"
        )
    return protocol


def map_arrays(path: Path, index: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Every array of ARRAYS, mapped read-only, of the declared dtype and shape, and in agreement with the index.

    Raises:
        TensorError: the file is absent, cut short or too long, no safetensors file, or lacks an array or holds it with
            another dtype or shape; or see `training.data.checks.check_arrays`.
    """
    file = path / ARRAYS_FILE
    header, start = _read_header(file)
    size = file.stat().st_size - start
    # Plain views: indexing np.memmap itself runs Python code for every result.
    mapped = np.memmap(file, np.uint8, "r", start).view(np.ndarray) if size else np.empty(0, np.uint8)
    arrays = {}
    for array in ARRAYS:
        dtype, shape = array.stored_as(index["storage"]), array.sizes(index["sizes"])
        found = header.get(array.name, {})
        if not isinstance(found, dict):
            raise TensorError(f"{file}: array `{array.name}`: expected an object in the header, got {found!r}; {AGAIN}")
        if (found.get("dtype"), found.get("shape")) != (SAFETENSORS_DTYPES[dtype], list(shape)):
            raise TensorError(
                f"{file}: array `{array.name}`: expected {SAFETENSORS_DTYPES[dtype]} of shape {list(shape)}, got "
                f"{found.get('dtype', 'nothing')} of shape {found.get('shape')}; {AGAIN}"
            )
        place = found.get("data_offsets")
        if not is_pair(place, is_whole) or place[0] < 0:
            raise TensorError(
                f"{file}: array `{array.name}`: expected its two `data_offsets` in bytes, got {place!r}; {AGAIN}"
            )
        first, end = place
        if end - first != math.prod(shape) * np.dtype(dtype).itemsize or first % np.dtype(dtype).itemsize:
            raise TensorError(f"{file}: array `{array.name}` cannot stand at bytes {first} to {end}; {AGAIN}")
        if end > size:
            raise TensorError(
                f"{file}: cut short: array `{array.name}` ends at byte {start + end:,}, the file at {start + size:,}; "
                f"{AGAIN}"
            )
        arrays[array.name] = mapped[first:end].view(dtype).reshape(shape)
    ends = max(header[array.name]["data_offsets"][1] for array in ARRAYS)
    if size != ends:
        raise TensorError(f"{file}: expected {start + ends:,} bytes, got {start + size:,}; {AGAIN}")
    check_arrays(file, index, arrays)
    return arrays


def _read_header(file: Path) -> tuple[dict[str, Any], int]:
    """A safetensors file's header, and the byte at which the arrays begin."""
    try:
        with file.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if not 2 <= length <= file.stat().st_size - 8:
                raise TensorError(f"{file}: not a whole safetensors file ({file.stat().st_size:,} bytes); {AGAIN}")
            header = json.loads(stream.read(length))
    except (OSError, ValueError) as broken:
        if isinstance(broken, TensorError):
            raise
        raise TensorError(f"{file}: cannot be read ({broken}); {AGAIN}") from broken
    if not isinstance(header, dict):
        raise TensorError(f"{file}: expected a safetensors header, got {type(header).__name__}; {AGAIN}")
    return header, 8 + length
