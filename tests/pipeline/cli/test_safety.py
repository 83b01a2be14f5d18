"""What a slip of the user must not do: lose rows, mix simulated with real recordings, train on what was excluded."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tracklake.pipeline.cli import generated_sample
from tracklake.pipeline.lake import connect
from tracklake.pipeline.synthetic import SampleSummary

pytestmark = pytest.mark.usefixtures("plain_flows", "empty_charts")

HEADER = "Vehicle_ID,Frame_ID,Global_Time,Local_X,Local_Y,v_Vel"
BASE = 1_118_846_978_900  # us-101-0750


def write_part(path: Path, vehicles: range, feet: float = 0.0) -> Path:
    rows = [
        f"{vehicle},{frame},{BASE + 100 * frame},{20 + vehicle},{feet + 40 * frame},40.0"
        for vehicle in vehicles
        for frame in range(1, 11)
    ]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    return path


def count(lake) -> int:
    with connect(lake) as connection:
        return connection.sql("SELECT count(*) FROM tracks").fetchall()[0][0]


def test_a_second_part_of_a_recording_does_not_replace_the_first(command, tmp_path):
    lake, raw = tmp_path / "lake", tmp_path / "raw"
    first, second = write_part(raw / "a.csv", range(1, 3)), write_part(raw / "b.csv", range(3, 6))
    assert command.here("ingest", first, "--lake", lake).code == 0
    refused = command.here("ingest", second, "--lake", lake)
    assert refused.code == 3
    assert "recording us-101-0750: it is in the lake already, from a.csv, and now came from b.csv" in refused.err
    assert count(lake) == 20
    assert command.here("ingest", second, "--lake", lake).code == 3, "asked again, refused again"
    assert command.here("ingest", raw, "--lake", lake).code == 0, "both at once"
    assert count(lake) == 50
    assert command.here("ingest", second, "--lake", lake, "--replace").code == 0
    assert count(lake) == 30
    write_part(second, range(3, 5))
    assert command.here("ingest", second, "--lake", lake).code == 0, "a new version of the same file"
    assert count(lake) == 20


def test_the_sample_stays_out_of_a_lake_of_other_recordings(command, tmp_path, monkeypatch):
    asked = []

    def generate(out, minutes, seed, _terminal):
        asked.append((minutes, seed))
        write_part(out / "truth.parquet", range(0))
        write_part(out / "b.csv", range(1, 3))
        return SampleSummary((), rows=20, recordings=1, seconds=0.0)

    monkeypatch.setattr(generated_sample, "write_generated", generate)
    raw = write_part(tmp_path / "raw" / "a.csv", range(3, 5))
    assert command.here("ingest", raw, "--lake", tmp_path / "lake").code == 0
    for options in ([], [], ["--minutes", "0.1"]):  # made, found, asked for otherwise
        done = command.here("run", "--lake", tmp_path / "lake", *options)
        assert done.code == 1
        assert "holds recordings that are not this generated sample (a.csv)" in done.err
    assert asked == [(None, None), (0.1, None)]
    assert count(tmp_path / "lake") == 20


@pytest.mark.thorough
def test_what_was_made_with_other_settings_is_refused_or_skipped(command, lake, tmp_path):
    copy = tmp_path / "lake"
    shutil.copytree(lake.root, copy)
    assert command.here("train", "lstm", "--lake", copy, "--seconds", "0.5", "--name", "old").code == 0
    with connect(copy) as connection:  # what follows needs two recordings, and the excluded carriageway of one
        query = "SELECT DISTINCT recording FROM subsets WHERE recording NOT IN ('03', '04')"
        others = [name for (name,) in connection.sql(query).fetchall()]
    assert command.here("remove", *others, "--lake", copy).code == 0
    strict = {"TRACKLAKE_MAX_BACKWARD_SHARE": "0"}
    full = {**strict, "TRACKLAKE_MIN_FUTURE_S": "5"}
    assert command.here("validate", "--lake", copy, **strict).code == 0
    stale = command.here("split", "--lake", copy, **strict)
    assert stale.code == 1
    assert "Run `tracklake samples` first" in stale.err
    for stage in ("samples", "split", "tensors"):
        assert command.here(stage, "--lake", copy, **full).code == 0
    with connect(copy) as connection:
        query = "SELECT count(*) FROM splits JOIN subsets USING (dataset, subset) WHERE excluded"
        assert connection.sql(query).fetchall() == [(0,)]
    other = command.here("evaluate", "--lake", copy, **strict)
    assert other.code == 1
    assert "another protocol" in other.err
    done = command.here("evaluate", "--lake", copy, **full)
    assert done.code == 0, done.err
    assert "constant-velocity " in done.out
    assert "skipped: " in done.err
    assert command.here("evaluate", "old", "--lake", copy, **full).code == 1


@pytest.mark.parametrize("name", ["../tracks", "/etc", ".hidden", "constant-velocity", "lane-forest"])
def test_a_runs_name_cannot_reach_other_folders(command, lake, name):
    done = command.here("train", "lstm", "--lake", lake.root, "--seconds", "0.5", f"--name={name}")
    assert done.code == 2
    assert (lake.root / "tracks").is_dir()


def test_words_that_are_none_of_the_choices_are_usage_errors(command, lake, tmp_path):
    calls = [
        ("evaluate", "--part", "foo", "--lake", lake.root),
        ("evaluate", "--protocol", "foo", "--lake", lake.root),
        ("train", "foo", "--lake", lake.root),
        ("sql", "SELECT 1", "--format", "foo", "--lake", lake.root),
        ("sample", "--out", tmp_path / "s", "--format", "foo"),
        ("sample", "--out", tmp_path / "s", "--minutes", "99999"),
    ]
    for arguments in calls:
        assert command.here(*arguments).code == 2, arguments
    threshold = command.here("validate", "--lake", lake.root, TRACKLAKE_THRESHOLDS='{"high_acceleration": 3}')
    assert threshold.code == 2
    assert "high_acceleration_mps2" in threshold.err


def test_a_foreign_folder_is_left_as_it_is(command, tmp_path):
    raw = write_part(tmp_path / "raw" / "a.csv", range(1, 3))
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.md").write_text("mine")
    done = command.here("ingest", raw, "--lake", mine, "--json")
    assert done.code == 1
    assert "holds other files (notes.md)" in json.loads(done.out)["error"]
    assert [path.name for path in mine.iterdir()] == ["notes.md"]


def test_linked_folders_are_followed_once(command, tmp_path):
    write_part(tmp_path / "disk" / "a.csv", range(1, 3))
    source = tmp_path / "raw"
    source.mkdir()
    (source / "link").symlink_to(tmp_path / "disk")
    (tmp_path / "disk" / "loop").symlink_to(source)
    assert command.here("ingest", source, "--lake", tmp_path / "lake").code == 0
    assert count(tmp_path / "lake") == 20


def test_a_reader_that_has_seen_enough_ends_the_output_quietly(command, lake):
    line = f"'{sys.executable}' -m tracklake.pipeline.cli.app sql 'FROM tracks' --lake {lake.root} --format csv | head"
    done = subprocess.run(
        ["bash", "-c", line], env=command.environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout.startswith("dataset,subset,vehicle_id")
    assert "Broken pipe" not in done.stderr


def test_a_lake_in_the_samples_own_folder_is_refused_before_anything_is_generated(tmp_path, monkeypatch, command):
    monkeypatch.setattr(generated_sample, "write_generated", lambda *_: pytest.fail("generated"))
    done = command.here("run", "--lake", str(tmp_path / "sample"))
    assert done.code == 2
    assert "the generated sample itself goes to this folder" in done.err
    assert not (tmp_path / "sample").exists()
