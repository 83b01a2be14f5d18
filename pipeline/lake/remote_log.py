"""The manifest of a lake on an object store, as the writer of its copy replaces it: there first, then in the copy."""

import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from tracklake.pipeline.lake.checksums import forget_checksums
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.files import STAGING, STORE, find_orphans, remove_files
from tracklake.pipeline.lake.history import find_superseded
from tracklake.pipeline.lake.manifest import MANIFEST, Manifest, Retention
from tracklake.pipeline.lake.object_folder import claim_place, read_marker, sweep_objects
from tracklake.pipeline.lake.origin import Origin
from tracklake.pipeline.lake.shards import SHARDS


class RemoteLog:
    """The stored manifest of a lake on an object store, while a writing session goes on.

    What is replaced or made again is not retired here: the store keeps objects for earlier states by itself.

    Args:
        origin: the lake and its copy.
        is_rebuild: whether the lake is made again; readers then see its earlier state until `finish`.

    Raises:
        StoreError: the store cannot be used, or does not guard against two writers.
        LakeError: the place holds something else.
    """

    def __init__(self, origin: Origin, *, is_rebuild: bool) -> None:
        self.origin = origin
        self._is_held_back = is_rebuild
        self._log = CommitLog(origin.address, is_rebuild=is_rebuild)

    def begin(self, retention: Retention | None) -> Manifest:
        """Claim the place, and return the manifest from which the session starts."""
        before = self._log.manifest
        if before.lake_id:
            manifest = before
        else:
            owner = None if self._is_held_back else read_marker(self._log.store)
            manifest = Manifest(owner) if owner else Manifest()
        claim_place(self._log.store, manifest.lake_id, replace_other=self._is_held_back)
        return replace(manifest, retention=retention or manifest.retention)

    def replace(self, manifest: Manifest) -> Manifest:
        """Store a manifest, and return what is stored then; that may hold the changes of other processes, too.

        Raises:
            LakeError: a file was not sent, or another process has changed the same.
        """
        before = self._log.manifest
        for key, commit in manifest.commits.items():
            if commit is not before.commits.get(key) and any(file.sha256 is None for file in commit.all_files):
                raise LakeError(f"{self.origin.address}: files of {key} were not sent before they were committed.")
        generation = max(manifest.generation, before.generation)
        published = replace(manifest, generation=generation, retired=(), ingested_from=())
        if not self._is_held_back and published != before:
            published = self._log.replace(published)
        return replace(published, ingested_from=manifest.ingested_from)

    def finish(self, manifest: Manifest) -> Manifest:
        """Store what was held back, and delete objects that no kept state needs; returns what is stored."""
        self._is_held_back = False
        stored = self.replace(manifest)
        sweep_objects(self.origin.address)
        return stored


def store_copy(root: Path, manifest: Manifest) -> CommitLog:
    """Make a manifest that of a lake's copy, and return where it is stored; the copy alone knows where files came from.

    Args:
        root: folder of the copy.
        manifest: what the lake's address holds.
    """
    log = None
    with suppress(LakeError, ValueError):  # of another version, or damaged
        log = CommitLog(root)
    if log is None or log.manifest.lake_id != manifest.lake_id:
        (root / MANIFEST).unlink(missing_ok=True)
        shutil.rmtree(root / SHARDS, ignore_errors=True)
        log = CommitLog(root)
    wanted = replace(manifest, ingested_from=log.manifest.ingested_from)
    if wanted != log.manifest:
        log.replace(wanted)
    return log


def clear_copy(root: Path, origin: Origin, manifest: Manifest) -> None:
    """Delete what a session leaves in the copy of a lake: all that was made there is on the store."""
    for folder in (root / STORE, root / STAGING, origin.staging):
        shutil.rmtree(folder, ignore_errors=True)
    remove_files(root, find_orphans(root, manifest))  # tensors
    remove_files(root, (root / path for path in find_superseded(root)))
    forget_checksums()
