"""The copy of a lake on an object store in a folder of this machine, on which stages work."""

import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tracklake.pipeline.lake.errors import LakeError, LakeMissingError
from tracklake.pipeline.lake.lease import hold_lease
from tracklake.pipeline.lake.manifest import MANIFEST
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.publication import Transfer, claim_place, fetch_lake, is_synced, publish_lake, was_synced
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

    @contextmanager
    def hold(self) -> Iterator[Transfer | None]:
        """Keep other processes from working on this lake meanwhile, and bring the copy up to date first.

        Yields what was received; None: the copy is up to date, or what was broken off in it is to be gone on with.

        Raises:
            LakeLockedError: another process works on the lake.
            LakeError: the place holds something else; or it has changed, and the copy has results of its own.
        """
        store = open_store(self.address)
        claim_place(store, None)
        with hold_lease(store, f"process {os.getpid()} on {platform.node()}"):
            yield self._fetch()

    def _fetch(self) -> Transfer | None:
        """Bring the copy up to date; see `hold`.

        Raises:
            LakeError: it has changed, and the copy has results of its own.
        """
        try:
            if is_synced(self.folder, self.address, remote=True):
                return None
            return fetch_lake(self.address, self.folder)
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
            rebuilt: whether the copy was made again, under a new id, and takes the place of the lake.
        """
        if not (self.folder / MANIFEST).exists():
            return None
        return publish_lake(self.folder, self.address, replace_other=rebuilt)


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
