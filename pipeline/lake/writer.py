"""One writer at a time: the lock, commits, and the sweeping of what is no longer needed."""

import fcntl
import json
import os
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.lake import catalog, files
from pipeline.lake.errors import LakeError, LakeLockedError, LakeMissingError
from pipeline.lake.manifest import Entry, Manifest, load, store

LOCK = ".lock"
KEPT_GENERATIONS = 2
"""A replaced file is deleted when this many later generations have begun."""


class Writer:
    """The only process that changes a lake; made by `open_for_writing`."""

    def __init__(self, root: Path, manifest: Manifest) -> None:
        self.root = root
        self.manifest = manifest
        self._generation = manifest.generation + 1
        self._guard = threading.Lock()

    def commit(self, entry: Entry) -> None:
        """Make an entry's files live and those it replaces retired, by replacing manifest.json."""
        with self._guard:
            if not files.is_intact(self.root, (file for group in entry.files.values() for file in group)):
                raise LakeError(f"{self.root}: files of {entry.key} vanished before they were committed. Run again.")
            self._store(self.manifest.committing(entry, self._generation))

    def remember_sources(self, sources: Mapping[str, dict[str, Any]]) -> None:
        """Record which recordings raw files hold, by sha256, so that the next run need not read them to know."""
        with self._guard:
            merged = {**self.manifest.sources, **sources}
            if merged != self.manifest.sources:
                self._store(replace(self.manifest, sources=merged, generation=self._generation))

    def finish(self) -> None:
        """Sweep and rebuild the catalog: the last step of a writing session."""
        with self._guard:
            limit = self._generation - KEPT_GENERATIONS
            old = [item for item in self.manifest.retired if item.generation <= limit]
            live = self.manifest.live_paths()
            files.remove(self.root, (self.root / item.path for item in old if item.path not in live))
            if old:
                self._store(replace(self.manifest, retired=tuple(i for i in self.manifest.retired if i not in old)))
            files.remove_orphans(self.root, self.manifest)
            shutil.rmtree(self.root / files.STAGING, ignore_errors=True)
            catalog.rebuild(self.root, self.manifest)

    def _store(self, manifest: Manifest) -> None:
        store(self.root, manifest)
        self.manifest = manifest


@contextmanager
def open_for_writing(root: Path) -> Iterator[Writer]:
    """Lock a lake (making it where there is none) and yield its writer; the catalog is rebuilt at the end.

    The lock is the kernel's: it goes with the process, however that ends, and is not inherited by children.

    Raises:
        LakeLockedError: another process holds the lock.
        LakeError: the folder holds other things than a lake.
    """
    _refuse_foreign(root)
    root.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(root / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 200).decode(errors="replace").strip()
            raise LakeLockedError(
                f"{root}: another process is writing to this lake ({holder or 'unknown'}). "
                "Wait for it to end, or write to another lake with --lake. Readers need not wait."
            ) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, json.dumps({"pid": os.getpid()}).encode())
        shutil.rmtree(root / files.STAGING, ignore_errors=True)
        for leftover in (*root.glob(".*.tmp"), *root.glob(".*.tmp.wal")):
            leftover.unlink()
        try:
            manifest = load(root)
        except LakeMissingError:
            manifest = Manifest()
            store(root, manifest)
        writer = Writer(root, manifest)
        yield writer
        writer.finish()
    finally:
        os.close(descriptor)


def _refuse_foreign(root: Path) -> None:
    if root.is_file():
        raise LakeError(f"{root}: is a file; a lake is a folder. Name another with --lake.")
    if root.is_dir() and not (root / "manifest.json").exists():
        foreign = sorted(item.name for item in root.iterdir() if not item.name.startswith("."))
        if foreign:
            raise LakeError(
                f"{root}: holds other files ({', '.join(foreign[:3])}{', ...' if len(foreign) > 3 else ''}) and is no "
                "lake (no manifest.json). Name an empty or new folder with --lake."
            )
