"""The folder of a bucket that is a lake's own: claimed before anything is written there, and swept of old objects."""

import re
from datetime import UTC, datetime, timedelta

from tracklake.pipeline.lake.errors import (
    DamagedShardError,
    LakeError,
    LakeMissingError,
    MissingObjectError,
    SwapConflictError,
)
from tracklake.pipeline.lake.history import ROOTS, list_roots, name_root, read_kept_root
from tracklake.pipeline.lake.lease import LEASE
from tracklake.pipeline.lake.manifest import (
    MANIFEST,
    collect_document,
    make_foreign_error,
    parse_manifest,
    read_root,
)
from tracklake.pipeline.lake.object_access import DIGEST_DIGITS, name_object
from tracklake.pipeline.lake.object_store import PROBES, refuse_unconditional
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.shards import parse_shards
from tracklake.pipeline.lake.store import Store, swap_own

MARKER = ".tracklake"
"""First object of a lake on an object store, with the lake's id: what else is there was put there by us."""
GRACE = timedelta(days=1)
"""Time for which objects that are no longer needed are kept, for readers of an earlier state and for other writers."""
OWN_OBJECTS = re.compile(
    r"manifest/[0-9a-f]{64}\.json|manifest/roots/\d+\.json|\.probe-[^/]*"
    rf"|(\.files|tensors|reports|models)/.*\.[0-9a-f]{{{DIGEST_DIGITS}}}(\.[^./]*)?"
)
"""Names of the objects that a lake makes and may delete. Others stay."""
TOPS = (f"/{MARKER}", f"/{MANIFEST}")
"""Ends of the paths of objects that stand at the top of a lake in a folder below."""


def claim_place(store: Store, lake_id: str | None, *, replace_other: bool = False) -> None:
    """Make sure that a place on an object store is a lake's own, before anything else is written there.

    Args:
        store: the place.
        lake_id: lake that is to be there; None: any, as where it is not made yet, and nothing is written.
        replace_other: whether it may take the place of another lake.

    Raises:
        StoreError: the store ignores the conditions of writes.
        LakeError: another lake or something else is there.
    """
    try:
        owner = read_root(store.place).get("lake_id")
        if not isinstance(owner, str):
            raise make_foreign_error(store.place, ValueError("no lake_id in it"))
    except LakeMissingError:
        owner = read_marker(store)
    if owner is None:
        other = next((item for item in store.list() if item.path != LEASE and not item.path.startswith(PROBES)), None)
        if other is not None:
            raise LakeError(
                f"{store.place}: holds other objects, such as {other.path}, and no lake. Name an empty or new folder "
                "of the bucket."
            )
    elif lake_id not in (None, owner) and not replace_other:
        raise LakeError(
            f"{store.place}: holds another lake ({owner}). Name another folder of the bucket, or give --replace to put "
            "this one in its place."
        )
    refuse_unconditional(store)
    if owner is None and lake_id is not None:
        try:
            swap_own(store, MARKER, lake_id.encode(), None)
        except SwapConflictError:
            raise LakeError(f"{store.place}: another process has just put a lake there. Run again.") from None


def read_marker(store: Store) -> str | None:
    """Return the id of the lake whose first publication was broken off, if there was one."""
    try:
        return store.get(MARKER)[0].decode(errors="replace")
    except MissingObjectError:
        return None


def sweep_objects(address: str) -> int:
    """Delete the objects of a lake that none of its kept states needs; returns how many.

    States are kept as in a folder, and for a day. What is younger than a day is kept, too: another writer may be about
    to commit it. So is all that belongs to a lake in a folder below this one.
    """
    store = open_store(address)
    objects = [*store.list()]
    young = {item.path for item in objects if item.modified > datetime.now(UTC) - GRACE}
    others = (read_kept_root(store, path) for path in young if path.startswith(f"{ROOTS}/"))
    needed = {MANIFEST, MARKER, LEASE}
    *kept, present = list_roots(address)
    for document in (present, *kept, *(each for each in others if each is not None)):
        needed |= {name_root(document["generation"]), *(shard.path for shard in parse_shards(document))}
        try:
            commits = parse_manifest(address, collect_document(address, document)).commits.values()
        except DamagedShardError:
            if document is present:
                raise
            continue  # this earlier state cannot be read
        needed |= {name_object(file) for commit in commits for file in commit.all_files}
    inner = tuple(f"{item.path.rpartition('/')[0]}/" for item in objects if item.path.endswith(TOPS))
    old = {item for item in objects if item.path not in needed | young and OWN_OBJECTS.fullmatch(item.path)}
    old = {item for item in old if not item.path.startswith(inner)}
    old &= {*store.list()} if old else set()  # what another writer has sent again meanwhile has another time
    store.delete(item.path for item in old)
    return len(old)
