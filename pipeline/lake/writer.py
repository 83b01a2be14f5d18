"""The writer of a lake, one at a time: the lock, commits, and the removal of files that are no longer needed."""

import os
import shutil
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import catalog, files, history, live_folders, session_end
from tracklake.pipeline.lake.checksums import forget_checksums
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import LakeError, LakeLockedError, LakeMissingError
from tracklake.pipeline.lake.manifest import MANIFEST, Commit, Manifest, Retention, load
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.lake.rebuild import start_rebuild
from tracklake.pipeline.lake.remote_log import RemoteLog, clear_copy, store_copy
from tracklake.pipeline.lake.session_end import WRITER
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.files import SETTINGS_FILE, remove_unfinished

LOCK = ".lock"
"""Name of the empty file in the lake that the writer holds locked."""


class Writer:
    """The only process that changes a lake; made by `open_for_writing`."""

    def __init__(
        self, root: Path, log: CommitLog, generation: int, *, has_catalog: bool = False, remote: RemoteLog | None = None
    ) -> None:
        self.root = root
        self._log = log
        self._remote = remote
        self.manifest = manifest = log.manifest
        self._cataloged = manifest if has_catalog else None
        self._generation = generation
        self._guard = threading.Lock()
        self._process = os.getpid()

    def commit(self, *commits: Commit) -> None:
        """Make the files of commits live at once, and those they replace retired."""
        with self._guard:
            for commit in commits:
                if not files.is_intact(self.root, commit.all_files):
                    raise LakeError(
                        f"{self.root}: files of {commit.key} vanished before they were committed. Run again."
                    )
            known = self.manifest.commits
            new = [commit for commit in commits if known.get(commit.key) != commit]
            if new:
                self._store(self.manifest.add_commits(new, self._generation))
                replaced = [known[commit.key] for commit in new if commit.key in known]
                if self._remote is None:
                    live_folders.show_commits(self.root, new, replaced)

    def remember_sources(self, sources: Mapping[str, dict[str, Any]]) -> None:
        """Record which recordings raw files hold, by sha256, so that the next run need not read them to know."""
        with self._guard:
            merged = {**self.manifest.sources, **sources}
            if merged != self.manifest.sources:
                self._store(replace(self.manifest, sources=merged, generation=self._generation))

    def remove(self, keys: Collection[str]) -> None:
        """Remove commits from the lake; their files are retired like replaced ones."""
        with self._guard:
            removed = [commit for key, commit in self.manifest.commits.items() if key in keys]
            if removed:
                self._store(self.manifest.remove_commits(keys, self._generation))
                if self._remote is None:
                    live_folders.show_commits(self.root, [], removed)

    def mark_damaged(self, keys: Collection[str]) -> None:
        """Record commits as damaged, so that the next run makes them again; their files stay live until then."""
        with self._guard:
            marked = self.manifest.mark_damaged(keys)
            if marked != self.manifest:
                self._store(marked)

    def remember_origin(self, source: str) -> None:
        """Record a SOURCE as the last one, so that a message about a rebuild can name it."""
        with self._guard:
            origins = (*(name for name in self.manifest.ingested_from if name != source), source)
            if origins != self.manifest.ingested_from:
                self._store(replace(self.manifest, ingested_from=origins))

    def finish(self) -> None:
        """Bring the catalog up to date and delete what neither it nor a reader of the one before needs.

        Raises:
            LakeError: live files were removed or damaged by others, so that there is no catalog to make.
        """
        with self._guard:
            self._refuse_child()
            if self._remote is not None:
                self.manifest = self._log.replace(self._remote.finish(self.manifest))
                clear_copy(self.root, self._remote.origin, self.manifest)
                return
            if self._cataloged != self.manifest:
                catalog.rebuild_catalog(self.root, self.manifest)
            live_folders.show_manifest(self.root, self.manifest)
            limit = history.find_limit(self.root, self.manifest)
            old = [item for item in self.manifest.retired if item.generation <= limit]
            live = self.manifest.live_paths()
            files.remove_files(self.root, (self.root / item.path for item in old if item.path not in live))
            if old:
                self._store(replace(self.manifest, retired=tuple(i for i in self.manifest.retired if i not in old)))
            files.remove_orphans(self.root, self.manifest)
            files.remove_files(self.root, (self.root / path for path in history.find_superseded(self.root)))
            shutil.rmtree(self.root / files.STAGING, ignore_errors=True)
            session_end.record_end(self.root)

    def _refuse_child(self) -> None:
        if os.getpid() != self._process:
            raise LakeError(f"{self.root}: only process {self._process}, which holds the lock, writes; not its child.")

    def _store(self, manifest: Manifest) -> None:
        self._refuse_child()
        if self._remote is not None:
            manifest = self._remote.replace(manifest)
        self.manifest = self._log.replace(manifest)


