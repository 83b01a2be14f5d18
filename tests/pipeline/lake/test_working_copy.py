"""Work on a lake on an object store: what is received, sent and kept here, and what happens when it breaks off."""

import errno
import os
import pickle
import shutil
import subprocess
import sys
from datetime import timedelta
from pathlib import Path

import pytest
from small_lake import make_status, put, put_round, write_round
from small_recordings import write_highd

import tracklake
from tracklake.pipeline.lake import (
    DamagedFileError,
    LakeError,
    LakeMissingError,
    connect,
    find_damaged_files,
    load,
    object_folder,
    open_for_writing,
    scan,
    transfers,
)
from tracklake.pipeline.lake.errors import StoreError
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.object_store import ObjectStore
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.publication import publish_lake
from tracklake.pipeline.lake.transfers import fetch_files, send_commits
from tracklake.pipeline.lake.working_copy import hold_copy, locate_origin, open_workspace
from tracklake.pipeline.orchestration import api, flows
from tracklake.pipeline.orchestration.batches import build_group, narrow_for_jobs
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner
from tracklake.schemas import SUBSET_STATUS, SUBSETS
from tracklake.schemas.errors import FileAccessError


@pytest.fixture
def origin(bucket, tmp_path):
    return locate_origin(bucket, tmp_path / "one", 1.0)


def commit_status(root: Path, key: str, number: int) -> None:
    """Build a table in a copy, send it and commit it."""
    with open_for_writing(root) as writer:
        made = put(root, f"validate/highd/{key}", number, make_status(key, number), dataset="highd", subset=key)
        writer.commit(*send_commits(root, [made]))


def read_status(place: Path | str) -> list[tuple[str, int]]:
    rows = tracklake.open(place).table("subset_status").select("subset", "backward_vehicles")
    return sorted(rows.collect().rows())


def list_tables(folder: Path) -> list[Path]:
    return [*folder.rglob("*.parquet")]


def test_what_is_made_is_committed_at_the_store_and_kept_nowhere_else_but_in_the_cache(bucket, origin, tmp_path):
    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
        commit_status(root, "02", 6)
        assert read_status(bucket) == [("01", 4), ("02", 6)]
    assert load(root).commits == load(bucket).commits
    assert [list_tables(root), len(list_tables(origin.objects))] == [[], 2]
    other = locate_origin(bucket, tmp_path / "two", 1.0)
    with hold_copy(other) as elsewhere:
        assert list_tables(other.cache) == []
        rows = scan(elsewhere, load(elsewhere), SUBSET_STATUS, subset="02").collect()
        assert rows["backward_vehicles"].to_list() == [6]
        assert len(list_tables(other.cache)) == 1, "one table was read, and no other received"
        with connect(elsewhere) as connection:  # one from the cache, one where it is
            assert connection.sql("SELECT sum(backward_vehicles) FROM subset_status").fetchall() == [(10,)]
        assert len(list_tables(other.cache)) == 1


def test_a_workspace_has_what_its_job_reads_and_is_gone_at_the_end(bucket, origin, tmp_path):
    write_round(tmp_path / "lake", 3)
    publish_lake(tmp_path / "lake", bucket)
    manifest = load(bucket)
    with open_workspace(origin, manifest) as root:
        fetch_files(root, manifest.live("subset_status"))
        assert len(list_tables(root)) == 2
        assert scan(root, load(root), SUBSET_STATUS).collect().height == 2
        (sent,) = send_commits(root, [put_round(root, "01-upper", 5)])
        assert all(file.sha256 for file in sent.all_files)
    assert [*origin.workspaces.iterdir()] == []
    assert load(bucket) == manifest, "nothing is live before it is committed"
    objects = {item.path for item in open_store(bucket).list()}
    assert {name_object(file) for file in sent.all_files} <= objects
    with hold_copy(origin) as copy, open_for_writing(copy) as writer:
        writer.commit(sent)
    assert read_status(bucket) == [("01-lower", 3), ("01-upper", 5)]


def test_objects_that_a_killed_worker_sent_are_used_by_the_next_or_swept(bucket, origin, monkeypatch):
    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
    part = load(root)
    with open_workspace(origin, part) as workspace:
        made = put(workspace, "validate/highd/02", 6, make_status("02", 6), dataset="highd", subset="02")
        send_commits(workspace, [made])  # and dies
    before = sorted(item.path for item in open_store(bucket).list(".files"))
    with hold_copy(origin) as root, open_workspace(origin, part) as workspace:
        made = put(workspace, "validate/highd/02", 6, make_status("02", 6), dataset="highd", subset="02")
        send_commits(workspace, [made])
    assert sorted(item.path for item in open_store(bucket).list(".files")) == before
    monkeypatch.setattr(object_folder, "GRACE", timedelta(seconds=-5))
    with hold_copy(origin) as root:
        commit_status(root, "03", 8)
    assert len([*open_store(bucket).list(".files")]) == 2
    assert read_status(bucket) == [("01", 4), ("03", 8)]


