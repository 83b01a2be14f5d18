"""The manifest as it is stored: a commit adds a shard of changes, and then replaces the root that lists the shards.

Replacing the root is the moment at which a commit happens. The store replaces it only if it is still the one that this
process has read or written, whether or not a lock or lease keeps other writers away.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any, TypeVar

from tracklake.pipeline.lake.errors import LakeError, MissingObjectError, SwapConflictError
from tracklake.pipeline.lake.history import name_root
from tracklake.pipeline.lake.manifest import MANIFEST, Commit, Manifest, Retired, load
from tracklake.pipeline.lake.places import LakePlace, open_store
from tracklake.pipeline.lake.shards import Changes, append_changes, parse_shards
from tracklake.pipeline.lake.store import find_tag, swap_own
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.hashing import hash_chunks

T = TypeVar("T")

MAX_CONFLICTS = 20
"""Times that changes are applied again to roots that other processes have put in place meanwhile."""
NOTHING = Manifest(lake_id="")
"""Manifest of a lake of which nothing is stored in shards yet."""


class CommitLog:
    """The stored manifest of one lake, as far as this process knows.

    Args:
        place: the lake's folder or address.
        is_rebuild: whether nothing of what is stored is used again, so that it need not be whole.
    """

    def __init__(self, place: LakePlace, *, is_rebuild: bool = False) -> None:
        self._place = place
        self.store = open_store(place)
        self._is_rebuild = is_rebuild
        self._read()

    @property
    def is_migrated(self) -> bool:
        """Whether manifest.json is a root of shards; one of an earlier layout holds everything itself."""
        return "shards" in self._root

    @property
    def digest(self) -> str:
        """Checksum of the root that this process has read or written last; empty: there was none."""
        return hash_chunks([_encode(self._root)]) if self._root else ""

    def replace(self, manifest: Manifest) -> Manifest:
        """Store a manifest in place of the one before, and return what is stored then.

        That has the changes of other processes, too, where they have changed nothing of the same. A lake that takes the
        place of another goes on with its generations, so that each number stands for one state of this place.

        Raises:
            LakeError: another process has changed the same, or others do not cease to replace the root.
        """
        number = self._root.get("generation")
        if isinstance(number, int) and self._root.get("lake_id") != manifest.lake_id:
            manifest = replace(manifest, generation=max(manifest.generation, number + 1))
        for _ in range(MAX_CONFLICTS):
            try:
                self._swap(manifest)
            except SwapConflictError:
                known = {**vars(self)}
                try:
                    manifest = self._rebase(manifest)
                except LakeError:  # what others did is no part of what the caller knows: it must not undo it later
                    vars(self).update(known)
                    raise
            else:
                return manifest
        raise LakeError(
            f"{self._place}: other processes replaced {MANIFEST} {MAX_CONFLICTS} times during one commit. "
            "Wait for them to end, and run again."
        )

    def _read(self) -> None:
        """Find out what is stored; the manifest of an earlier layout counts as nothing."""
        self.manifest, self._shards = NOTHING, []
        self._root: dict[str, Any] = {}
        self._tag: str | None = None
        try:
            content, self._tag = self.store.get(MANIFEST)
        except MissingObjectError:
            return
        self._root = json.loads(content)
        if self.is_migrated and not self._is_rebuild:
            self.manifest, self._shards = load(self._place), parse_shards(self._root)

    def _swap(self, manifest: Manifest) -> None:
        is_same = manifest.lake_id == self.manifest.lake_id
        before, shards = (self.manifest, self._shards) if is_same else (NOTHING, [])
        items = len(manifest.commits) + len(manifest.sources) + len(manifest.retired)
        changes = find_changes(before, manifest)
        shards = append_changes(self.store, shards, changes, items)
        root = {
            "schema_version": SCHEMA_VERSION,
            "lake_id": manifest.lake_id,
            "generation": manifest.generation,
            "written": self._find_time(manifest, changes),
            "kept_generations": manifest.retention.generations,
            "kept_hours": manifest.retention.hours,
            "commits": len(manifest.commits),
            "ingested_from": list(manifest.ingested_from),
            "shards": [asdict(shard) for shard in shards],
        }
        if self.is_migrated and any(root[name] != self._root[name] for name in ("generation", "lake_id")):
            self._keep_root()
        self._tag = swap_own(self.store, MANIFEST, _encode(root), self._tag)
        self.manifest, self._shards, self._root = manifest, shards, root

    def _find_time(self, manifest: Manifest, changes: Changes) -> str:
        """Return when a generation changed last; what no query shows does not change it."""
        is_same = all(self._root.get(name) == getattr(manifest, name) for name in ("generation", "lake_id"))
        is_shown = any(item is None or item["fingerprint"] for item in changes["commits"].values())  # not only damaged
        if self.is_migrated and is_same and not is_shown and not changes["sources"]:
            return str(self._root["written"])
        return datetime.now(UTC).isoformat(timespec="seconds")

    def _keep_root(self) -> None:
        """Keep the root that ends a generation.

        Raises:
            SwapConflictError: another process has replaced it since it was read, so that it need not be the last one.
        """
        path = name_root(self._root["generation"])
        kept = find_tag(self.store, path)  # before the root is looked at, so that only a newer one can replace it then
        if find_tag(self.store, MANIFEST) != self._tag:
            raise SwapConflictError(f"{self._place}/{MANIFEST}: was changed by another writer")
        swap_own(self.store, path, _encode(self._root), kept)

    def _rebase(self, manifest: Manifest) -> Manifest:
        """Return what is stored by now with the changes that a manifest was to bring.

        Raises:
            LakeError: both change the same, or one of both makes or rebuilds the lake.
        """
        base, ours = self.manifest, find_changes(self.manifest, manifest)
        self._read()
        if self.manifest.lake_id != base.lake_id:
            raise LakeError(f"{self._place}: another process has made or rebuilt this lake meanwhile. Run again.")
        if manifest.lake_id != base.lake_id:
            raise LakeError(
                f"{self._place}: another process has changed the lake that was to be replaced; its version stays. "
                "Run again."
            )
        theirs = find_changes(base, self.manifest)
        for section, changed in ours.items():
            for name in changed.keys() & theirs[section].keys():
                if not _is_same(changed[name], theirs[section][name]):
                    raise LakeError(
                        f"{self._place}: another process has changed {name} ({section}) meanwhile; its version stays. "
                        "Run again, one process at a time."
                    )
        number = self.manifest.generation + (manifest.generation > base.generation)
        return _apply(self.manifest, manifest, ours, max(number, manifest.generation))


def _is_same(item: object, other: object) -> bool:
    """Return whether two items would be stored as the same; of one that was read, lists may have been tuples before."""
    return json.dumps(item, sort_keys=True) == json.dumps(other, sort_keys=True)


def find_changes(before: Manifest, after: Manifest) -> Changes:
    """Return what differs between two manifests, by section and name."""
    changes: Changes = {
        "commits": _compare(before.commits, after.commits),
        "sources": _compare(before.sources, after.sources),
        "retired": {},
    }
    if before.retired is not after.retired:
        changes["retired"] = _compare(*({item.path: item for item in each.retired} for each in (before, after)))
    return changes


def _compare(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, dict[str, Any] | None]:
    if before is after:
        return {}
    changed = (name for name, item in after.items() if before.get(name) is not item and before.get(name) != item)
    removed = dict.fromkeys(before.keys() - after.keys()) if len(before) + len(after) else {}
    return {**removed, **{name: _describe(after[name]) for name in changed}}


def _describe(item: Commit | Retired | dict[str, Any]) -> dict[str, Any]:
    """Return the fields of an item as shards hold them, without its name."""
    if isinstance(item, dict):
        return item
    fields = asdict(item)
    del fields["key" if isinstance(item, Commit) else "path"]
    return fields


def _apply(theirs: Manifest, ours: Manifest, changes: Changes, generation: int) -> Manifest:
    """Return another process's manifest with our changes, as a generation in which our files are retired."""
    mine = {item.path: replace(item, generation=generation) for item in ours.retired}
    retired = _merge({item.path: item for item in theirs.retired}, mine, changes["retired"])
    merged = replace(
        theirs,
        generation=generation,
        commits=_merge(theirs.commits, ours.commits, changes["commits"]),
        sources=_merge(theirs.sources, ours.sources, changes["sources"]),
        ingested_from=tuple(dict.fromkeys((*theirs.ingested_from, *ours.ingested_from))),
    )
    live = merged.live_paths()
    return replace(merged, retired=tuple(item for item in retired.values() if item.path not in live))


def _merge(theirs: Mapping[str, T], ours: Mapping[str, T], changed: Mapping[str, object]) -> dict[str, T]:
    """Return their items with those of ours that changed, and without those that we removed."""
    kept = {name: item for name, item in theirs.items() if name not in changed}
    return {**kept, **{name: ours[name] for name in changed if name in ours}}


def _encode(root: Mapping[str, Any]) -> bytes:
    return json.dumps(root, indent=1).encode()
