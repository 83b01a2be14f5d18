"""A run killed with SIGKILL at any moment leaves a lake that reads well, and the next run only does the rest."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import polars as pl
import pytest

from tracklake.pipeline.lake import connect, is_intact, load
from tracklake.schemas import TABLES


def wait_until(condition, process, seconds=120.0):
    """Whether the condition came true before the process ended or the time was up."""
    limit = time.monotonic() + seconds
    while time.monotonic() < limit and process.poll() is None:
        if condition():
            return True
        time.sleep(0.002)
    return condition()


def entries(root: Path) -> dict:
    path = root / "manifest.json"
    return json.loads(path.read_text())["entries"] if path.exists() else {}


def read_all(root: Path) -> dict[str, pl.DataFrame]:
    with connect(root) as connection:
        tables = {table.name: connection.sql(f'FROM "{table.name}" ORDER BY ALL').pl() for table in TABLES}
    return {table.name: tables[table.name].select(*table.dtypes) for table in TABLES}


def test_killed_runs_leave_whole_tables_and_the_next_run_does_the_rest(command, sample, lake, tmp_path):
    root = tmp_path / "lake"
    committed: dict[str, str] = {}
    for wanted in (1, 4, 12, 20, 24):
        # The first and the last, which leave a server's database behind as well, and the run that goes on from there.
        killed = command.alone if wanted in (1, 24) else command
        process = killed.start("run", sample, "--lake", root, "--quiet")
        reached = wait_until(lambda wanted=wanted: len(entries(root)) >= wanted, process)
        assert reached, process.communicate()[0]
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
        # Nothing that was committed is lost, and every file of it is whole.
        manifest = load(root)
        now = {key: entry.fingerprint for key, entry in manifest.commits.items()}
        assert committed.items() <= now.items()
        assert len(now) >= wanted
        committed = now
        for entry in manifest.commits.values():
            assert is_intact(root, (file for group in entry.files.values() for file in group)), entry.key
        tables = read_all(root)
        for table in TABLES:
            assert tables[table.name].height == sum(file.rows for file in manifest.live(table.name)), table.name
    before = {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")}
    done = command.alone("run", sample, "--lake", root, "--json")
    assert done.code == 0, done.err
    built = json.loads(done.out)["built"]
    assert sum(built.values()) == len(load(root).commits) - len(committed), "only what was missing was made"
    after = {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")}
    assert before.items() <= after.items()
    left = [path for path in root.rglob("*") if ".tmp" in path.name or path.name == ".staging"]
    assert left == []
    # And it is the lake that an undisturbed run makes.
    undisturbed = read_all(lake.root)
    for name, table in read_all(root).items():
        assert table.equals(undisturbed[name]), name


def test_an_idle_rerun_starts_no_server_and_changes_nothing(command, sample, lake, tmp_path):
    def state():
        return {
            str(path): (path.stat().st_mtime_ns, path.stat().st_size)
            for path in lake.root.rglob("*")
            if path.is_file() and "models" not in path.parts and "reports" not in path.parts
        }

    assert command("run", sample, "--lake", lake.root, "--quiet").code == 0  # a run trained since is in the report now
    before = state()
    home = tmp_path / "prefect-home"
    done = command.alone("run", sample, "--lake", lake.root, PREFECT_HOME=str(home))
    assert done.code == 0, done.err
    assert "nothing to do" in done.out
    assert str(lake.root / "reports" / "index.html") in done.out
    assert not home.exists(), "Prefect was started"
    assert state() == before


@pytest.mark.usefixtures("prefect_here")
def test_a_changed_file_redoes_only_its_recording(command, sample, tmp_path):
    source, root = tmp_path / "raw", tmp_path / "lake"
    source.mkdir()
    for recording in ("01", "04"):
        for kind in ("recordingMeta", "tracksMeta", "tracks"):
            shutil.copy(sample / f"{recording}_{kind}.csv", source)
    assert command.here("ingest", source, "--lake", root, "--quiet").code == 0
    first = {key: entry["fingerprint"] for key, entry in entries(root).items()}
    tracks = source / "04_tracks.csv"
    lines = tracks.read_text().splitlines(keepends=True)
    tracks.write_text("".join(lines[:-1]))
    done = command.here("ingest", source, "--lake", root, "--json")
    assert json.loads(done.out)["built"] == {"ingest": 1}
    second = {key: entry["fingerprint"] for key, entry in entries(root).items()}
    assert [key for key in first if first[key] != second[key]] == ["ingest/highd/04"]
    # A file that was only touched has the same content, and is not read again as another one.
    (source / "01_tracks.csv").touch()
    assert "nothing to do" in command.here("ingest", source, "--lake", root).out


def test_one_writer_at_a_time_and_readers_do_not_wait(command, sample, tmp_path):
    root = tmp_path / "lake"
    process = command.start("run", sample, "--lake", root, "--quiet")
    try:
        assert wait_until(lambda: len(entries(root)) >= 1, process)
        second = command("run", sample, "--lake", root)
        assert second.code == 1
        assert "is writing to this lake" in second.err
        assert str(process.pid) in second.err
        assert command("sql", "SELECT count(*) FROM tracks", "--lake", root).code == 0
    finally:
        process.kill()
        process.communicate()
    assert command("ingest", sample, "--lake", root, "--quiet").code == 0, "the lock died with its process"


def test_a_lake_can_be_moved(command, sample, lake, tmp_path):
    assert command("run", sample, "--lake", lake.root, "--quiet").code == 0  # a run trained since is in the report now
    moved = tmp_path / "some where" / "else"
    shutil.copytree(lake.root, moved)
    query = "SELECT count(*) AS n FROM tracks"
    here = command.here("sql", query, "--lake", lake.root, "--format", "json").out
    assert command.here("sql", query, "--lake", moved, "--format", "json").out == here
    assert "nothing to do" in command("run", sample, "--lake", moved).out
