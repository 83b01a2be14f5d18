"""Files of tensors: written whole or not at all, and read without running anything that they hold."""

import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any
from uuid import uuid4
from zipfile import BadZipFile, ZipFile

from tracklake.schemas.errors import TracklakeError

if TYPE_CHECKING:
    from torch import Tensor, nn

PARTIAL = ".partial"
"""How the names of files end that are being written."""
SHOWN = 3
"""Differences that a message names."""


class DamagedFileError(TracklakeError):
    """A file is not what was written, or not what is expected there."""


def write_torch_file(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors and plain values aside, put them on the disk, and only then under their name.

    Args:
        path: where to; a file that stands there is replaced at once.
        content: tensors, and of Python's own kinds numbers, texts, lists, tuples and dictionaries.
    """
    import torch

    aside = path.with_name(f".{path.name}.{uuid4().hex}{PARTIAL}")
    try:
        with aside.open("wb") as stream:
            torch.save(dict(content), stream)
            stream.flush()
            os.fsync(stream.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the name, too
    finally:
        os.close(folder)


def read_torch_file(path: Path, advice: str) -> dict[str, Any]:
    """Read what `write_torch_file` wrote, onto the CPU; nothing that the file holds is run.

    Args:
        path: of the file.
        advice: what to do where it cannot be used.

    Raises:
        DamagedFileError: it is absent, cut short or changed, none of torch's files, or holds more than tensors and
            plain values.
    """
    import torch

    if not path.is_file():
        raise DamagedFileError(f"{path}: there is no such file; {advice}")
    size = f"{path.stat().st_size:,} bytes"
    try:
        # torch itself does not compare the checksums that it writes.
        with ZipFile(path) as archive:
            changed = archive.testzip()
    except (BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError, OSError) as broken:
        raise DamagedFileError(
            f"{path}: expected a whole file of torch's, got {size} that are none or not all of it ({broken}); {advice}"
        ) from None
    if changed is not None:
        raise DamagedFileError(f"{path}: damaged: `{changed}` in it is not what was written ({size}); {advice}")
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
    except UnpicklingError:
        raise DamagedFileError(
            f"{path}: expected tensors and plain values, got other objects; reading these could run code, and they "
            f"were not read; {advice}"
        ) from None
    except (RuntimeError, EOFError, ValueError, LookupError, AttributeError, TypeError) as broken:
        told = str(broken).partition("\n")[0]
        raise DamagedFileError(f"{path}: not readable as a file of torch's ({told}); {advice}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise DamagedFileError(f"{path}: expected values by name, got {type(content).__name__}; {advice}")
    return content


def load_weights(network: "nn.Module", weights: Any, where: str, advice: str) -> None:  # noqa: ANN401  (whatever a file held)
    """Give a network its weights.

    Args:
        network: whose.
        weights: by name, as its `state_dict` gives them.
        where: the file, for the message.
        advice: what to do where they are not this network's.

    Raises:
        DamagedFileError: a name is missing or unknown, or a shape or dtype differs.
    """
    if not isinstance(weights, dict):
        raise DamagedFileError(f"{where}: expected weights by name, got {type(weights).__name__}; {advice}")
    wanted = network.state_dict()
    wrong = [f"`{name}` {_describe(wanted[name])} is missing" for name in wanted.keys() - weights.keys()]
    wrong += [f"`{name}` is not known" for name in weights.keys() - wanted.keys()]
    wrong += [
        f"`{name}`: expected {_describe(wanted[name])}, got {_describe(weights[name])}"
        for name in wanted.keys() & weights.keys()
        if _describe(wanted[name]) != _describe(weights[name])
    ]
    if wrong:
        more = f", and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        raise DamagedFileError(
            f"{where}: not the weights of this model: {'; '.join(sorted(wrong)[:SHOWN])}{more}; {advice}"
        )
    network.load_state_dict(weights)


def _describe(value: "Tensor | object") -> str:
    """Its shape and dtype, for a message: two tensors that say the same fit each other."""
    import torch

    if not isinstance(value, torch.Tensor):
        return f"no tensor but {type(value).__name__}"
    return f"{tuple(value.shape)} of {str(value.dtype).removeprefix('torch.')}"
