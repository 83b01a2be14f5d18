"""Files of tensors that are read without running any code of theirs, and checked before they are used."""

import zlib
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, ZipFile

from tracklake.schemas.errors import TracklakeError

if TYPE_CHECKING:
    from torch import nn

_BROKEN = (AttributeError, BadZipFile, EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError, zlib.error)
"""Errors of zipfile and torch on files that are damaged or of another kind."""


class DamagedFileError(TracklakeError):
    """A file is not what was written, or not what is expected there."""


def read_torch_file(path: Path, advice: str) -> dict[str, Any]:
    """Read tensors and plain values by name onto the CPU, without running any code of the file.

    Args:
        path: file written by `torch.save`.
        advice: end of the messages, what to do where the file cannot be used.

    Raises:
        DamagedFileError: it is absent, cut short or changed, or holds more than tensors and plain values.
    """
    import torch

    if not path.is_file():
        raise DamagedFileError(f"{path}: there is no such file; {advice}")
    try:
        with ZipFile(path) as archive:
            changed = archive.testzip()  # torch itself does not compare the checksums that it writes
        if changed is not None:
            raise BadZipFile(f"`{changed}` has another checksum")
        content = torch.load(path, weights_only=True, map_location="cpu")
    except UnpicklingError:
        raise DamagedFileError(
            f"{path}: expected tensors and plain values, got objects that could run code, and did not read them; "
            f"{advice}"
        ) from None
    except (
        BadZipFile,
        zlib.error,
        EOFError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
        OSError,
    ) as broken:
        size, reason = path.stat().st_size, str(broken).partition("\n")[0]
        raise DamagedFileError(f"{path}: damaged or no file of torch's ({size:,} bytes: {reason}); {advice}") from None
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise DamagedFileError(f"{path}: expected values by name, got {type(content).__name__}; {advice}")
    return content


def load_weights(network: "nn.Module", weights: object, path: Path, advice: str) -> None:
    """Load weights by name into a network, all of its own shapes and dtypes.

    Raises:
        DamagedFileError: a name is missing or unknown, or a shape or dtype differs.
    """
    if not isinstance(weights, dict):
        raise DamagedFileError(f"{path}: expected weights by name, got {type(weights).__name__}; {advice}")
    expected = {name: _describe(value) for name, value in network.state_dict().items()}
    found = {name: _describe(value) for name, value in weights.items()}
    wrong = [
        f"`{name}`: expected {expected.get(name, 'nothing')}, got {found.get(name, 'nothing')}"
        for name in sorted(expected.keys() | found.keys())
        if expected.get(name) != found.get(name)
    ]
    if wrong:
        raise DamagedFileError(
            f"{path}: not the weights of this model, {len(wrong)} differ: {'; '.join(wrong[:3])}; {advice}"
        )
    network.load_state_dict(weights)


def _describe(value: Any) -> str:  # noqa: ANN401  (whatever a file held)
    return f"{tuple(value.shape)} of {value.dtype}" if hasattr(value, "dtype") else f"a {type(value).__name__}"
