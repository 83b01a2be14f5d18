"""What the subsets' pages are called."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from tracklake.schemas.hashing import hash_text

FOLDER = "subsets"
"""Of the pages, beside the overview."""
LONGEST_NAME = 80


def name_pages(subsets: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], str]:
    """The file name of every subset's page by (dataset, subset): the subset's name where that may be a file's name.

    Other characters than ASCII letters, digits, dots, hyphens and underscores are written as ~ and two digits a byte;
    long names are cut. Names that would be the same file, also where letters' case is ignored, get a suffix.

    Args:
        subsets: dataset and subset of each.
    """
    names = {(row["dataset"], row["subset"]): _name_file(row["subset"]) for row in subsets}
    taken = [name.lower() for name in names.values()]
    return {
        key: f"{name if taken.count(name.lower()) == 1 else f'{name}~{_hash(*key)}'}.html"
        for key, name in names.items()
    }


def _name_file(subset: str) -> str:
    safe = re.sub(
        r"[^A-Za-z0-9._-]|^\.",
        lambda found: "".join(f"~{byte:02x}" for byte in found[0].encode("utf-8", "surrogatepass")),
        subset,
    )
    return safe if 0 < len(safe) <= LONGEST_NAME else f"{safe[:LONGEST_NAME]}~{_hash(subset)}"


def _hash(*texts: str) -> str:
    return hash_text("\0".join(texts), 8)
