"""What must hold when a store loses answers, another process was faster, or the cache of a machine is damaged."""

import json
import os
import subprocess
import sys
from datetime import timedelta
from pathlib import Path
from threading import Timer

import pytest
from object_stores import BUSY, FORGETFUL
from small_lake import make_status, put

import tracklake
from tracklake.pipeline.lake import (
    Writer,
    connect,
    load,
    object_folder,
    object_store,
    open_for_writing,
    scan,
    transfers,
)
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import LakeLockedError, StoreError
from tracklake.pipeline.lake.history import name_root
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.object_store import ObjectStore
from tracklake.pipeline.lake.origin import Origin
from tracklake.pipeline.lake.publication import fetch_lake, publish_lake
from tracklake.pipeline.lake.transfers import send_commits
from tracklake.pipeline.lake.working_copy import hold_copy, locate_origin, refresh_copy
from tracklake.schemas import SUBSET_STATUS
from tracklake.schemas.errors import FileAccessError


def add(writer: Writer, key: str, number: int) -> None:
    made = put(writer.root, f"validate/highd/{key}", number, make_status(key, number), dataset="highd", subset=key)
    made.info["pages"] = [("highd", key)]  # read back as a list
    writer.commit(*send_commits(writer.root, [made]))


def commit(origin: Origin, *statuses: tuple[str, int], rebuild: bool = False) -> None:
    with hold_copy(origin, is_rebuild=rebuild) as root, open_for_writing(root, rebuild=rebuild) as writer:
        for key, number in statuses:
            add(writer, key, number)


def read_status(place: Path | str, as_of: str | None = None) -> list[tuple[str, int]]:
    rows = tracklake.open(place, as_of).table("subset_status").select("subset", "backward_vehicles")
    return sorted(rows.collect().rows())


@pytest.fixture
def origin(bucket: str, tmp_path: Path) -> Origin:
    return locate_origin(bucket, tmp_path / "cache", 1.0)


@pytest.mark.usefixtures("bucket")
@pytest.mark.parametrize("rebuild", [False, True])
def test_a_write_whose_answer_was_lost_is_no_other_writer_s(object_store_server, tmp_path, rebuild):
    address = object_store_server.make_bucket(FORGETFUL)
    origin = locate_origin(address, tmp_path / "cache", 1.0)
    commit(origin, ("01", 4))
    commit(origin, ("02", 6), ("03", 8), rebuild=rebuild)
    assert read_status(address) == [("01", 4)] * (not rebuild) + [("02", 6), ("03", 8)]
    assert load(address).generation == 2
    assert read_status(address, "1") == [("01", 4)]


def test_a_slow_writer_does_not_replace_the_end_of_a_generation_by_an_earlier_state(bucket, origin):
    with hold_copy(origin) as root, open_for_writing(root) as writer:
        add(writer, "01", 4)
        slow = CommitLog(bucket)
        add(writer, "02", 6)
    commit(origin, ("03", 8))
    commits = {**slow.manifest.commits, "a": load(bucket).commits["validate/highd/01"]}
    slow.replace(tracklake.pipeline.lake.Manifest(**{**vars(slow.manifest), "generation": 2, "commits": commits}))
    assert "a" in load(bucket).commits
    assert read_status(bucket, "1") == [("01", 4), ("02", 6)]


def test_an_earlier_state_that_nobody_can_read_stops_no_one(bucket, origin):
    commit(origin, ("01", 4))
    commit(origin, ("02", 6))
    store = ObjectStore(bucket)
    content, tag = store.get(name_root(1))
    root = json.loads(content)
    root["shards"][0]["sha256"] = "0" * 64
    store.swap(name_root(1), json.dumps(root).encode(), tag)
    commit(origin, ("03", 8))
    assert read_status(bucket) == [("01", 4), ("02", 6), ("03", 8)]


def test_a_lake_in_a_folder_of_another_is_not_swept_with_it(bucket, origin, tmp_path, monkeypatch):
    """Their names look like those of the outer lake's models."""
    inner = locate_origin(f"{bucket}/models", tmp_path / "inner", 1.0)
    commit(inner, ("01", 4))
    commit(locate_origin(f"{bucket}2", tmp_path / "beside", 1.0), ("02", 6))
    ObjectStore(bucket).put_new("manifest.json", ObjectStore(f"{bucket}2").get("manifest.json")[0])  # made before it
    for item in ObjectStore(f"{bucket}2").list("manifest"):
        ObjectStore(bucket).put_new(item.path, ObjectStore(f"{bucket}2").get(item.path)[0])
    monkeypatch.setattr(object_folder, "GRACE", timedelta(seconds=-5))
    commit(origin, ("02", 8))
    assert read_status(bucket) == [("02", 8)]
    assert read_status(inner.address) == [("01", 4)]


