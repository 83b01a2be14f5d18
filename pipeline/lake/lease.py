"""The lease of a lake where no lock can be held: it keeps a second coordinator from doing work that would be refused.

It makes nothing safe: that is the root, which is replaced only by who has read it. A coordinator that loses its lease,
as its clock or network stood still, fails at its next commit only if the other has changed the same.
"""

import json
import threading
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

    Args:
        store: where the lake is kept.
        holder: name of this process, for the messages of others.
        lease_s: time until the lease ends unless it is renewed, in seconds.

    Raises:
        LakeLockedError: another process holds it.
    """
    tag = _acquire(store, holder, lease_s)
    ended = threading.Event()

    def renew() -> None:
        nonlocal tag
        while not ended.wait(lease_s / RENEWALS):
            try:
                tag = store.swap(LEASE, _describe(holder, lease_s), tag)
            except SwapConflictError:
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
        _release(store, tag)


def _acquire(store: Store, holder: str, lease_s: float) -> str:
    """Create the lease, or take over one that has ended, and return its tag."""
    try:
        return store.put_new(LEASE, _describe(holder, lease_s))
    except AlreadyStoredError:
        pass
    try:
        content, tag = store.get(LEASE)
        other, end = _read(content)
        if end <= datetime.now(UTC):
            return store.swap(LEASE, _describe(holder, lease_s), tag)
    except (MissingObjectError, SwapConflictError):  # given back or taken over just now
        other, end = "another process", datetime.now(UTC)
    free = end.astimezone().isoformat(timespec="seconds")
    raise LakeLockedError(
        f"{store.place}: {other} is writing to this lake. Wait for it to end, or write to another lake with --lake. "
        f"If it was killed, the lake is free at {free}. Readers need not wait."
    )


def _release(store: Store, tag: str) -> None:
    """Give a lease back, unless another process has taken it over."""
    try:
        if store.get(LEASE)[1] == tag:
            store.delete([LEASE])
    except TracklakeError:  # it ends by itself
        return


def _describe(holder: str, lease_s: float) -> bytes:
    end = datetime.now(UTC) + timedelta(seconds=lease_s)
    return json.dumps({"holder": holder, "ends": end.isoformat()}).encode()


def _read(content: bytes) -> tuple[str, datetime]:
    """Return holder and end of a lease; one that is damaged has ended."""
    try:
        found = json.loads(content)
        return str(found["holder"]), datetime.fromisoformat(found["ends"]).astimezone()
    except (ValueError, KeyError, TypeError):
        return "another process", datetime.now(UTC)