@contextmanager
def open_for_writing(root: Path, *, rebuild: bool = False, retention: Retention | None = None) -> Iterator[Writer]:
    """Lock a lake (making it where there is none) and yield its writer; its catalog is brought up to date at the end.

    The lock goes with the process, however that ends, and is not inherited by children.

    Args:
        root: the lake's folder.
        rebuild: whether nothing is live at first, whatever schema version the lake is of.
        retention: how long the lake keeps replaced files from now on; None: as it did.

    Raises:
        LakeLockedError: another process holds the lock.
        LakeError: the folder holds other things than a lake, or cannot be written to.
    """
    refuse_foreign(root, rebuild=rebuild)
    with hold_lock(root):
        (root / WRITER).write_text(f"process {os.getpid()}", encoding="utf-8")
        writer = _open_writer(root, rebuild=rebuild, retention=retention)
        yield writer
        writer.finish()
        (root / WRITER).unlink()


def follow_move(root: Path) -> None:
    """Make the catalog of a lake that was moved or copied again, unless another process writes to it."""
    if os.access(root, os.W_OK) and session_end.has_moved(root):
        with suppress(TracklakeError, OSError):
            refuse_foreign(root)
            with hold_lock(root):  # or the end recorded would be that of a session that began meanwhile
                catalog.rebuild_catalog(root, load(root))
                session_end.record_end(root)


def refuse_if_busy(root: Path, *, rebuild: bool = False) -> None:
    """Raise what `open_for_writing` would raise now, before anything expensive is started for it."""
    refuse_foreign(root, rebuild=rebuild)
    if (root / LOCK).exists():
        with hold_lock(root):
            pass


@contextmanager
def hold_lock(root: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold the lock of a lake, whose folder is made where there is none.

    Args:
        root: the lake's folder.
        wait_s: longest wait for another process, in seconds.
    """
    from filelock import FileLock, Timeout  # its import takes 50 ms, for which no query should wait

    try:
        root.mkdir(parents=True, exist_ok=True)
        held = FileLock(root / LOCK, thread_local=False).acquire(timeout=wait_s, blocking=wait_s > 0)
    except Timeout:
        holder = ""
        with suppress(OSError):
            holder = (root / WRITER).read_text(encoding="utf-8")
        raise LakeLockedError(
            f"{root}: {holder or 'another process'} is writing to this lake. "
            "Wait for it to end, or write to another lake with --lake. Readers need not wait."
        ) from None
    except OSError as denied:
        raise LakeError(
            f"{root}: no lake can be written there ({denied.strerror}). Name another folder with --lake."
        ) from denied
    with held:
        yield


def _open_writer(root: Path, *, rebuild: bool, retention: Retention | None) -> Writer:
    """Load the manifest (or make the first), delete what was half written, and bring the catalog up to date."""
    if (origin := find_origin(root)) is not None:
        remote = RemoteLog(origin, is_rebuild=rebuild)
        log = store_copy(root, remote.begin(retention))
        clear_copy(root, origin, log.manifest)
        return Writer(root, log, log.manifest.generation + 1, remote=remote)
    is_new = rebuild
    log = CommitLog(root, is_rebuild=rebuild)
    try:
        manifest = start_rebuild(root) if rebuild else log.manifest if log.is_migrated else load(root)
        generation = manifest.generation + (not rebuild)
    except LakeMissingError:
        is_new, manifest, generation = True, Manifest(), 1
    if is_new:
        log.replace(manifest)
    shutil.rmtree(root / files.STAGING, ignore_errors=True)
    for folder in session_end.WRITTEN_FOLDERS:
        remove_unfinished(root / folder)
    forget_checksums()
    adopted = replace(live_folders.adopt_files(root, manifest), retention=retention or manifest.retention)
    if adopted != manifest or not log.is_migrated:
        manifest = log.replace(adopted)
    has_catalog = False
    if is_new:
        live_folders.show_manifest(root, manifest)
    elif not session_end.has_ended(root, manifest):
        # Readers of the catalog must not fall behind by more generations than files are kept for.
        with suppress(LakeError):  # files are missing: this session may be the one that makes them again
            catalog.rebuild_catalog(root, manifest)
            has_catalog = True
        live_folders.show_manifest(root, manifest)
    return Writer(root, log, generation, has_catalog=has_catalog)


def refuse_foreign(root: Path, *, rebuild: bool = False) -> None:
    """Refuse a place that is no lake and no place for one, before anything is written there.

    For a rebuild a lake of another schema version will do.

    Raises:
        LakeError: a file, a folder of other things, a manifest that is not ours, or one of another schema version.
    """
    if find_origin(root) is not None:
        return  # made by us
    if root.exists() and not root.is_dir():
        raise LakeError(f"{root}: is a file; a lake is a folder. Name another with --lake.")
    if (root / MANIFEST).exists():
        (start_rebuild if rebuild else load)(root)  # another program's manifest is found out before anything is touched
    elif root.is_dir():
        names = {item.name for item in root.iterdir() if not item.name.startswith(".")}
        foreign = sorted(names - {SETTINGS_FILE})
        if foreign:
            raise LakeError(
                f"{root}: holds other files ({', '.join(foreign[:3])}{', ...' if len(foreign) > 3 else ''}) and is no "
                f"lake (no {MANIFEST}). Name an empty or new folder with --lake."
            )
