"""`tracklake split --plan`: from recordingMeta and tracksMeta alone, and what it says where they do not do."""

import csv
import gzip
import io
import json
import zipfile
from dataclasses import replace

import pytest
from highd_files import VEHICLES, meta_row, vehicle_row, write_recording
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app
from tracklake.pipeline.ingest.discovery import recognise
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.highd_plan import announce_subsets
from tracklake.pipeline.transforms.splits.published import PUBLISHED_SPLITS


def write_metadata(folder, number="01", **given):
    """A recording without its tracks."""
    *metadata, tracks = write_recording(folder, number=number, **given)
    tracks.unlink()
    return metadata


@pytest.fixture
def run(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, ["split", "--plan", *map(str, arguments)])


def test_subsets_by_hand(tmp_path):
    # Two vehicles of two frames each drive up, two of two and one frame down; two lanes each; 901.56 s.
    write_metadata(tmp_path / "deep" / "er")
    announced = announce_subsets(recognise(tmp_path, "highd"))
    assert announced.refusals == ()
    rate = pytest.approx(2 / 2 / 901.56)
    assert announced.subsets.rows() == [
        ("highd", "01-upper", "location-3", "upper", 2, 4, rate, 1, 2, "01", "recorded", 2, 901.56),
        ("highd", "01-lower", "location-3", "lower", 2, 3, rate, 1, 2, "01", "recorded", 2, 901.56),
    ]


def test_lanes_differ_by_carriageway_and_one_without_vehicles_is_none(tmp_path):
    write_metadata(tmp_path, meta=meta_row(1, upper="8;12;16;20", duration="100", vehicles=2), vehicles=VEHICLES[:2])
    (row,) = announce_subsets(recognise(tmp_path, "highd")).subsets.iter_rows(named=True)
    assert (row["subset"], row["lanes"], row["vehicles_per_lane_s"]) == ("01-upper", 3, pytest.approx(2 / 3 / 100))


