"""Opening of tensor folders: the index and the arrays' headers, checked against their declaration."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, INDEX_FILE, POSITION_STORAGES, STEPS_M, TENSORS_VERSION
from tracklake.training.data.checks import AGAIN, TensorError, check_arrays, check_index


def read_index(path: Path) -> dict[str, Any]:
    """Read `index.json` of a folder and check its version, its keys and its rounding errors.

    Raises:
        TensorError: it is absent, of another version, damaged, or its errors are larger than its storage can make.
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
    """Refuse rounding errors beyond half a step, as centres or steps are then not those of the arrays."""
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
    """Read the protocol whose parameters the index holds.

    Raises:
        TensorError: the parameters are not those of this version, or do not give the digest beside them.
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
    """Map every array of ARRAYS read-only, and check it against its declaration and the index.

    Raises:
        TensorError: a file is absent, cut short or too long, is no .npy file, or holds another dtype or shape; or see
            `training.data.checks.check_arrays`.
    """
    arrays = {}
    for array in ARRAYS:
        file = path / array.file
        dtype, shape = np.dtype(array.stored_as(index["storage"])), array.sizes(index["sizes"])
        try:
            mapped = np.lib.format.open_memmap(file, mode="r")
        except (OSError, ValueError) as broken:
            raise TensorError(f"{file}: cannot be read ({broken}); {AGAIN}") from broken
        if (mapped.dtype, mapped.shape) != (dtype, shape):
            raise TensorError(
                f"{file}: expected {dtype} of shape {shape}, got {mapped.dtype} of shape {mapped.shape}; {AGAIN}"
            )
        size, wanted = file.stat().st_size, mapped.offset + mapped.nbytes
        if size != wanted:
            raise TensorError(f"{file}: expected {wanted:,} bytes, got {size:,}; {AGAIN}")
        arrays[array.name] = mapped.view(np.ndarray)  # indexing np.memmap itself runs Python code for every result
    check_arrays(path, index, arrays)
    return arrays
