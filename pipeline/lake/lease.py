"""The lease of a lake where no lock can be held: it keeps a second coordinator from doing work that would be refused.

It makes nothing safe: that is the root, which is replaced only by who has read it. A coordinator that loses its lease,
as its clock or network stood still, fails at its next commit only if the other has changed the same.
"""

import json
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta

from tracklake.pipeline.lake.errors import AlreadyStoredError, LakeLockedError, MissingObjectError, SwapConflictError
from tracklake.pipeline.lake.store import Store
from tracklake.schemas.errors import TracklakeError

LEASE = ".lease"
"""Object of the lake that names who writes to it, and until when."""
LEASE_S = 120.0
"""Time after which the lease of a coordinator that ended without a word is free, in seconds."""
RENEWALS = 4
"""Times that a lease is renewed before it would end."""


@contextmanager
def hold_lease(store: Store, holder: str, lease_s: float = LEASE_S) -> Iterator[None]:
    """Hold the lease of a lake, renewed in the background until the block ends.

    Each has an id: a request whose answer was lost may be refused when it is repeated, and is found to have succeeded.

    Args:
        store: where the lake is kept.
        holder: name of this process, for the messages of others.
        lease_s: time until the lease ends unless it is renewed, in seconds.

    Raises:
        LakeLockedError: another process holds it.
    """
    own = uuid.uuid4().hex
    tag = _acquire(store, own, holder, lease_s)
    ended = threading.Event()

    def renew() -> None:
        nonlocal tag
        while not ended.wait(lease_s / RENEWALS):
            try:
                tag = _swap(store, own, _describe(own, holder, lease_s), tag)
            except (SwapConflictError, MissingObjectError):
                return  # taken over; the root decides whose commits count
            except TracklakeError:
                continue  # the network may be back before the lease ends

    renewal = threading.Thread(target=renew, name="lease", daemon=True)
    renewal.start()
    try:
        yield
    finally:
        ended.set()
        renewal.join()
        _release(store, own)


def is_held(store: Store) -> bool:
    """Return whether a coordinator works on a lake, or died a short while ago."""
    try:
        return _read(store.get(LEASE)[0])[1] > datetime.now(UTC)
    except MissingObjectError:
        return False


def _acquire(store: Store, own: str, holder: str, lease_s: float) -> str:
    """Create the lease, or take over one that has ended, and return its tag."""
    try:
        return store.put_new(LEASE, _describe(own, holder, lease_s))
    except AlreadyStoredError:
        pass
    try:
        content, tag = store.get(LEASE)
        other, end, found = _read(content)
        if found == own:  # created, but the store's answer was lost
            return tag
        if end <= datetime.now(UTC):
            return _swap(store, own, _describe(own, holder, lease_s), tag)
    except (MissingObjectError, SwapConflictError):  # given back or taken over just now
        other, end = "another process", datetime.now(UTC)
    free = end.astimezone().isoformat(timespec="seconds")
    raise LakeLockedError(
        f"{store.place}: {other} is writing to this lake. Wait for it to end, or write to another lake with --lake. "
        f"If it was killed, the lake is free at {free}. Readers need not wait."
    )


def _swap(store: Store, own: str, content: bytes, tag: str) -> str:
    """Replace the lease, or find that an earlier attempt did, whose answer was lost; returns its tag.

    Raises:
        SwapConflictError: it is another process's.
        MissingObjectError: it was given back.
    """
    try:
        return store.swap(LEASE, content, tag)
    except SwapConflictError:
        found, tag = store.get(LEASE)
        if _read(found)[2] == own:
            return tag
        raise


def _release(store: Store, own: str) -> None:
    """Give a lease back, unless another process has taken it over."""
    try:
        if _read(store.get(LEASE)[0])[2] == own:
            store.delete([LEASE])
    except TracklakeError:  # it ends by itself
        return


def _describe(own: str, holder: str, lease_s: float) -> bytes:
    end = datetime.now(UTC) + timedelta(seconds=lease_s)
    return json.dumps({"id": own, "holder": holder, "ends": end.isoformat()}).encode()


def _read(content: bytes) -> tuple[str, datetime, str | None]:
    """Return holder, end and id of a lease; one that is damaged has ended."""
    try:
        found = json.loads(content)
        return str(found["holder"]), datetime.fromisoformat(found["ends"]).astimezone(), found.get("id")
    except (ValueError, KeyError, TypeError):
        return "another process", datetime.now(UTC), None
