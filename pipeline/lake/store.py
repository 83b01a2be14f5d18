"""Where a lake's objects are kept: one small set of operations for a folder of this machine and for object stores.

An object appears whole or not at all. Two operations are conditional: `put_new` never replaces an object, and `swap`
replaces only the content whose tag the caller has read. All that makes commits safe rests on these two.
"""

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, Protocol

from tracklake.pipeline.lake.errors import AlreadyStoredError, MissingObjectError, StoreError, SwapConflictError
from tracklake.schemas.errors import FileAccessError, explain_file_errors
from tracklake.schemas.files import is_unfinished, write_file
from tracklake.schemas.hashing import hash_chunks


class StoredObject(NamedTuple):
    """An object as a store lists it: its path in the lake, its size in bytes, and the time it was written (UTC)."""

    path: str
    bytes: int
    modified: datetime


class Store(Protocol):
    """The objects of one lake, by paths relative to its root with forward slashes."""

    @property
    def place(self) -> str:
        """Folder or address of the lake, for messages."""

    def put_new(self, path: str, data: bytes) -> str:
        """Create an object and return its tag.

        Raises:
            AlreadyStoredError: there is one at this path, which stays as it is.
        """

    def swap(self, path: str, data: bytes, tag: str | None) -> str:
        """Replace an object that still has the tag (None: create it), and return its new tag.

        Raises:
            SwapConflictError: another writer has replaced, created or deleted it; nothing was changed.
        """

    def get(self, path: str) -> tuple[bytes, str]:
        """Return an object's content and its tag.

        Raises:
            MissingObjectError: there is none.
        """

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        """Yield the objects in a folder and in those below it, in no particular order."""

    def delete(self, paths: Iterable[str]) -> None:
        """Delete objects; those that are gone already are no error."""

    def upload(self, path: str, file: Path) -> None:
        """Write an object from a file, piece by piece; one at the same path is replaced.

        Safe only under a path that names the content, such as one with its checksum.
        """

    def download(self, path: str, file: Path) -> None:
        """Write an object's content to a file, piece by piece; the file appears whole or not at all.

        Raises:
            MissingObjectError: there is no such object.
        """


def swap_own(store: Store, path: str, data: bytes, tag: str | None) -> str:
    """Swap content that no other writer makes: found there after an error, it was stored, and the answer lost.

    A client repeats a request without an answer, and then learns that another writer was first. Raises as `swap`.
    """
    try:
        return store.swap(path, data, tag)
    except StoreError:
        with suppress(StoreError):
            found, stored = store.get(path)
            if found == data:
                return stored
        raise


def find_tag(store: Store, path: str) -> str | None:
    """Return the tag of an object; None: there is none."""
    try:
        return store.get(path)[1]
    except MissingObjectError:
        return None


class LocalStore:
    """A lake's folder on a disk of this machine.

    `put_new` and `swap` look first and write then, so that the caller must hold the lake's lock (see `writer`); readers
    need none. A tag is the sha256 of the content.

    Args:
        root: the lake's folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    @property
    def place(self) -> str:
        """The lake's folder, for messages."""
        return str(self._root)

    def put_new(self, path: str, data: bytes) -> str:
        """Create a file; see `Store`."""
        if (self._root / path).exists():
            raise AlreadyStoredError(f"{self._root / path}: exists already, and is never replaced")
        return self._write(path, data)

    def swap(self, path: str, data: bytes, tag: str | None) -> str:
        """Replace a file whose content still has this sha256; see `Store`."""
        try:
            found: str | None = self.get(path)[1]
        except MissingObjectError:
            found = None
        if found != tag:
            raise SwapConflictError(f"{self._root / path}: was changed by another program while it was being replaced")
        return self._write(path, data)

    def get(self, path: str) -> tuple[bytes, str]:
        """Return a file's content and its sha256; see `Store`."""
        file = self._root / path
        try:
            with explain_file_errors(file):
                data = file.read_bytes()
        except FileAccessError as failed:
            if isinstance(failed.__cause__, FileNotFoundError | NotADirectoryError):
                raise MissingObjectError(f"{file}: there is no such file") from failed
            raise
        return data, hash_chunks([data])

    def list(self, prefix: str = "") -> Iterator[StoredObject]:
        """Yield the files in a folder of the lake, without those that are not whole yet; see `Store`."""
        for folder, _, names in os.walk(self._root / prefix):
            for file in (Path(folder, name) for name in names if not is_unfinished(name)):
                status = file.stat()
                modified = datetime.fromtimestamp(status.st_mtime, UTC)
                yield StoredObject(file.relative_to(self._root).as_posix(), status.st_size, modified)

    def delete(self, paths: Iterable[str]) -> None:
        """Delete files; folders that become empty stay. See `Store`."""
        for path in paths:
            with explain_file_errors(self._root / path):
                (self._root / path).unlink(missing_ok=True)

    def upload(self, path: str, file: Path) -> None:
        """Copy a file into the lake; see `Store`."""
        target = self._root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        _copy(file, target)

    def download(self, path: str, file: Path) -> None:
        """Copy a file out of the lake; see `Store`."""
        if not (self._root / path).is_file():
            raise MissingObjectError(f"{self._root / path}: there is no such file")
        _copy(self._root / path, file)

    def _write(self, path: str, data: bytes) -> str:
        target = self._root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        write_file(target, data)
        return hash_chunks([data])


def _copy(source: Path, target: Path) -> None:
    """Copy a file; the copy appears whole or not at all."""
    with source.open("rb") as stream:
        write_file(target, lambda out: shutil.copyfileobj(stream, out))
