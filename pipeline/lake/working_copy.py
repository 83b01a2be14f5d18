"""The copy of a lake on an object store in a folder of this machine, on which stages work."""

import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tracklake.pipeline.lake.errors import DamagedShardError, LakeError, LakeMissingError, LakeVersionError
from tracklake.pipeline.lake.lease import hold_lease
from tracklake.pipeline.lake.manifest import MANIFEST, load
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.publication import (
    Transfer,
    claim_place,
    fetch_lake,
    hash_root,
    is_synced,
    publish_lake,
    was_synced,
)
from tracklake.schemas.hashing import hash_text
from tracklake.schemas.text import quote_shell

CACHE = "tracklake"
"""Name of our folder in the user's folder of caches."""


class WorkingCopy:
    """The copy of a lake on an object store.

    Args:
        address: place of the lake.
        folder: place of the copy.
    """

    def __init__(self, address: str, folder: Path) -> None:
        self.address = address
        self.folder = folder
        self._root_at_first = ""
        self._lake_at_first: str | None = None

    @contextmanager
    def hold(self, *, is_rebuild: bool = False) -> Iterator[Transfer | None]:
        """Keep other processes from working on this lake meanwhile, and bring the copy up to date first.

        Yields what was received; None: the copy is up to date, or what was broken off in it is to be gone on with.

        Args:
            is_rebuild: whether the lake is to be made again, so that it need not be readable.

        Raises:
            LakeLockedError: another process works on the lake.
            LakeError: the place holds something else; or it has changed, and the copy has results of its own.
        """
        store = open_store(self.address)
        claim_place(store, None)
        with hold_lease(store, f"process {os.getpid()} on {platform.node()}"):
            self._root_at_first = hash_root(self.address) or ""
            received = self._fetch(is_rebuild=is_rebuild)
            self._lake_at_first = load(self.folder).lake_id if (self.folder / MANIFEST).exists() else None
            yield received

    def _fetch(self, *, is_rebuild: bool) -> Transfer | None:
        """Bring the copy up to date; see `hold`.

        Raises:
            LakeError: it has changed, and the copy has results of its own.
        """
        try:
            if is_synced(self.folder, self.address, remote=True):
                return None
            return fetch_lake(self.address, self.folder)
        except (LakeVersionError, DamagedShardError):
            if is_rebuild:
                return None
            raise
        except LakeMissingError:
            if was_synced(self.folder, self.address):
                raise LakeError(
                    f"{self.address}: no lake is there any more, but {self.folder} holds a copy. Publish it by "
                    f"`tracklake publish store {quote_shell(self.address)} --lake {quote_shell(self.folder)}`, or "
                    "delete that folder."
                ) from None
            return None

    def publish(self, *, rebuilt: bool = False) -> Transfer | None:
        """Send what was made in the copy, in one commit; None: nothing was made there yet.

        Args:
            rebuilt: whether the copy was to be made again, under a new id, and takes the place of the lake.

        Raises:
            LakeError: it was made again, and another process has published meanwhile.
        """
        if not (self.folder / MANIFEST).exists():
            return None
        if rebuilt and load(self.folder).lake_id != self._lake_at_first:
            return publish_lake(self.folder, self.address, replace_other=True, expected=self._root_at_first)
        return publish_lake(self.folder, self.address)


def name_copy(address: str, cache: Path | None = None) -> Path:
    """Return the folder of the copy of a lake.

    Args:
        address: place of the lake.
        cache: folder of all copies; None: in the user's folder of caches.
    """
    if cache is None:
        named = os.environ.get("XDG_CACHE_HOME" if os.name != "nt" else "LOCALAPPDATA")
        cache = (Path(named) if named else Path.home() / ".cache") / CACHE
    readable = re.sub(r"[^A-Za-z0-9]+", "-", address).strip("-")[-60:]
    return cache / f"{readable}-{hash_text(address, 8)}" / "lake"