def test_archives_and_gzipped_files_are_read(tmp_path):
    paths = write_metadata(tmp_path / "raw")
    with zipfile.ZipFile(tmp_path / "highd.zip", "w") as archive:
        for path in paths:
            archive.write(path, f"data/{path.name}")
            path.unlink()
    (tmp_path / "gz").mkdir()
    for path in write_metadata(tmp_path / "raw", number="02"):
        (tmp_path / "gz" / f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    announced = announce_subsets(recognise(tmp_path, "highd"))
    assert announced.subsets["subset"].to_list() == ["01-upper", "01-lower", "02-upper", "02-lower"]


def test_the_tracks_are_not_read(run, tmp_path):
    *_, tracks = write_recording(tmp_path)
    with tracks.open("a") as file:
        file.write("no number,at all\n" * 10)
    assert run(tmp_path, "--format", "csv").exit_code == 0


def test_csv_json_and_table_tell_the_same(run, tmp_path):
    for number in ("01", "02", "03"):
        frames = [vehicle_row(vehicle, 4, 2, 10 * int(number) + vehicle, 1 + vehicle % 2) for vehicle in range(1, 11)]
        write_metadata(tmp_path, number=number, meta=meta_row(int(number), vehicles=10), vehicles=frames)
    rows = list(csv.DictReader(io.StringIO(run(tmp_path, "--format", "csv").stdout)))
    shown = ["dataset", "subset", "site", "direction", "vehicles", "weight", "vehicles_per_lane_s", "part"]
    assert list(rows[0]) == shown
    assert len(rows) == 6
    # 30 vehicles, five of each carriageway: one must evaluate of each direction, which is 10 of them.
    assert sorted((row["direction"], row["part"]) for row in rows).count(("upper", "eval")) == 1
    assert sum(row["part"] == "eval" for row in rows) == 2
    listed = json.loads(run(tmp_path, "--format", "json").stdout)
    assert [{name: str(value) for name, value in row.items()} for row in listed] == rows
    whole = json.loads(run(tmp_path, "--json").stdout)
    assert whole["splits"] == listed
    assert {row["part"]: row["vehicles"] for row in whole["balance"]} == {"train": 20, "eval": 10}
    assert "numFrames" in whole["notes"][0]
    table = run(tmp_path).stdout
    assert all(row["subset"] in table for row in rows)
    assert "train: 4 subsets, 66.67% of the vehicles" in table
    assert "relaxed: train holds 0.667 of the vehicles instead of 0.800" in table
    assert "weights are numFrames of tracksMeta" in table
    assert run(tmp_path, "--format", "csv", "--out", "plan.csv").exit_code == 0
    assert list(csv.DictReader(io.StringIO((tmp_path / "plan.csv").read_text()))) == rows
    assert not (tmp_path / "lake").exists(), "a plan makes no lake"


def test_what_is_excluded_is_not_there(run, tmp_path):
    write_metadata(tmp_path)
    found = run(tmp_path, "--exclude", "01-upper", "--format", "csv").stdout
    assert [row["subset"] for row in csv.DictReader(io.StringIO(found))] == ["01-lower"]
    refused = run(tmp_path, "--exclude", "25-upper")
    assert (refused.exit_code, "no such subset" in refused.stderr) == (2, True)


def test_a_published_split_is_compared_on_its_whole_dataset_alone(run, tmp_path, monkeypatch):
    for number in ("01", "02", "03"):
        frames = [vehicle_row(vehicle, 4, 2, 10 * int(number) + vehicle, 1 + vehicle % 2) for vehicle in range(1, 11)]
        write_metadata(tmp_path, number=number, meta=meta_row(int(number), vehicles=10), vehicles=frames)
    excerpt = run(tmp_path, "--published", "highd-2020")
    assert (excerpt.exit_code, excerpt.stdout) == (1, "")
    assert "is of 110,516 vehicles with 39,725,708 rows; got 30 with " in " ".join(excerpt.stderr.split())
    plain = json.loads(run(tmp_path, "--json").stdout)
    assert plain["published"] is None
    rows = sum(row["weight"] for row in plain["splits"])
    known = replace(PUBLISHED_SPLITS["highd-2020"], vehicles=30, entries=rows, excluded=("02-upper",))
    monkeypatch.setitem(PUBLISHED_SPLITS, "highd-2020", known)
    found = json.loads(run(tmp_path, "--published", "highd-2020", "--json").stdout)
    assert [row["subset"] for row in found["splits"]] == ["01-lower", "01-upper", "02-lower", "03-lower", "03-upper"]
    beside = found["published"]
    assert (beside["carriageways"], beside["published_difference"]) == (5, 0.002)
    mean = {}
    for part in ("train", "eval"):
        own = [row for row in found["splits"] if row["part"] == part]
        mean[part] = sum(row["weight"] * row["vehicles_per_lane_s"] for row in own) / sum(row["weight"] for row in own)
    assert beside["difference"] == pytest.approx(abs(mean["train"] - mean["eval"]), abs=1e-9)
    shown = run(tmp_path, "--published", "highd-2020").stdout
    assert "published for these 5 carriageways: train 0.349 +- 0.076, eval 0.351 +- 0.075, apart by 0.002" in shown
    assert "its text says 57 subsets where 117 carriageways remain" in " ".join(shown.split())
    assert run(tmp_path, "--published", "highd-2019").exit_code == 2


def test_a_published_split_goes_with_a_plan(tmp_path):
    refused = CliRunner().invoke(app, ["split", "--lake", str(tmp_path), "--published", "highd-2020"])
    assert refused.exit_code == 2
    assert "--published" in refused.stderr


@pytest.mark.parametrize(
    ("name", "reported"),
    [
        ("nowhere", "nowhere: no such file or folder"),
        ("empty", "empty: no metadata of highD there. Expected NN_recordingMeta.csv and NN_tracksMeta.csv"),
        ("ngsim", "ngsim: no metadata of highD there"),
        ("tracks", "got 1 other file(s) of highD"),
        ("alone", "recording 01: 01_tracksMeta.csv missing beside 01_recordingMeta.csv"),
        ("mixed", "expected id 7, as the file's name says, got 1"),
    ],
)
def test_a_folder_without_the_metadata_is_explained(run, tmp_path, name, reported):
    (tmp_path / "empty").mkdir()
    (tmp_path / "ngsim").mkdir()
    (tmp_path / "ngsim" / "i-80.txt").write_text("1 2 3\n")
    for path in write_recording(tmp_path / "tracks")[:2]:
        path.unlink()
    write_metadata(tmp_path / "alone")[1].unlink()
    for path in write_metadata(tmp_path / "mixed"):
        path.rename(path.with_name(path.name.replace("01_", "07_")))
    found = run(name)
    assert found.exit_code == 1
    assert reported in found.stderr
    assert found.stdout == ""


def test_a_recording_that_cannot_be_used_leaves_the_others(run, tmp_path):
    write_metadata(tmp_path, number="01")
    write_metadata(tmp_path, number="02")[1].unlink()
    found = run(tmp_path, "--format", "csv")
    assert found.exit_code == 3
    assert {row["subset"] for row in csv.DictReader(io.StringIO(found.stdout))} == {"01-upper", "01-lower"}
    assert "refused: recording 02: 02_tracksMeta.csv missing" in found.stderr


def test_options_of_a_plan_need_a_plan():
    found = CliRunner().invoke(app, ["split", "--format", "csv"])
    assert (found.exit_code, "go with --plan" in found.stderr) == (2, True)


def test_no_files_are_no_plan():
    with pytest.raises(SourceError, match="no metadata of highD there"):
        announce_subsets([])
