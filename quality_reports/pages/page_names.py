"""File names of the pages of subsets and drives."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from tracklake.schemas.hashing import hash_text

FOLDER = "subsets"
"""Folder of the subsets' pages, beside the overview."""
DRIVES_FOLDER = "drives"
"""Folder of the drives' pages."""
LONGEST_NAME = 80
"""Longest file name before its suffix, in characters."""


def name_pages(subsets: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], str]:
    """Name the file of every subset's page, by (dataset, subset), after the subset where that is a safe file name.

    Other characters than ASCII letters, digits, dots, hyphens and underscores are written as ~ and two digits a byte;
    long names are cut. Names that would be the same file, also where letters' case is ignored, get a suffix.

    Args:
        subsets: rows with dataset and subset.
    """
    names = {(row["dataset"], row["subset"]): _name_file(row["subset"]) for row in subsets}
    taken = [name.lower() for name in names.values()]
    return {
        key: f"{name if taken.count(name.lower()) == 1 else f'{name}~{_hash(*key)}'}.html"
        for key, name in names.items()
    }


def _name_file(subset: str) -> str:
    """Return a safe file name for a subset, without suffix."""
    safe = re.sub(
        r"[^A-Za-z0-9._-]|^\.",
        lambda found: "".join(f"~{byte:02x}" for byte in found[0].encode("utf-8", "surrogatepass")),
        subset,
    )
    return safe if 0 < len(safe) <= LONGEST_NAME else f"{safe[:LONGEST_NAME]}~{_hash(subset)}"


def _hash(*texts: str) -> str:
    """Return a short digest of some texts."""
    return hash_text("\0".join(texts), 8)
