"""Earlier generations of a lake: the roots that ended them, for queries as of then, and the removal of old ones."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from tracklake.pipeline.lake.errors import LakeError, MissingObjectError
from tracklake.pipeline.lake.manifest import (
    Manifest,
    Retention,
    collect_document,
    load,
    parse_manifest,
    read_retention,
    read_root,
)
from tracklake.pipeline.lake.places import LakePlace, open_store
from tracklake.pipeline.lake.shards import SHARDS, parse_shards
from tracklake.pipeline.lake.store import Store
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.documents import parse_json

ROOTS = f"{SHARDS}/roots"
"""Folder of the lake for the roots of earlier generations."""


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


def list_generations(place: LakePlace) -> list[Generation]:
    """Return the generations of a lake that can be queried, the present one last.

    Raises:
        LakeError: no lake there, or none of ours.
    """
    return [_describe(document) for document in list_roots(place)]


def load_as_of(place: LakePlace, asked: str | None) -> Manifest:
    """Read the manifest as it was at the end of a generation, or at a time; None: as it is.

    Args:
        place: the lake's folder or address.
        asked: number of a generation, or an ISO date or time, in this machine's zone unless it names one.

    Raises:
        LakeError: neither a number nor a time, or nothing is kept of then; the message says what is.
    """
    if asked is None:
        return load(place)
    roots = list_roots(place)
    if asked.strip().isdecimal():
        found = [document for document in roots if document["generation"] == int(asked)]
    else:
        time = _parse_time(asked)
        found = [document for document in roots if (written := _describe(document).written) and written <= time]
    if not found:
        kept = ", ".join(f"{each.number} ({each.show_time()})" for each in map(_describe, roots))
        raise LakeError(f"{place}: nothing is kept of {asked}. What can be asked for, by generation and time: {kept}.")
    return parse_manifest(place, collect_document(place, found[-1]))


def find_limit(place: LakePlace, manifest: Manifest) -> int:
    """Return the oldest generation to be kept; files that were replaced in it or before are not needed any more."""
    return _find_limit(open_store(place), manifest.generation, manifest.retention)


def _find_limit(store: Store, number: int, retention: Retention) -> int:
    limit, since = number - retention.generations, datetime.now(UTC) - timedelta(hours=retention.hours)
    while (kept := read_kept_root(store, name_root(limit))) and datetime.fromisoformat(kept["written"]) > since:
        limit -= 1
    return limit


def find_superseded(place: LakePlace) -> list[str]:
    """Return the paths of the roots and shards that neither the manifest nor a generation to be kept needs."""
    needed = set()
    for document in list_roots(place):
        needed.add(name_root(document["generation"]))
        needed |= {shard.path for shard in parse_shards(document)} if "shards" in document else set()
    return sorted(stored.path for stored in open_store(place).list(SHARDS) if stored.path not in needed)


def list_roots(place: LakePlace) -> list[dict[str, Any]]:
    """Return the roots of the generations to be kept and of the present, which is the last."""
    present = read_root(place)
    number = present["generation"] if isinstance(present.get("generation"), int) else 0
    store = open_store(place)
    limit = _find_limit(store, number, read_retention(present))
    kept = (read_kept_root(store, name_root(each)) for each in range(limit, number))
    return [*(document for document in kept if document is not None), present]


def read_kept_root(store: Store, path: str) -> dict[str, Any] | None:
    """Return the root of an earlier generation; None: it is not kept, or another version's or damaged."""
    try:
        document: dict[str, Any] = parse_json(store.get(path)[0].decode())
        parse_shards(document)
        datetime.fromisoformat(document["written"])
    except (MissingObjectError, ValueError, KeyError, TypeError):
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
