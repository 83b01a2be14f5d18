"""Earlier generations of a lake: the roots that ended them, for queries as of then, and the removal of old ones."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.manifest import Manifest, collect_document, load, parse_manifest, read_root
from tracklake.pipeline.lake.shards import SHARDS, parse_shards
from tracklake.pipeline.lake.store import LocalStore
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.documents import read_json

ROOTS = f"{SHARDS}/roots"
"""Folder of the lake for the roots of earlier generations."""
KEPT_GENERATIONS = 2
"""Earlier generations that can be queried, and for which replaced files are kept, in writing sessions."""


@dataclass(frozen=True)
class Generation:
    """A state of the lake that can be queried: the end of a writing session, or the present.

    Args:
        number: number of the session.
        written: time of its last change; None: an earlier version of tracklake wrote it and kept no times.
        commits: number of commits in it.
    """

    number: int
    written: datetime | None
    commits: int

    def show_time(self) -> str:
        """Return the time as `--as-of` takes it, with the offset of this machine's zone."""
        return "unknown" if self.written is None else self.written.astimezone().isoformat(timespec="seconds")


def name_root(number: int) -> str:
    """Return the path of the root that ended a generation."""
    return f"{ROOTS}/{number}.json"


def list_generations(root: Path) -> list[Generation]:
    """Return the generations of a lake that can be queried, the present one last.

    Raises:
        LakeError: no lake there, or none of ours.
    """
    return [_describe(document) for document in _list_roots(root)]


def load_as_of(root: Path, asked: str | None) -> Manifest:
    """Read the manifest as it was at the end of a generation, or at a time; None: as it is.

    Args:
        root: the lake's folder.
        asked: number of a generation, or an ISO date or time, in this machine's zone unless it names one.

    Raises:
        LakeError: neither a number nor a time, or nothing is kept of then; the message says what is.
    """
    if asked is None:
        return load(root)
    roots = _list_roots(root)
    if asked.strip().isdecimal():
        found = [document for document in roots if document["generation"] == int(asked)]
    else:
        time = _parse_time(asked)
        found = [document for document in roots if (written := _describe(document).written) and written <= time]
    if not found:
        kept = ", ".join(f"{each.number} ({each.show_time()})" for each in map(_describe, roots))
        raise LakeError(
            f"{root}: nothing is kept of {asked}; --as-of takes a generation or a later time of these: {kept}"
        )
    return parse_manifest(root, collect_document(root, found[-1]))


def find_superseded(root: Path) -> list[str]:
    """Return the paths of the roots and shards that neither the manifest nor a generation to be kept needs."""
    needed = set()
    for document in _list_roots(root):
        needed.add(name_root(document["generation"]))
        needed |= {shard.path for shard in parse_shards(document)} if "shards" in document else set()
    return sorted(stored.path for stored in LocalStore(root).list(SHARDS) if stored.path not in needed)


def _list_roots(root: Path) -> list[dict[str, Any]]:
    """Return the roots of the generations to be kept and of the present, which is the last."""
    present = read_root(root)
    number = present["generation"] if isinstance(present.get("generation"), int) else 0
    kept = (_read_kept(root / name_root(number - back)) for back in range(KEPT_GENERATIONS, -1, -1))
    return [*(document for document in kept if document is not None), present]


def _read_kept(file: Path) -> dict[str, Any] | None:
    """Return the root of an earlier generation; None: it is not kept, or another version's or damaged."""
    try:
        document = read_json(file)
        parse_shards(document)
        datetime.fromisoformat(document["written"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return document if document["schema_version"] == SCHEMA_VERSION else None


def _describe(document: dict[str, Any]) -> Generation:
    written = document.get("written")
    commits = document["commits"] if "shards" in document else len(document["entries"])
    return Generation(document["generation"], None if written is None else datetime.fromisoformat(written), commits)


def _parse_time(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text.strip()).astimezone()
    except ValueError:
        raise LakeError(
            f"as of {text}: expected the number of a generation, or a time such as 2026-11-23 or "
            "2026-11-23T06:00:00+00:00. `tracklake info` lists what is kept."
        ) from None
