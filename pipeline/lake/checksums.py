"""Checksums of live files: what is written is compared with what the manifest remembers."""

import threading
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from tracklake.pipeline.lake.errors import DamagedFileError
from tracklake.pipeline.lake.manifest import LakeFile, Manifest
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.lake.places import open_store
from tracklake.schemas.hashing import hash_chunks
from tracklake.schemas.text import quote_shell


class DamagedFile(NamedTuple):
    """A live file that is not as it was written: the key of its commit, its path in the lake, and what is wrong."""

    key: str
    path: str
    reason: str


CHUNK = 1 << 20
"""Bytes read at once while a file is hashed."""
_KNOWN: dict[tuple[int, int, int, int], str] = {}
"""Checksums of files that this process wrote or compared, by device, inode, size and time of change in ns."""
_GUARD = threading.Lock()


def hash_file(path: Path, *, again: bool = False) -> str:
    """Return the sha256 of a file's bytes; what this process has read or written before is only read if `again`."""
    status = path.stat()
    key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
    if again or key not in _KNOWN:
        with path.open("rb") as stream:
            found = hash_chunks(iter(lambda: stream.read(CHUNK), b""))
        with _GUARD:
            _KNOWN[key] = found
    return _KNOWN[key]


def forget_checksums() -> None:
    """Let every file be read again; a disk may change bytes without a trace in the file's times."""
    with _GUARD:
        _KNOWN.clear()


def verify_files(root: Path, files: Iterable[LakeFile]) -> None:
    """Refuse files whose content is not what was committed; each is read once per process.

    Those that a folder with a part of a lake lacks are compared when they are received.
    """
    for file in files:
        reason = find_damage(root, file)
        if reason is not None and ((root / file.path).exists() or find_origin(root) is None):
            lake = quote_shell(root)
            raise DamagedFileError(
                f"{root / file.path}: damaged ({reason}). `tracklake check --lake {lake}` finds all such files; then "
                f"`tracklake run SOURCE --lake {lake}` on the raw files makes them again."
            )


def find_damage(root: Path, file: LakeFile, *, again: bool = False) -> str | None:
    """Return what is wrong with a live file; None: it is as it was committed, or nothing is known to compare."""
    path = root / file.path
    try:
        size = path.stat().st_size
        if size != file.bytes:
            return f"expected {file.bytes:,} bytes, got {size:,}"
        if file.sha256 is not None and hash_file(path, again=again) != file.sha256:
            return "its bytes are not those that were written, though as many"
    except OSError as failed:
        return failed.strerror or str(failed)
    return None


def find_damaged_files(root: Path, manifest: Manifest) -> list[DamagedFile]:
    """Return every live file that is damaged; all with a checksum are read, whatever was read before.

    Of a lake on an object store, objects are looked for: they are compared with their checksums when they are received.
    """
    if (origin := find_origin(root)) is not None:
        return _find_damaged_objects(origin.address, manifest)
    live = ((commit.key, file) for commit in manifest.commits.values() for file in commit.all_files if file.sha256)
    found = ((key, file.path, find_damage(root, file, again=True)) for key, file in live)
    return sorted(DamagedFile(key, path, reason) for key, path, reason in found if reason is not None)


def _find_damaged_objects(address: str, manifest: Manifest) -> list[DamagedFile]:
    there = {item.path: item.bytes for item in open_store(address).list()}
    live = ((commit.key, file, name_object(file)) for commit in manifest.commits.values() for file in commit.all_files)
    return sorted(
        DamagedFile(key, name, f"expected {file.bytes:,} bytes, got {there.get(name, 'no object')}")
        for key, file, name in live
        if there.get(name) != file.bytes
    )