def test_coordinators_that_change_different_things_both_count_and_of_the_same_the_second_is_refused(bucket, tmp_path):
    """The lease keeps a second one away; without it the conditional root does."""
    one, two = (locate_origin(bucket, tmp_path / name, 1.0) for name in ("one", "two"))
    with hold_copy(one) as root:
        commit_status(root, "00", 2)
    two.mark(two.copy)
    with open_for_writing(one.copy) as first, open_for_writing(two.copy) as second:
        for writer, key, number in ((first, "01", 4), (second, "02", 6)):
            values = {"dataset": "highd", "subset": key}
            made = put(writer.root, f"validate/highd/{key}", number, make_status(key, number), **values)
            writer.commit(*send_commits(writer.root, [made]))
        assert read_status(bucket) == [("00", 2), ("01", 4), ("02", 6)]
        assert len(second.manifest.commits) == 3
        made = put(one.copy, "validate/highd/02", 8, make_status("02", 8), dataset="highd", subset="02")
        with pytest.raises(LakeError, match="another process has changed validate/highd/02"):
            first.commit(*send_commits(one.copy, [made]))
    assert read_status(bucket) == [("00", 2), ("01", 4), ("02", 6)]


def test_a_rebuild_is_seen_when_it_is_whole(bucket, origin):
    def rebuild(number: int) -> None:
        with hold_copy(origin, is_rebuild=True) as root, open_for_writing(root, rebuild=True) as writer:
            made = put(root, "validate/highd/02", number, make_status("02", number), dataset="highd", subset="02")
            writer.commit(*send_commits(root, [made]))
            assert read_status(bucket) == [("01", 4)]
            if number == 6:
                raise KeyboardInterrupt

    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
    before = load(bucket)
    with pytest.raises(KeyboardInterrupt):
        rebuild(6)
    assert load(bucket) == before
    rebuild(8)
    assert read_status(bucket) == [("02", 8)]
    assert (load(bucket).generation, load(bucket).lake_id != before.lake_id) == (before.generation + 1, True)


def test_a_commit_whose_files_were_not_sent_is_refused(bucket, origin):
    with hold_copy(origin) as root, open_for_writing(root) as writer:
        (root / "reports").mkdir()
        (root / "reports" / "index.html").write_text("x")
        file = tracklake.pipeline.lake.LakeFile("reports/index.html", None, 1)
        with pytest.raises(LakeError, match="were not sent"):
            writer.commit(tracklake.pipeline.lake.Commit("report", "00", {"reports": [file]}))
    assert load(bucket).commits == {}


def test_the_cache_is_bounded_may_be_deleted_and_may_be_full(bucket, tmp_path, monkeypatch):
    origin = locate_origin(bucket, tmp_path / "one", 0.0)
    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
    assert list_tables(origin.cache) == []
    assert read_status(root) == [("01", 4)]
    shutil.rmtree(origin.cache)
    with hold_copy(origin) as root:
        assert read_status(root) == [("01", 4)]
    shutil.rmtree(origin.cache)

    def fail(_self, _path, file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))

    with hold_copy(origin) as root, monkeypatch.context() as full:
        full.setattr(transfers, "receive_file", lambda *_: fail(*_[:3]))
        with pytest.raises((FileAccessError, OSError)):
            scan(root, load(root), SUBSET_STATUS)


def test_the_oldest_contents_leave_the_cache_first(bucket, tmp_path):
    origin = locate_origin(bucket, tmp_path / "one", 1.0)
    with hold_copy(origin) as root:
        for key, number in (("01", 4), ("02", 6)):
            commit_status(root, key, number)
    for number, path in enumerate(sorted(list_tables(origin.objects))):
        os.utime(path, (number, number))
    size = max(path.stat().st_size for path in list_tables(origin.objects))
    transfers._ADDED.clear()
    transfers.trim_cache(origin._replace(cache_gb=size / 1e9))
    assert ["subset=02" in str(path) for path in list_tables(origin.objects)] == [True]


def test_an_object_deleted_behind_our_back_is_named_and_found(bucket, origin):
    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
    shutil.rmtree(origin.objects)
    (file,) = load(bucket).live("subset_status")
    open_store(bucket).delete([name_object(file)])
    with hold_copy(origin) as root:
        with pytest.raises(DamagedFileError, match=rf"{name_object(file)}: is no longer on the store. `tracklake run"):
            scan(root, load(root), SUBSET_STATUS)
        (found,) = find_damaged_files(root, load(root))
        assert (found.key, found.path) == ("validate/highd/01", name_object(file))


