"""The parts of a manifest: immutable files of changes, named by their content, which a small root lists in order.

A commit adds a shard with what it changes, so that its cost does not depend on the size of the lake. Eight shards of a
size class become one of the next (as in a log-structured merge tree): each change is written again once per power of
eight, and any lake has few shards, which matters where each is a request to an object store.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from tracklake.pipeline.lake.errors import AlreadyStoredError, DamagedShardError, MissingObjectError
from tracklake.pipeline.lake.store import LocalStore, Store
from tracklake.schemas.hashing import hash_chunks

SHARDS = "manifest"
"""Folder of the lake for the shards of its manifest."""
SECTIONS = ("commits", "sources", "retired")
"""Parts of the manifest that shards hold changes of."""
FAN_OUT = 8
"""Shards of one size class that are merged; a class is this many times as large as the one before."""
READERS = 16
"""Shards that are requested from an object store at once."""
_NAME = re.compile("[0-9a-f]{64}")

Changes = dict[str, dict[str, dict[str, Any] | None]]
"""What was added or replaced in each section, by name; None: it was removed."""


@dataclass(frozen=True)
class Shard:
    """A file of changes, as the root lists it.

    Args:
        sha256: checksum of its bytes, which is its name, too.
        bytes: size in bytes.
        items: number of changes in it.
    """

    sha256: str
    bytes: int
    items: int

    @property
    def path(self) -> str:
        """Path relative to the lake's root."""
        return f"{SHARDS}/{self.sha256}.json"


def parse_shards(root: Mapping[str, Any]) -> list[Shard]:
    """Return the shards that a root lists, the oldest first.

    Raises:
        ValueError, TypeError: the list is not one of ours.
    """
    shards = [Shard(**item) for item in root["shards"]]
    for shard in shards:
        if not (_NAME.fullmatch(shard.sha256) and isinstance(shard.items, int)):
            raise ValueError(f"{asdict(shard)} among its shards")
    return shards


def read_shard(store: Store, shard: Shard) -> Changes:
    """Return the changes of a shard.

    Raises:
        DamagedShardError: it is missing, or its bytes are not those that were written.
    """
    try:
        content, _ = store.get(shard.path)
    except MissingObjectError as gone:
        raise DamagedShardError(str(gone)) from gone
    if hash_chunks([content]) != shard.sha256:
        raise DamagedShardError(f"{store.place}/{shard.path}: its bytes are not those that were written")
    changes: Changes = json.loads(content)
    return changes


def read_shards(store: Store, shards: Sequence[Shard]) -> Changes:
    """Return what shards hold together, where the later ones replace what the earlier ones say; raises as above."""
    merged: Changes = {section: {} for section in SECTIONS}
    if isinstance(store, LocalStore):
        found: Iterable[Changes] = (read_shard(store, shard) for shard in shards)
    else:
        with ThreadPoolExecutor(READERS) as pool:  # a request takes longer than all that follows
            found = list(pool.map(lambda shard: read_shard(store, shard), shards))
    for changes in found:
        for section, changed in changes.items():
            merged.setdefault(section, {}).update(changed)
    return merged


def append_changes(store: Store, shards: Sequence[Shard], changes: Changes, live: int) -> list[Shard]:
    """Write changes as a new shard, merged with earlier ones where there are enough; returns the new list.

    Args:
        store: where the lake is kept.
        shards: shards so far, the oldest first.
        changes: what is added, replaced and removed.
        live: number of items that the manifest then has.
    """
    kept = list(shards)
    added = _count_items(changes)
    if not added:
        return kept
    if sum(shard.items for shard in kept) + added > 2 * live + FAN_OUT**2:  # most of it was replaced or removed since
        start = 0
    else:
        start = find_merge([*(shard.items for shard in kept), added])
    merged = read_shards(store, kept[start:]) if start < len(kept) else {}
    for section, changed in changes.items():
        merged.setdefault(section, {}).update(changed)
    if start == 0:  # nothing earlier is left that could be removed
        merged = {name: {key: item for key, item in held.items() if item is not None} for name, held in merged.items()}
    return [*kept[:start], *([_write_shard(store, merged)] if _count_items(merged) else [])]


def find_merge(sizes: Sequence[int]) -> int:
    """Return from which place on shards are merged; the last place: the new one stays by itself.

    Args:
        sizes: items in each shard, the new one last.
    """
    start, size = len(sizes) - 1, sizes[-1]
    while True:
        limit, first = _find_limit(size), start
        while first > 0 and sizes[first - 1] < limit:
            first -= 1
        if start - first + 1 < FAN_OUT:
            return start
        start, size = first, sum(sizes[first:])


def _find_limit(size: int) -> int:
    """Return the number of items at which the size class of a shard ends."""
    limit = FAN_OUT
    while limit <= size:
        limit *= FAN_OUT
    return limit


def _count_items(changes: Changes) -> int:
    return sum(map(len, changes.values()))


def _write_shard(store: Store, changes: Changes) -> Shard:
    filled = {section: changed for section, changed in changes.items() if changed}
    content = json.dumps(filled, sort_keys=True, separators=(",", ":")).encode()
    while True:
        shard = Shard(hash_chunks([content]), len(content), _count_items(filled))
        try:
            store.put_new(shard.path, content)
        except AlreadyStoredError:  # left by a process that was killed, perhaps damaged, perhaps about to be swept
            content += b"\n"  # so that ours has a name that no sweep knows
        else:
            return shard
