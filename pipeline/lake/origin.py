"""Folders of this machine that hold only a part of a lake on an object store, and the cache that they share.

Such a folder is a lake's copy, with its whole manifest, or the workspace of a job, with a part of it. Its manifest
names files that need not be there: they are on the store, and are received when they are read.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import time_ns
from typing import NamedTuple

from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import FileAccessError, explain_file_errors
from tracklake.schemas.files import write_file

ORIGIN = ".origin"
"""File of such a folder that says where the rest of the lake is."""


class Origin(NamedTuple):
    """The lake that a folder holds a part of.

    Args:
        address: place of the lake on an object store.
        cache: folder of this machine for what it holds of this lake.
        cache_gb: size up to which contents are kept there, in GB.
    """

    address: str
    cache: Path
    cache_gb: float

    @property
    def objects(self) -> Path:
        """Folder for contents, each under the name of its object."""
        return self.cache / "objects"

    @property
    def copy(self) -> Path:
        """Folder of the copy in which commands work."""
        return self.cache / "lake"

    @property
    def workspaces(self) -> Path:
        """Folder for the folders in which single jobs are built."""
        return self.cache / "work"

    @property
    def staging(self) -> Path:
        """Folder for what was read of raw files that hold several recordings."""
        return self.cache / "staging"

    def mark(self, root: Path) -> None:
        """Make a folder one that holds a part of this lake."""
        described = {"address": self.address, "cache": str(self.cache), "cache_gb": self.cache_gb}
        with self.explain_errors(root):
            root.mkdir(parents=True, exist_ok=True)
            write_file(root / ORIGIN, json.dumps(described).encode())

    @contextmanager
    def explain_errors(self, path: Path) -> Iterator[None]:
        """Say of an error on a file or folder here what it is for.

        Raises:
            FileAccessError: the block raised one, or an OSError.
        """
        try:
            with explain_file_errors(path):
                yield
        except FileAccessError as failed:
            raise FileAccessError(
                f"{failed} This is the cache of {self.address}: make room there, or name another folder with the "
                "setting `cache`."
            ) from failed.__cause__


def reserve_content(kept: Path, seconds: float) -> int | None:
    """Keep what a cache holds from being dropped for some time, and return its size in bytes; None: it is not there.

    Until when is noted in the time of the last access, which is that of the last use otherwise.
    """
    try:
        status = kept.stat()  # its checksum is known by the time of its last change, which stays
        until = max(status.st_atime_ns, time_ns() + int(seconds * 1e9))
        os.utime(kept, ns=(until, status.st_mtime_ns))
    except FileNotFoundError:
        return None
    return status.st_size


def find_origin(root: Path) -> Origin | None:
    """Return the lake that a folder holds a part of; None: it holds a whole one, or none."""
    try:
        found = read_json(root / ORIGIN)
        return Origin(found["address"], Path(found["cache"]), found["cache_gb"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
