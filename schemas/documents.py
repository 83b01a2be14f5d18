"""JSON documents found on disk, which others may have written or damaged."""

import json
from pathlib import Path
from typing import Any

MAX_DEPTH = 50
"""Deepest nesting of a document, in levels; ours have fewer than ten."""


def read_json(path: Path) -> Any:  # noqa: ANN401  (whatever a file holds)
    """Read a JSON document from a file, which raises an OSError or, where it is none, a ValueError."""
    return parse_json(path.read_text(encoding="utf-8"))


def parse_json(text: str) -> Any:  # noqa: ANN401  (whatever a text holds)
    """Parse JSON text that is nested no deeper than any document of ours.

    Raises:
        ValueError: it is no JSON, or nested too deeply: what walks through it by recursion would fail.
    """
    try:
        document = json.loads(text)
    except RecursionError:
        raise ValueError(f"nested in more than {MAX_DEPTH} levels") from None
    level = [document]
    for _ in range(MAX_DEPTH):
        held = (value for value in level if isinstance(value, dict | list))
        level = [inner for value in held for inner in (value.values() if isinstance(value, dict) else value)]
        if not level:
            return document
    raise ValueError(f"nested in more than {MAX_DEPTH} levels")
