"""Where a lake is: a folder of this machine, or an address on an object store."""

from pathlib import Path

from tracklake.pipeline.lake.object_store import ObjectStore, find_address
from tracklake.pipeline.lake.store import LocalStore, Store

LakePlace = Path | str
"""A lake's folder, or its address on an object store."""


def find_place(lake: Path | str) -> LakePlace:
    """Return the place of a lake that a user names: its address, or its folder with links resolved.

    Raises:
        UsageError: an address of another kind, or one with credentials.
    """
    return find_address(lake) or Path(lake).resolve()


def open_store(place: LakePlace) -> Store:
    """Return the objects of a lake.

    Raises:
        UsageError: no address of a lake.
        MissingExtraError: the extra [object-store] is not installed.
    """
    return ObjectStore(place) if isinstance(place, str) else LocalStore(place)
