"""Digests of texts, plain values and files."""

import hashlib
import json
from collections.abc import Iterable
from typing import Any


def hash_chunks(chunks: Iterable[Any], digits: int = 64) -> str:
    """Return the first hex digits of the sha256 of bytes that come piece by piece (bytes or contiguous arrays)."""
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()[:digits]


def hash_text(text: str, digits: int = 64) -> str:
    """Return the first hex digits of a text's sha256; file names that are no UTF-8 are hashed by their bytes."""
    return hash_chunks([text.encode("utf-8", "surrogatepass")], digits)


def hash_values(values: object, digits: int = 64) -> str:
    """Return the first hex digits of the sha256 of plain values, written as JSON with sorted keys."""
    return hash_text(json.dumps(values, sort_keys=True), digits)
