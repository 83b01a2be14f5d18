"""`tracklake publish store`, `fetch`, and commands on a lake at an address, as a user runs them."""

import json
from unittest.mock import Mock

import pytest
from object_stores import HEEDLESS
from small_lake import write_round
from small_recordings import write_highd

import tracklake
from tracklake.pipeline.lake import LakeMissingError, load
from tracklake.pipeline.lake.errors import StoreError
from tracklake.pipeline.lake.lease import hold_lease
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.working_copy import WorkingCopy
from tracklake.pipeline.orchestration import api
from tracklake.pipeline.orchestration.run_plan import RunRequest
from tracklake.schemas.errors import UsageError


@pytest.fixture
def published(command, bucket, object_store_server, tmp_path):
    """A lake in a folder and at an address, and the command in an environment that leads there."""
    write_round(tmp_path / "lake", 3)
    environment = {**object_store_server.environment, "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def call(*arguments):
        return command.here(*arguments, **environment)

    done = call("publish", "store", bucket, "--lake", tmp_path / "lake")
    assert done.code == 0, done.err
    assert f"published {bucket}: 10 files" in done.out
    return call


def test_a_lake_is_queried_where_it_is(published, bucket, tmp_path):
    statement = "SELECT subset, backward_vehicles FROM subset_status ORDER BY 1"
    there = published("sql", statement, "--lake", bucket, "--format", "csv")
    assert there.code == 0, there.err
    assert there.out == "subset,backward_vehicles\n01-lower,3\n01-upper,3\n"
    shown = json.loads(published("info", "--lake", bucket, "--json").out)
    here = load(tmp_path / "lake")
    files = [file for commit in here.commits.values() for file in commit.all_files]
    assert (shown["lake"], shown["lake_id"], shown["stages"]) == (bucket, here.lake_id, [])
    assert shown["bytes"]["tables"] == sum(file.bytes for file in files if file.path.startswith(".files"))
    assert shown["bytes"]["tensors"] == sum(file.bytes for file in files if file.path.startswith("tensors"))
    assert [each["number"] for each in shown["generations"]] == [1]
    assert bucket in published("info", "--lake", bucket).out


def test_a_lake_is_fetched_and_followed(published, bucket, tmp_path):
    done = published("fetch", bucket, "--lake", tmp_path / "copy", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["files"] == 10
    assert load(tmp_path / "copy").commits == load(tmp_path / "lake").commits
    assert "0 files" in published("fetch", bucket, "--lake", tmp_path / "copy").out


REFUSED = {
    ("report", "--lake", "{bucket}"): (2, "this command works on a lake in a folder"),
    ("export", "npz", "--out", "x", "--lake", "{bucket}"): (2, "tracklake fetch {bucket} --lake DIR"),
    ("fetch", "{bucket}", "--lake", "{bucket}"): (2, "this command works on a lake in a folder"),
    ("sql", "--out", "x.duckdb", "--lake", "{bucket}"): (2, "this command works on a lake in a folder"),
    ("sql", "FROM subsets", "--lake", "{bucket}/elsewhere"): (1, "no lake here"),
    ("sql", "FROM subsets", "--lake", "s3://no-such-bucket/lake"): (1, "there is no such bucket"),
    ("sql", "FROM subsets", "--lake", "s3://me:secret@bucket/lake"): (2, "Credentials belong in the environment"),
    ("publish", "store", "bucket/lake"): (2, "expected an address on an object store, such as s3://bucket/lake"),
    ("publish", "store", "http://bucket/lake"): (2, "one of s3://BUCKET/FOLDER"),
}
"""Commands that cannot work, each with its exit code and a part of its message."""


def test_what_cannot_work_is_refused_with_the_way_out(published, bucket):
    for arguments, (code, message) in REFUSED.items():
        done = published(*(each.format(bucket=bucket) for each in arguments))
        assert done.code == code, (arguments, done)
        assert message.format(bucket=bucket) in " ".join(done.err.replace("│", " ").split()), arguments


@pytest.fixture
def machine(command, object_store_server, tmp_path):
    """Commands on a machine of a name, which has a cache of its own."""

    def call(name, *arguments):
        environment = {**object_store_server.environment, "XDG_CACHE_HOME": str(tmp_path / name)}
        return command.here(*arguments, **environment)

    return call


def list_recordings(address):
    return sorted(tracklake.open(address).table("subsets").select("recording").unique().collect()["recording"])


@pytest.mark.usefixtures("plain_flows")
def test_two_machines_add_recordings_to_one_lake(machine, bucket, tmp_path):
    for name, number in (("one", "01"), ("two", "02")):
        write_highd(tmp_path / "raw" / number, number)
        done = machine(name, "ingest", tmp_path / "raw" / number, "--lake", bucket)
        assert done.code == 0, done.err
        assert f"published {bucket}" in done.out
    assert list_recordings(bucket) == ["01", "02"]
    idle = machine("one", "ingest", tmp_path / "raw" / "01", "--lake", bucket)
    assert "nothing to do" in idle.out
    (copy,) = (tmp_path / "one").glob("tracklake/*/lake")
    assert list_recordings(copy) == ["01", "02"]
    rebuilt = machine("one", "ingest", tmp_path / "raw" / "01", "--lake", bucket, "--rebuild", "--replace")
    assert rebuilt.code == 0, rebuilt.err
    assert list_recordings(bucket) == ["01"]
    late = machine("two", "ingest", tmp_path / "raw" / "02", "--lake", bucket)
    assert (late.code, "holds another lake" in late.err) == (1, True)


def test_a_second_machine_is_told_at_once_who_works_on_the_lake(machine, bucket, tmp_path):
    write_highd(tmp_path / "raw", "01")
    with hold_lease(open_store(bucket), "process 7 on north"):
        done = machine("two", "ingest", tmp_path / "raw", "--lake", bucket)
    assert (done.code, "process 7 on north is writing to this lake" in done.err) == (1, True)
    assert [*open_store(bucket).list()] == [], "nothing was left there"


@pytest.mark.usefixtures("plain_flows")
def test_a_run_that_is_interrupted_publishes_nothing_and_is_gone_on_with(machine, bucket, tmp_path, monkeypatch):
    write_highd(tmp_path / "raw", "01")
    arguments = ("ingest", tmp_path / "raw", "--lake", bucket)

    def interrupt(*_arguments, **_named):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr("tracklake.pipeline.cli.ingest.report_result", interrupt)
        assert machine("one", *arguments).code == 130
    with pytest.raises(LakeMissingError):
        load(bucket)
    done = machine("one", *arguments)
    assert done.code == 0, done.err
    assert "nothing to do" in done.out  # the copy has the recording already
    assert list_recordings(bucket) == ["01"]


@pytest.mark.usefixtures("plain_flows")
def test_python_adds_to_a_lake_at_an_address(bucket, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(api, "ALL_STEPS", ("ingest",))
    write_highd(tmp_path / "raw", "01")
    result = tracklake.run("raw", lake=bucket, cache=tmp_path / "cache")
    assert result.built == {"ingest": 1}
    assert list_recordings(bucket) == ["01"]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["cache", "raw"]
    with pytest.raises(UsageError, match="a flow works on a lake in a folder"):
        RunRequest(bucket, ("ingest",), "raw").check()


@pytest.mark.usefixtures("bucket")
def test_a_store_that_does_not_guard_is_refused_before_any_work(machine, object_store_server, tmp_path):
    write_highd(tmp_path / "raw", "01")
    done = machine("one", "ingest", tmp_path / "raw", "--lake", object_store_server.make_bucket(HEEDLESS))
    assert (done.code, "ignores the condition" in done.err) == (1, True)
    assert not [*(tmp_path / "one").rglob("*.parquet")]


@pytest.mark.usefixtures("plain_flows")
def test_a_failed_publication_is_the_only_result_for_programs(machine, bucket, tmp_path, monkeypatch):
    write_highd(tmp_path / "raw", "01")
    refuse = Mock(side_effect=StoreError("no room"))
    with monkeypatch.context() as patched:
        patched.setattr(WorkingCopy, "publish", refuse)
        done = machine("one", "ingest", tmp_path / "raw", "--lake", bucket, "--json")
    assert (done.code, json.loads(done.out)) == (1, {"error": "no room"})
    done = machine("one", "ingest", tmp_path / "raw", "--lake", bucket, "--json")
    assert (done.code, "error" in json.loads(done.out)) == (0, False)
