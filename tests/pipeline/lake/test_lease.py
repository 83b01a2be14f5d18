"""The lease of a lake: one holder at a time, given back at the end, free after the time of one that died."""

import json
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tracklake.pipeline.lake.errors import (
    AlreadyStoredError,
    LakeLockedError,
    MissingObjectError,
    StoreError,
    SwapConflictError,
)
from tracklake.pipeline.lake.lease import LEASE, hold_lease
from tracklake.pipeline.lake.store import LocalStore
from tracklake.schemas.errors import TracklakeError


@pytest.fixture
def store(tmp_path: Path) -> LocalStore:
    return LocalStore(tmp_path)


def leave(store: LocalStore, content: bytes) -> None:
    """What a process that was killed leaves."""
    store.put_new(LEASE, content)


def test_a_second_holder_is_told_who_holds_it_and_until_when(store):
    with hold_lease(store, "process 7 on north"):
        content, _ = store.get(LEASE)
        end = datetime.fromisoformat(json.loads(content)["ends"])
        assert timedelta(seconds=100) < end - datetime.now(UTC) <= timedelta(seconds=120)
        with pytest.raises(LakeLockedError, match="process 7 on north is writing") as refused, hold_lease(store, "8"):
            pass
        assert end.astimezone().isoformat(timespec="seconds") in str(refused.value)
    with hold_lease(store, "process 8"):
        pass
    with pytest.raises(MissingObjectError):
        store.get(LEASE)


@pytest.mark.parametrize(
    "content", [b"", b"{}", b'{"holder": "x", "ends": "soon"}', b'{"holder": "x", "ends": "2001-01-01"}']
)
def test_a_lease_that_has_ended_or_is_damaged_is_taken_over(store, content):
    leave(store, content)
    with hold_lease(store, "me"):
        assert json.loads(store.get(LEASE)[0])["holder"] == "me"


def test_it_is_renewed_while_the_block_lasts(store):
    with hold_lease(store, "me", lease_s=0.2):
        first = json.loads(store.get(LEASE)[0])["ends"]
        limit = time.monotonic() + 20
        while json.loads(store.get(LEASE)[0])["ends"] == first and time.monotonic() < limit:
            time.sleep(0.01)
        assert json.loads(store.get(LEASE)[0])["ends"] > first


class Forgetful(LocalStore):
    """A store whose answer to each other write is lost, as a client sees it after it repeated the request or not."""

    def __init__(self, root: Path, error: TracklakeError) -> None:
        super().__init__(root)
        self.error, self.swaps = error, 0

    def put_new(self, path, data):
        super().put_new(path, data)
        raise AlreadyStoredError(path)

    def swap(self, path, data, tag):
        written = super().swap(path, data, tag)
        self.swaps += 1
        if self.swaps % 2:
            raise self.error
        return written


@pytest.mark.parametrize("error", [SwapConflictError("conflict"), StoreError("timeout")])
def test_an_answer_that_was_lost_does_not_end_it(tmp_path, error):
    store = Forgetful(tmp_path, error)
    with hold_lease(store, "me", lease_s=0.4):
        limit = time.monotonic() + 20
        while store.swaps < 4 and time.monotonic() < limit:
            time.sleep(0.01)
    assert store.swaps >= 4
    assert [*store.list()] == []


def test_one_that_was_taken_over_is_not_given_back(store):
    with hold_lease(store, "me"):
        store.delete([LEASE])
        store.put_new(LEASE, b'{"holder": "other", "ends": "2999-01-01T00:00:00+00:00"}')
    assert json.loads(store.get(LEASE)[0])["holder"] == "other"
