"""`tracklake publish store`, `fetch`, and commands on a lake at an address, as a user runs them."""

import json
from unittest.mock import Mock

import pytest
from export_lakes import KEYS
from object_stores import HEEDLESS
from raw_texts import as_csv, ngsim_row, write
from small_lake import write_round
from small_recordings import write_highd

import tracklake
from tracklake.pipeline.lake import Writer, load
from tracklake.pipeline.lake.errors import StoreError
from tracklake.pipeline.lake.lease import hold_lease
from tracklake.pipeline.lake.places import open_store
from tracklake.pipeline.lake.remote_log import RemoteLog
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


def test_what_a_machine_keeps_of_a_lake_stands_for_its_address(published, bucket, tmp_path):
    """It is no whole lake, and another machine may have changed that since."""
    assert published("check", "--lake", bucket).code == 0
    (copy,) = (tmp_path / "cache").glob("tracklake/*/lake")
    write_round(tmp_path / "lake", 4)
    assert published("publish", "store", bucket, "--lake", tmp_path / "lake").code == 0
    count = published("sql", "SELECT max(backward_vehicles) n FROM subset_status", "--lake", copy, "--format", "csv")
    assert count.out == "n\n4\n", count
    with hold_lease(open_store(bucket), "process 7 on north"):
        done = published("validate", "--lake", copy)
    assert (done.code, "process 7 on north" in done.err) == (1, True)
    for arguments in (("publish", "store", f"{bucket}2"), ("publish", "ducklake"), ("fetch", bucket), ("serve",)):
        done = published(*arguments, "--lake", copy)
        assert (done.code, f"`tracklake fetch {bucket} --lake DIR`" in done.err) == (2, True), done


def test_the_address_is_shown_as_it_was_given(published, bucket):
    done = published("config", "--lake", bucket, "--json")
    assert json.loads(done.out)["settings"]["lake"]["value"] == bucket


