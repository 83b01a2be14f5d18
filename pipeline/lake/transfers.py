"""Files of a lake on their way to and from an object store, and those that this machine keeps of them."""

import os
import shutil
import threading
import uuid
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import time_ns
from typing import TypeVar

from tracklake.pipeline.lake.checksums import find_damage, hash_file, verify_files
from tracklake.pipeline.lake.errors import DamagedFileError, MissingObjectError
from tracklake.pipeline.lake.manifest import Commit, LakeFile
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.origin import Origin, find_origin, reserve_content
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.store import Store
from tracklake.schemas.text import quote_shell

T = TypeVar("T")

TRANSFERS = 8
"""Files that are sent or received at once."""
TRIES = 3
"""Times that a file is received again which another process drops from the cache meanwhile."""
READING_S = 60.0
"""Time for which a content that was received to be read is kept at least, in seconds."""
TRIM_SHARE = 0.05
"""Share of the cache's limit that may be added before what is kept is looked at again."""
_ADDED: dict[Path, float] = {}
"""Bytes that this process has added to a cache since it was trimmed last."""
_GUARD = threading.Lock()


def transfer(function: Callable[[T], None], items: Iterable[T]) -> None:
    """Call a function for several items at once; after an error, those that were not begun are left out."""
    pool = ThreadPoolExecutor(TRANSFERS)
    try:
        for _ in pool.map(function, items):
            pass
    finally:
        pool.shutdown(cancel_futures=True)


def receive_file(store: Store, file: LakeFile, target: Path, advice: str) -> None:
    """Receive the content of a file, and compare it with its checksum.

    Raises:
        DamagedFileError: the object is missing or has other bytes; the message ends with the advice.
    """
    name = name_object(file)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        store.download(name, target)
    except MissingObjectError as gone:
        raise DamagedFileError(f"{store.place}/{name}: is no longer on the store. {advice}") from gone
    reason = find_damage(target.parent, replace(file, path=target.name), again=True)
    if reason is not None:
        target.unlink()
        raise DamagedFileError(f"{store.place}/{name}: damaged ({reason}). Delete this object. {advice}")


def fetch_files(root: Path, files: Iterable[LakeFile]) -> None:
    """Receive files that a folder with a part of a lake lacks; in a whole lake there is nothing to do.

    Raises:
        DamagedFileError: an object is missing or damaged.
        StoreError: the store cannot be reached.
    """
    origin = find_origin(root)
    if origin is not None:
        fetch_objects(origin, [file for file in files if find_damage(root, file) is not None], root)


def fetch_objects(origin: Origin, files: Iterable[LakeFile], root: Path | None = None) -> None:
    """Receive the contents of files into the cache of this machine, unless they are there; raises as `fetch_files`.

    Args:
        origin: the lake and the cache.
        files: files with checksums.
        root: folder in which the files get their own names, too; None: nowhere.
    """
    if root is None:
        trim_cache(origin)
    store = open_store(origin.address)
    advice = f"`tracklake run SOURCE --lake {quote_shell(origin.address)}` on the raw files makes it again."

    def fetch(file: LakeFile) -> None:
        kept = origin.objects / name_object(file)
        if find_damage(kept.parent, replace(file, path=kept.name)) is not None:
            with origin.explain_errors(kept):
                receive_file(store, file, kept, advice)
            _count_added(origin, file.bytes)
        if reserve_content(kept, 0.0 if root is not None else READING_S) is None:
            raise FileNotFoundError(kept)
        if root is not None:
            _link(kept, root / file.path)

    def fetch_again(file: LakeFile) -> None:
        for _ in range(TRIES):
            with suppress(FileNotFoundError):  # another process has just dropped it from the cache
                return fetch(file)
        return fetch(file)

    transfer(fetch_again, files)


def send_commits(root: Path, commits: Sequence[Commit]) -> list[Commit]:
    """Send the files of commits that were made in a folder with a part of a lake; a whole lake's commits stay as is.

    Returns the commits with a checksum for every file: from then on the coordinator may commit them.

    Raises:
        DamagedFileError: a file has vanished, or is not as it was written.
    """
    origin = find_origin(root)
    if origin is None:
        return [*commits]
    store = open_store(origin.address)
    sealed = [seal_commit(root, commit) for commit in commits]

    def send(file: LakeFile) -> None:
        verify_files(root, [file])
        store.upload(name_object(file), root / file.path)
        _link(root / file.path, origin.objects / name_object(file))
        _count_added(origin, file.bytes)

    transfer(send, {file.path: file for commit in sealed for file in commit.all_files}.values())
    return sealed


def seal_commit(root: Path, commit: Commit) -> Commit:
    """Return a commit in which every file has a checksum, also those that may change, as they are now."""

    def seal(file: LakeFile) -> LakeFile:
        if file.sha256 is not None:
            return file
        try:
            return replace(file, bytes=(root / file.path).stat().st_size, sha256=hash_file(root / file.path))
        except FileNotFoundError:
            raise DamagedFileError(
                f"{root / file.path}: is missing. `tracklake run SOURCE --lake {quote_shell(root)}` makes it again."
            ) from None

    return replace(commit, files={table: [seal(file) for file in files] for table, files in commit.files.items()})


def trim_cache(origin: Origin) -> None:
    """Delete the contents that were used longest ago, down to the cache's limit; they are received again on use.

    Those that a process reads (`reserve_content`) stay.
    """
    limit = origin.cache_gb * 1e9
    with _GUARD:
        if _ADDED.get(origin.cache, limit) < limit * TRIM_SHARE:
            return
        _ADDED[origin.cache] = 0.0
    found = []
    for folder, _, names in os.walk(origin.objects):
        for path in (Path(folder, name) for name in names):
            with suppress(FileNotFoundError):  # another process trims, too
                status = path.stat()
                found.append((status.st_atime_ns, status.st_size, path))
    size = sum(each[1] for each in found)
    for used, each, path in sorted(found):
        if size <= limit or used > time_ns():
            return
        with suppress(FileNotFoundError):
            if path.stat().st_atime_ns == used:  # not used since
                path.unlink()
                size -= each


def _count_added(origin: Origin, size: int) -> None:
    with _GUARD:
        if origin.cache in _ADDED:
            _ADDED[origin.cache] += size


def _link(content: Path, name: Path) -> None:
    """Give a content another name, in place of what has it; a copy where there are no hard links."""
    name.parent.mkdir(parents=True, exist_ok=True)
    aside = name.with_name(f".{name.name}.{uuid.uuid4().hex}.tmp")
    try:
        try:
            os.link(content, aside)
        except FileNotFoundError:
            raise
        except OSError:
            shutil.copy2(content, aside)
        aside.replace(name)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