@pytest.fixture
def two_recordings(tmp_path, monkeypatch):
    """Raw files of two recordings, of which `tracklake.run` only makes tables and findings."""
    for module in (api, flows):
        monkeypatch.setattr(module, "ALL_STEPS", ("ingest", "validate"))
    for number in ("01", "02"):
        write_highd(tmp_path / "raw" / number, number)
    return tmp_path / "raw"


@pytest.mark.usefixtures("plain_flows")
def test_a_store_that_goes_in_the_middle_keeps_what_was_committed(two_recordings, bucket, tmp_path, monkeypatch):
    upload, sent = ObjectStore.upload, []

    def fail_late(self, path, file):
        if len(sent) > 10:
            raise StoreError(f"{self.place}/{path}: the store cannot be reached.")
        sent.append(path)
        upload(self, path, file)

    with monkeypatch.context() as broken:
        broken.setattr(ObjectStore, "upload", fail_late)
        with pytest.raises(LakeError, match=r"02: .*the store cannot be reached"):
            tracklake.run(two_recordings, lake=bucket, cache=tmp_path / "one")
    assert tracklake.open(bucket).table("subsets").collect()["recording"].unique().to_list() == ["01"]
    result = tracklake.run(two_recordings, lake=bucket, cache=tmp_path / "two")
    assert result.built == {"ingest": 1, "validate": 2}


@pytest.mark.usefixtures("plain_flows")
def test_a_run_makes_again_what_was_deleted_on_the_store(two_recordings, bucket, tmp_path):
    tracklake.run(two_recordings, lake=bucket, cache=tmp_path / "one")
    before = load(bucket)
    tracks = [file for file in before.live("tracks") if "subset=01-upper" in file.path]
    open_store(bucket).delete([name_object(tracks[0])])
    again = tracklake.run(
        two_recordings, lake=bucket, cache=tmp_path / "two", thresholds={"high_acceleration_mps2": 5.0}
    )
    assert again.built["ingest"] == 1
    assert any("made again, as files of the lake were damaged" in note for note in again.notes)
    assert {file.sha256 for file in before.live("tracks")} == {file.sha256 for file in load(bucket).live("tracks")}


WORKER = """
import pickle, sys
from tracklake.pipeline.orchestration.batches import build_group
print(pickle.dumps(build_group(*pickle.loads(bytes.fromhex(sys.stdin.read())))).hex())
"""


@pytest.mark.usefixtures("plain_flows")
def test_a_worker_on_another_machine_builds_with_the_address_alone(two_recordings, bucket, tmp_path, monkeypatch):
    """Its cache is its own, it sees the raw files, and its small records are what the coordinator commits."""
    monkeypatch.setattr(api, "ALL_STEPS", ("ingest",))
    tracklake.run(two_recordings, lake=bucket, cache=tmp_path / "one")
    origin = locate_origin(bucket, tmp_path / "one", 1.0)
    settings = Settings(lake=origin.copy)
    with hold_copy(origin) as root, open_for_writing(root) as writer:
        jobs = Planner(root, writer.manifest, settings).plan("validate")
        message = (bucket, "validate", jobs, settings, narrow_for_jobs(writer.manifest, "validate", jobs, settings))
        done = subprocess.run(
            [sys.executable, "-c", WORKER],
            input=pickle.dumps(message).hex(),
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "two")},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        made = pickle.loads(bytes.fromhex(done.stdout))
        assert load(bucket).of_stage("validate") == [], "the coordinator commits"
        for commit in made:
            writer.commit(commit)
    assert len(pickle.dumps(made)) < 10_000
    assert [commit.key for commit in load(bucket).of_stage("validate")] == [job.key for job in jobs]
    expected = [build_group(str(root), "validate", [job], settings)[0] for job in jobs]
    assert [commit.files for commit in made] == [commit.files for commit in expected]
    (elsewhere,) = (tmp_path / "two").glob("tracklake/*")
    assert {item.name for item in elsewhere.iterdir()} == {"objects", "work"}


def test_a_lake_that_is_gone_is_made_anew(bucket, origin):
    with hold_copy(origin) as root:
        commit_status(root, "01", 4)
    store = open_store(bucket)
    store.delete([item.path for item in store.list()])
    with hold_copy(origin) as root:
        with pytest.raises(LakeMissingError):
            load(root)
        commit_status(root, "02", 6)
    assert read_status(bucket) == [("02", 6)]


def test_a_first_run_that_breaks_off_on_one_machine_is_gone_on_with_on_another(bucket, tmp_path):
    for name in ("one", "two"):
        origin = locate_origin(bucket, tmp_path / name, 1.0)
        with hold_copy(origin) as root, pytest.raises(KeyboardInterrupt), open_for_writing(root):
            raise KeyboardInterrupt
    commit_status(root, "01", 4)
    assert read_status(bucket) == [("01", 4)]
    assert scan(root, load(root), SUBSETS).collect().is_empty()
