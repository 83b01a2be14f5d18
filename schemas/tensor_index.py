"""The index of a tensor folder, read from disk and checked against its declaration.

Whatever is absent, unreadable or not as declared raises TensorError.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Self

from pydantic import FiniteFloat, NonNegativeInt, TypeAdapter, ValidationError, conlist

from tracklake.schemas.columns import PARTS
from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import LATER, Protocol
from tracklake.schemas.tensors import (
    ARRAYS,
    INDEX_FILE,
    INDEX_KEYS,
    POSITION_STORAGES,
    RECORDED_POSITIONS,
    STEPS_M,
    SUBSET_KEYS,
    TENSORS_VERSION,
)

AGAIN = "run `tracklake tensors` again"


class TensorError(TracklakeError):
    """A tensor folder is absent, unfinished or not what its index says."""

    @classmethod
    def at(cls, where: Path | str, problem: str) -> Self:
        """Name the place and the problem, and what to do."""
        return cls(f"{where}: {problem}; {AGAIN}")


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


def read_index(path: Path) -> dict[str, Any]:
    """Read `index.json` of a folder and check its version, its keys and its rounding errors."""
    file = path / INDEX_FILE
    if not file.is_file():
        raise TensorError(f"{path}: no tensors here (no {INDEX_FILE}); run `tracklake tensors`")
    try:
        index = read_json(file)
    except ValueError as broken:
        raise TensorError.at(file, f"not readable as JSON ({broken})") from broken
    if not isinstance(index, dict) or index.get("version") != TENSORS_VERSION:
        found = index.get("version") if isinstance(index, dict) else type(index).__name__
        raise TensorError.at(file, f"expected version {TENSORS_VERSION} of tensors, got {found}")
    for subset in index["subsets"] if isinstance(index.get("subsets"), list) else ():
        if isinstance(subset, dict):
            subset.setdefault("lateral_positions", RECORDED_POSITIONS)  # older tensors do not say
    _check_keys(file, index)
    _check_storage(file, index)
    return index


def _check_keys(file: Path, index: Mapping[str, Any]) -> None:
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
        raise TensorError.at(file, f"lacks {', '.join(missing[:5])}")


def _check_kinds(file: Path, where: str, found: Mapping[str, Any], kinds: Mapping[str, str]) -> None:
    for key, kind in kinds.items():
        try:
            if key in found:
                KINDS[kind].validate_python(found[key], strict=True)
        except ValidationError:
            raise TensorError.at(file, f"`{where}{key}`: expected {kind}, got {str(found[key])[:60]}") from None


def _check_storage(file: Path, index: dict[str, Any]) -> None:
    """Refuse rounding errors beyond half a step, as centres or steps are then not those of the arrays."""
    storage, errors = index["storage"], index["max_error_m"]
    if storage not in POSITION_STORAGES:
        raise TensorError.at(file, f"expected storage {' or '.join(POSITION_STORAGES)}, got {storage!r}")
    for axis, error, step in zip(("along", "across"), errors, STEPS_M.get(storage, (0.0, 0.0)), strict=True):
        most = step / 2 + 1e-3  # float32 rounds as well: 0.5 mm at 8 km
        if error > most:
            expected = f"a rounding error {axis} the road of at most {most:g} m for {storage}"
            raise TensorError.at(file, f"expected {expected}, got {error}")


def read_protocol(path: Path, index: dict[str, Any]) -> Protocol:
    """Read the protocol whose parameters, those of this version, the index holds with their digest."""
    file, digest = path / INDEX_FILE, index["protocol"].get("digest")
    parameters: dict[str, Any] = LATER | {  # tensors without one of them are older than that choice
        name: tuple(value) if isinstance(value, list) else value  # JSON has no tuples
        for name, value in index["protocol"].items()
        if name != "digest"
    }
    known, found = sorted(field.name for field in fields(Protocol)), sorted(parameters)
    if found != known:
        raise TensorError.at(file, f"expected a protocol of {', '.join(known)}, got {', '.join(found)}")
    protocol = Protocol(**parameters)
    if protocol.digest != digest:
        raise TensorError.at(file, f"the protocol's digest is {digest}, its parameters give {protocol.digest}")
    return protocol