def test_a_publication_deletes_nothing_of_a_rebuild_that_takes_more_than_a_day(bucket, origin, tmp_path, monkeypatch):
    commit(origin, ("01", 4))
    fetch_lake(bucket, tmp_path / "lake")
    monkeypatch.setattr(object_folder, "GRACE", timedelta(seconds=-5))
    with hold_copy(origin, is_rebuild=True) as root, open_for_writing(root, rebuild=True) as writer:
        add(writer, "02", 6)
        assert publish_lake(tmp_path / "lake", bucket).deleted == 0
    (file,) = load(bucket).live("subset_status")
    assert ObjectStore(bucket).get(name_object(file))[0]
    ObjectStore(bucket).put_new("tensors/left.0123456789abcdef.npy", b"")
    fetch_lake(bucket, tmp_path / "other")
    assert publish_lake(tmp_path / "other", bucket).deleted >= 1


def test_half_a_rebuild_is_not_seen_on_the_machine_that_makes_it(bucket, origin):
    commit(origin, ("01", 4))
    with hold_copy(origin, is_rebuild=True) as root, open_for_writing(root, rebuild=True) as writer:
        add(writer, "02", 6)
        with pytest.raises(LakeLockedError, match="is writing to this lake"):
            refresh_copy(origin)
        assert read_status(bucket) == [("01", 4)]
    assert read_status(refresh_copy(origin)) == [("02", 6)]


READER = """
import sys
from pathlib import Path
from threading import Timer
from tracklake.pipeline.lake.writer import hold_lock
with hold_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_first_reader_waits_for_another_that_makes_the_copy(origin):
    commit(origin, ("01", 4))
    (origin.copy / "manifest.json").unlink()
    command = [sys.executable, "-c", READER, str(origin.copy)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        other.stdout.readline()
        Timer(0.5, other.stdin.close).start()
        assert read_status(refresh_copy(origin)) == [("01", 4)]


def test_a_cache_that_cannot_be_written_is_named_with_the_setting(bucket, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(FileAccessError, match=rf"{tmp_path}/file.* the cache of {bucket}.* setting `cache`"):
        commit(locate_origin(bucket, tmp_path / "file", 1.0), ("01", 4))


def test_a_content_of_the_cache_that_was_cut_is_read_from_the_store(origin):
    commit(origin, ("01", 4))
    (kept,) = origin.objects.rglob("*.parquet")
    kept.write_bytes(kept.read_bytes()[:50])
    with connect(refresh_copy(origin)) as connection:
        assert connection.sql("SELECT subset, backward_vehicles FROM subset_status").fetchall() == [("01", 4)]


def test_what_is_read_stays_in_the_cache_however_small_that_is(origin):
    """Another process on the same cache drops what it does not need, and may have a smaller limit."""
    commit(origin, ("01", 4), ("02", 6))
    root, statement = refresh_copy(origin), "SELECT subset, backward_vehicles FROM subset_status ORDER BY 1"
    scanned = scan(root, load(root), SUBSET_STATUS, subset="01")
    with connect(root) as connection:
        drop_contents(origin)
        assert connection.sql(statement).fetchall() == [("01", 4), ("02", 6)]
    assert scanned.collect()["backward_vehicles"].to_list() == [4]
    for kept in origin.objects.rglob("*.parquet"):
        os.utime(kept, (0, kept.stat().st_mtime))  # an hour later
    drop_contents(origin)
    assert [*origin.objects.rglob("*.parquet")] == []


def drop_contents(origin: Origin) -> None:
    transfers._ADDED.clear()
    transfers.trim_cache(origin._replace(cache_gb=0.0))


@pytest.mark.usefixtures("bucket")
def test_a_store_that_has_no_time_is_not_taken_for_wrong_credentials(object_store_server, monkeypatch):
    monkeypatch.setattr(object_store, "MAX_RETRIES", 0)
    with pytest.raises(StoreError, match=r"failed, again and again \(503 .*, SlowDown\). Run the same command again"):
        ObjectStore(object_store_server.make_bucket(BUSY)).get("manifest.json")