REFUSED = {
    ("serve", "--lake", "{bucket}"): (2, "this command works on a lake in a folder"),
    ("publish", "ducklake", "--lake", "{bucket}"): (2, "tracklake fetch {bucket} --lake DIR"),
    ("export", "npz", "--out", "x", "--lake", "{bucket}/elsewhere"): (1, "no lake here"),
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
    assert not [*copy.rglob("*.parquet")], "tables are received when they are read"
    rebuilt = machine("one", "ingest", tmp_path / "raw" / "01", "--lake", bucket, "--rebuild", "--replace")
    assert rebuilt.code == 0, rebuilt.err
    assert list_recordings(bucket) == ["01"]
    late = machine("two", "ingest", tmp_path / "raw" / "02", "--lake", bucket)
    assert late.code == 0, late.err
    assert list_recordings(bucket) == ["01", "02"]


def describe_results(place):
    """What was made, by key: the fingerprint, and the content of each table and tensor file."""
    return {
        key: (commit.fingerprint, {file.path: file.sha256 for file in commit.all_files if is_fixed(file)})
        for key, commit in load(place).commits.items()
    }


def is_fixed(file):
    return file.path.startswith((".files", "tensors"))


@pytest.mark.thorough
@pytest.mark.usefixtures("plain_flows", "empty_charts")
def test_every_command_gives_at_an_address_what_it_gives_in_a_folder(machine, bucket, tmp_path):
    folder = tmp_path / "lake"
    for number in ("01", "02"):
        write_highd(tmp_path / "raw", number)
    for place in (folder, bucket):
        done = machine("one", "run", tmp_path / "raw", "--lake", place)
        assert done.code == 0, done.err
        assert f"train lstm --lake {place}" in done.out, "what to try next"
    assert describe_results(bucket) == describe_results(folder)
    (copy,) = (tmp_path / "one").glob("tracklake/*/lake")
    assert {page.name for page in copy.rglob("*.html")} == {page.name for page in folder.rglob("*.html")}
    commands = {
        "check": ("check", "--fail-on", "error_share > 0.5"),
        "evaluate": ("evaluate", "constant-velocity", "--json"),
        "export": ("export", "npz", "--out", "{out}"),
    }
    outputs = {}
    for name, arguments in commands.items():
        for place in (folder, bucket):
            out = tmp_path / f"{name}-{place == bucket}"
            done = machine("two", *(each.format(out=out) for each in arguments), "--lake", place)
            assert done.code == 0, (name, done)
            files = {file.name: file.read_bytes() for file in out.rglob("*.npz")}
            scores = [row["rmse_m"] for row in json.loads(done.out)["rows"]] if "--json" in arguments else []
            outputs.setdefault(name, []).append((files, scores))
    assert all(first == second for first, second in outputs.values())
    assert "nothing to do" in machine("two", "report", "--lake", bucket).out
    for lake, other in ((bucket, folder), (folder, bucket)):
        compared = machine("two", "report", "--lake", lake, "--compare", other, "--json")
        assert json.loads(compared.out)["comparison"]["equal"], compared
    removed = machine("two", "remove", "02", "--lake", bucket, "--json")
    assert (removed.code, json.loads(removed.out)["lake"]) == (0, bucket)
    assert list_recordings(bucket) == ["01"]


@pytest.mark.usefixtures("plain_flows")
def test_a_file_of_several_recordings_is_ingested_at_an_address(machine, bucket, tmp_path):
    """What was read of it waits outside of the jobs' folders, and is gone at the end."""
    vehicles = {1: "us-101-0750", 2: "us-101-0805"}
    rows = [ngsim_row(vehicle, frame, key=KEYS[name]) for vehicle, name in vehicles.items() for frame in range(1, 30)]
    done = machine("one", "ingest", write(tmp_path / "raw.csv", as_csv(rows)), "--lake", bucket)
    assert done.code == 0, done.err
    assert list_recordings(bucket) == ["us-101-0750", "us-101-0805"]
    (cache,) = (tmp_path / "one").glob("tracklake/*")
    assert {item.name for item in cache.iterdir()} == {"lake", "objects", "work"}


def test_a_second_machine_is_told_at_once_who_works_on_the_lake(machine, bucket, tmp_path):
    write_highd(tmp_path / "raw", "01")
    with hold_lease(open_store(bucket), "process 7 on north"):
        done = machine("two", "ingest", tmp_path / "raw", "--lake", bucket)
    assert (done.code, "process 7 on north is writing to this lake" in done.err) == (1, True)
    assert [*open_store(bucket).list()] == [], "nothing was left there"


@pytest.mark.usefixtures("plain_flows")
def test_what_an_interrupted_run_has_committed_is_there_and_another_machine_goes_on(
    machine, bucket, tmp_path, monkeypatch
):
    for number in ("01", "02"):
        write_highd(tmp_path / "raw" / number, number)
    arguments = ("ingest", tmp_path / "raw", "--lake", bucket)
    commit, committed = Writer.commit, []

    def interrupt(self, made):
        if committed:
            raise KeyboardInterrupt
        committed.append(made.key)
        commit(self, made)

    with monkeypatch.context() as broken:
        broken.setattr(Writer, "commit", interrupt)
        stopped = machine("one", *arguments)
    assert (stopped.code, "1 result of this run is in the lake" in stopped.err) == (130, True), stopped
    assert len(list_recordings(bucket)) == 1
    done = machine("two", *arguments)
    assert done.code == 0, done.err
    assert list_recordings(bucket) == ["01", "02"]
    assert "nothing to do" in machine("one", *arguments).out
    assert load(bucket).generation == 2


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
        patched.setattr(RemoteLog, "finish", refuse)
        done = machine("one", "ingest", tmp_path / "raw", "--lake", bucket, "--json")
    assert (done.code, json.loads(done.out)) == (1, {"error": "no room"})
    done = machine("one", "ingest", tmp_path / "raw", "--lake", bucket, "--json")
    assert (done.code, "error" in json.loads(done.out)) == (0, False)
