"""The end of a writing session: what it leaves is recorded, so that one that was broken off is noticed later."""

import json
from pathlib import Path

from tracklake.pipeline.lake.catalog import CATALOG
from tracklake.pipeline.lake.checksums import hash_file
from tracklake.pipeline.lake.files import REPORTS, STAGING, find_orphans
from tracklake.pipeline.lake.history import ROOTS, find_superseded
from tracklake.pipeline.lake.live_folders import is_shown
from tracklake.pipeline.lake.manifest import MANIFEST, Manifest
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.lake.shards import SHARDS
from tracklake.schemas.documents import read_json
from tracklake.schemas.files import list_unfinished, write_file

SESSION = ".session"
"""File of the lake with its place and the checksums of manifest and catalog at the end of the last session."""
LOCATION = "location"
"""Key of the lake's folder in that file."""
WRITTEN_FOLDERS = (".", REPORTS, SHARDS, ROOTS)
"""Folders of the lake in which files are written beside those that they replace."""
WRITER = ".writer"
"""File of the lake that names the process that writes; it stays where a session is broken off."""


def record_end(root: Path) -> None:
    """Record that manifest and catalog belong together; a session's last step but the release of the lock."""
    write_file(root / SESSION, json.dumps(_describe_state(root)).encode())


def is_settled(root: Path, manifest: Manifest) -> bool:
    """Return whether the last session came to its end, nothing has changed since, and none is going on.

    A folder with a part of a lake has neither catalog nor live folders, so that nothing can be unfinished there.
    """
    return find_origin(root) is not None or (not (root / WRITER).exists() and has_ended(root, manifest))


def has_ended(root: Path, manifest: Manifest) -> bool:
    """Return whether a session's end has been reached since the manifest, the catalog or the lake's place was changed.

    The catalog is then the one made of this manifest, the live folders show what is live, and nothing is left lying.
    """
    try:
        if read_json(root / SESSION) != _describe_state(root):
            return False
    except (OSError, ValueError):
        return False
    left = any((root / name).exists() for name in (STAGING, f"{CATALOG}.wal"))
    leftovers = left or any(list_unfinished(root / folder) for folder in WRITTEN_FOLDERS) or find_superseded(root)
    return not leftovers and not find_orphans(root, manifest) and is_shown(root, manifest)


def has_moved(root: Path) -> bool:
    """Return whether a lake stands elsewhere than at the end of its last session, where its catalog still leads."""
    try:
        ended = read_json(root / SESSION)
        if not isinstance(ended, dict) or ended.get(LOCATION) == str(root.resolve()):
            return False
        return bool(ended.get(MANIFEST) == hash_file(root / MANIFEST, again=True))  # else its session's end is missing
    except (OSError, ValueError):
        return False


def _describe_state(root: Path) -> dict[str, str]:
    checksums = {name: hash_file(root / name, again=True) for name in (MANIFEST, CATALOG)}
    return {LOCATION: str(root.resolve()), **checksums}
