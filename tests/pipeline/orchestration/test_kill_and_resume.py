"""A run killed with SIGKILL at any moment leaves a lake that reads well, and the next run only does the rest."""

import json
import os
import shutil
import signal
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import polars as pl
import pytest
from small_recordings import write_highd

from tracklake.pipeline.lake import connect, is_intact, load
from tracklake.pipeline.lake.manifest import read_document
from tracklake.schemas import TABLES

pytestmark = pytest.mark.usefixtures("plain_flows", "prefect_server")


@pytest.fixture(scope="module")
def raw(tmp_path_factory) -> Path:
    """One small recording."""
    folder = tmp_path_factory.mktemp("raw")
    write_highd(folder, "01")
    return folder


@pytest.fixture(scope="module")
def undisturbed(make_lake, raw) -> Path:
    """The lake of an undisturbed run."""
    return make_lake(raw).root


def wait_until(condition, process, seconds=120.0):
    """Whether the condition came true before the process ended or the time was up."""
    limit = time.monotonic() + seconds
    while time.monotonic() < limit and process.poll() is None:
        if condition():
            return True
        time.sleep(0.002)
    return condition()


def entries(root: Path) -> dict:
    return read_document(root)["entries"] if (root / "manifest.json").exists() else {}


def read_all(root: Path) -> dict[str, pl.DataFrame]:
    with connect(root) as connection:
        tables = {table.name: connection.sql(f'FROM "{table.name}" ORDER BY ALL').pl() for table in TABLES}
    return {table.name: tables[table.name].select(*table.dtypes) for table in TABLES}


@pytest.mark.thorough
def test_a_killed_run_leaves_whole_tables_and_the_next_run_does_the_rest(
    command, raw, undisturbed, prefect_home, tmp_path
):
    """One death in the middle; test_killed_writers.py has those at every step of a session."""
    root, home = tmp_path / "lake", {"PREFECT_HOME": str(prefect_home)}
    # It leaves a server's database behind as well, and the run that goes on from there begins with it.
    process = command.alone.start("run", raw, "--lake", root, "--quiet", **home)
    reached = wait_until(lambda: len(entries(root)) >= 5, process)
    assert reached, process.communicate()[0]
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    assert not children.exists() or children.read_text().split() == [], "a server that outlives its process"
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=10)  # returns only when no process holds the pipe any more
    # Every file of what was committed is whole.
    manifest = load(root)
    committed = manifest.commits.keys()
    assert 5 <= len(committed) < len(load(undisturbed).commits)
    for entry in manifest.commits.values():
        assert is_intact(root, (file for group in entry.files.values() for file in group)), entry.key
    tables = read_all(root)
    for table in TABLES:
        assert tables[table.name].height == sum(file.rows for file in manifest.live(table.name)), table.name
    before = {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")}
    done = command.alone("run", raw, "--lake", root, "--json", **home)
    assert done.code == 0, done.err
    said = json.loads(done.out)
    built = said["built"]
    assert sum(built.values()) == len(load(root).commits) - len(committed), "only what was missing was made"
    after = {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")}
    assert before.items() <= after.items()
    left = [path for path in root.rglob("*") if ".tmp" in path.name or path.name == ".staging"]
    assert left == []
    # The embedded server took the report as artifacts, too.
    assert not any("artifacts" in note for note in said["notes"])
    with closing(sqlite3.connect(f"file:{prefect_home / 'prefect.db'}?mode=ro", uri=True)) as database:
        keys = {key.split("-")[1] for (key,) in database.execute("SELECT key FROM artifact_collection")}
    assert keys - {"messages"} == {"findings", "subsets", "ingestion", "completeness", "report"}
    # And it is the lake that an undisturbed run makes.
    expected = read_all(undisturbed)
    for name, table in read_all(root).items():
        assert table.equals(expected[name]), name


def test_an_idle_rerun_starts_no_server_and_changes_nothing(command, raw, undisturbed, tmp_path):
    def state():
        return {
            str(path): (path.stat().st_mtime_ns, path.stat().st_size)
            for path in undisturbed.rglob("*")
            if path.is_file()
        }

    before = state()
    home = tmp_path / "prefect-home"
    done = command.alone("run", raw, "--lake", undisturbed, PREFECT_HOME=str(home))
    assert done.code == 0, done.err
    assert "nothing to do" in done.out
    assert str(undisturbed / "reports" / "index.html") in done.out
    assert not home.exists(), "Prefect was started"
    assert state() == before


def test_a_changed_file_redoes_only_its_recording(command, raw, tmp_path):
    source, root = tmp_path / "raw", tmp_path / "lake"
    shutil.copytree(raw, source)
    write_highd(source, "02")
    assert command.here("ingest", source, "--lake", root, "--quiet").code == 0
    first = {key: entry["fingerprint"] for key, entry in entries(root).items()}
    tracks = source / "02_tracks.csv"
    lines = tracks.read_text().splitlines(keepends=True)
    tracks.write_text("".join(lines[:-1]))
    done = command.here("ingest", source, "--lake", root, "--json")
    assert json.loads(done.out)["built"] == {"ingest": 1}
    second = {key: entry["fingerprint"] for key, entry in entries(root).items()}
    assert [key for key in first if first[key] != second[key]] == ["ingest/highd/02"]
    # A file that was only touched has the same content, and is not read again as another one.
    (source / "01_tracks.csv").touch()
    assert "nothing to do" in command.here("ingest", source, "--lake", root).out


def test_one_writer_at_a_time_and_readers_do_not_wait(command, raw, tmp_path):
    root = tmp_path / "lake"
    process = command.start("run", raw, "--lake", root, "--quiet")
    try:
        assert wait_until(lambda: len(entries(root)) >= 1, process)
        os.kill(process.pid, signal.SIGSTOP)  # or it might be done before the others are
        second = command.here("run", raw, "--lake", root)
        assert second.code == 1
        assert "is writing to this lake" in second.err
        assert str(process.pid) in second.err
        assert command.here("sql", "SELECT count(*) FROM tracks", "--lake", root).code == 0
    finally:
        process.kill()
        process.communicate()
    assert command.here("ingest", raw, "--lake", root, "--quiet").code == 0, "the lock died with its process"


def test_a_lake_can_be_moved(command, raw, undisturbed, tmp_path):
    moved = tmp_path / "some where" / "else"
    shutil.copytree(undisturbed, moved)
    query = "SELECT count(*) AS n FROM tracks"
    here = command.here("sql", query, "--lake", undisturbed, "--format", "json").out
    assert command.here("sql", query, "--lake", moved, "--format", "json").out == here
    assert "nothing to do" in command.here("run", raw, "--lake", moved).out
