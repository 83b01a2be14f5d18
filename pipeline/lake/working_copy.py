"""The copy of a lake on an object store in a folder of this machine, and the workspaces in which its jobs are built.

The copy has the manifest, the report and the models; tables and tensors are received when they are read. What is made
is sent at once, and committed at the store.
"""

import os
import platform
import re
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import DamagedShardError, LakeLockedError, LakeMissingError, LakeVersionError
from tracklake.pipeline.lake.files import REPORTS, STORE, TENSORS
from tracklake.pipeline.lake.lease import hold_lease
from tracklake.pipeline.lake.manifest import MANIFEST, LakeFile, Manifest, load
from tracklake.pipeline.lake.object_folder import GRACE, claim_place
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.lake.origin import Origin, find_origin
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.remote_log import store_copy
from tracklake.pipeline.lake.transfers import fetch_files, trim_cache
from tracklake.pipeline.lake.writer import hold_lock
from tracklake.schemas.hashing import hash_text

FIRST_COPY_S = 30.0
"""Longest wait for another process that makes the copy of a lake at the same time, in seconds."""
CACHE = "tracklake"
"""Name of our folder in the user's folder of caches."""


def locate_origin(lake: Path | str, cache: Path | None = None, cache_gb: float = 0.0) -> Origin | None:
    """Return what this machine holds of a lake on an object store; None: it is a whole lake in a folder.

    Args:
        lake: address of the lake, or a folder.
        cache: folder of all copies; None: in the user's folder of caches.
        cache_gb: size up to which its contents are kept, in GB.
    """
    address = find_address(lake)
    if address is None:
        return find_origin(Path(lake))
    if cache is None:
        named = os.environ.get("XDG_CACHE_HOME" if os.name != "nt" else "LOCALAPPDATA")
        cache = (Path(named) if named else Path.home() / ".cache") / CACHE
    readable = re.sub(r"[^A-Za-z0-9]+", "-", address).strip("-")[-60:]
    return Origin(address, (cache / f"{readable}-{hash_text(address, 8)}").absolute(), cache_gb)


@contextmanager
def hold_copy(origin: Origin, *, is_rebuild: bool = False) -> Iterator[Path]:
    """Keep other processes from working on a lake meanwhile, and yield the folder of its copy, up to date.

    Args:
        origin: the lake.
        is_rebuild: whether the lake is to be made again, so that it need not be readable.

    Raises:
        LakeLockedError: another process works on the lake.
        LakeError: the place holds something else.
    """
    store = open_store(origin.address)
    claim_place(store, None)
    with hold_lease(store, f"process {os.getpid()} on {platform.node()}"):
        try:
            refresh_copy(origin)
        except LakeMissingError:
            (origin.copy / MANIFEST).unlink(missing_ok=True)
        except (LakeVersionError, DamagedShardError):
            if not is_rebuild:
                raise
        yield origin.copy
    trim_cache(origin)


def refresh_copy(origin: Origin) -> Path:
    """Bring the copy of a lake up to date, and return its folder; while another process writes to it, it is so already.

    Raises:
        LakeLockedError: another process makes the lake again in the copy, where half of it is to be seen.
        LakeError: no lake is there, or it cannot be read.
    """
    origin.mark(origin.copy)
    manifest = load(origin.address)
    is_new = not (origin.copy / MANIFEST).exists()
    try:
        with hold_lock(origin.copy, wait_s=FIRST_COPY_S if is_new else 0.0):
            store_copy(origin.copy, manifest)
    except LakeLockedError:
        if is_new or load(origin.copy).lake_id != manifest.lake_id:
            raise
    small = [file for commit in manifest.commits.values() if not commit.tail for file in commit.all_files]
    fetch_files(origin.copy, [file for file in small if not file.path.startswith((f"{STORE}/", f"{TENSORS}/"))])
    return origin.copy


def list_report(manifest: Manifest) -> list[LakeFile]:
    """Return the files of a lake's report, with the pages of all subsets."""
    return [file for commit in manifest.commits.values() for file in commit.files.get(REPORTS, ())]


@contextmanager
def open_workspace(origin: Origin, part: Manifest) -> Iterator[Path]:
    """Yield a folder with a part of a lake, in which jobs are built; it is deleted at the end: their results were sent.

    Args:
        origin: the lake.
        part: the commits that the job may read.
    """
    _sweep(origin.workspaces)
    _sweep(origin.staging)
    folder = origin.workspaces / uuid.uuid4().hex
    root = folder / origin.copy.name
    try:
        origin.mark(root)
        CommitLog(root).replace(part)
        yield root
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        trim_cache(origin)


def _sweep(folder: Path) -> None:
    """Delete what killed processes left in a folder a day ago."""
    with suppress(FileNotFoundError):
        for item in folder.iterdir():
            if item.stat().st_mtime < time.time() - GRACE.total_seconds():
                shutil.rmtree(item, ignore_errors=True)
