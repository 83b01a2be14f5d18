"""Stages that work on a long subset in slices make the tables that they make of the whole subset, value for value."""

import shutil

import polars as pl
import pytest
from polars.testing import assert_frame_equal
from stage_runs import run_stage

from tracklake.pipeline.lake import load, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import reconstruct, repair, revalidate, samples, tensors, traffic, validate
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import list_results
from tracklake.schemas import RECONSTRUCTED, SUBSETS


def make_tables(stage, reader, **values):
    """The tables of one subset, sorted by their keys."""
    parts = {}
    for result in list_results(stage.build(reader, Settings(**values))):
        for table, frame in result.tables.items():
            if frame.height:
                parts.setdefault(table, []).append(table.validate(frame, where=result.part))
    return {table: pl.concat(frames).sort(table.key) for table, frames in parts.items()}


@pytest.mark.parametrize(
    ("stage", "values"),
    [
        (validate, {}),
        (reconstruct, {}),
        (revalidate, {}),
        (samples, {}),
        (samples, {"tracks_from": "reconstructed"}),
        (traffic, {}),
        (repair, {}),
    ],
)
@pytest.mark.parametrize(("dataset", "subset"), [("highd", "01-lower"), ("ngsim", None)])
def test_tables_of_slices_are_those_of_the_whole(lake, stage, values, dataset, subset):
    reader = LakeReader(lake.root, load(lake.root))
    if subset is None:  # whose headways are recorded
        subset = reader.scan(SUBSETS).filter(dataset=dataset).sort("entries").collect()["subset"][0]
    own = reader.open_subset(dataset, subset)
    whole, sliced = (
        make_tables(stage, own, **values, **sliced) for sliced in ({}, {"slice_entries": own.facts["entries"] // 3})
    )
    assert len(list(own.cut(Settings(slice_entries=own.facts["entries"] // 3), 1.0))) > 2
    assert whole.keys() == sliced.keys()
    for table, frame in whole.items():
        assert_frame_equal(sliced[table], frame, check_exact=True)


@pytest.mark.parametrize(
    ("tracks_from", "storage"),
    [
        ("recorded", "int16-decimetres"),
        pytest.param("reconstructed", "float32", marks=pytest.mark.thorough),
        pytest.param("filtered", "float32", marks=pytest.mark.thorough),
    ],
)
def test_tensors_of_slices_are_those_of_the_whole(lake, tmp_path, tracks_from, storage):
    def write(name, **values):
        root = tmp_path / name
        shutil.copytree(lake.root, root)
        settings = Settings(lake=root, tracks_from=tracks_from, tensor_positions=storage, **values)
        for stage in ("samples", "split", "tensors"):
            run_stage(root, stage, settings)
        commit = load(root).commits["tensors"]
        assert list(find_scratch(root)) == []
        return commit.info, {file.path: (root / file.path).read_bytes() for file in commit.all_files}

    (info, files), (sliced, parts) = write("whole"), write("sliced", slice_entries=2_000)
    assert info.pop("seconds") != sliced.pop("seconds"), "made once more"
    assert sliced == info
    assert info["samples"] > 1000
    assert parts == files


def test_shares_of_another_division_are_not_taken_for_those_of_this_one(lake, tmp_path):
    """Setting a value back gives the fingerprint of before, whose files are there; shares have other vehicles now."""
    root, key = tmp_path / "lake", "reconstruct/highd/01"
    shutil.copytree(lake.root, root)
    entries = scan(root, load(root), SUBSETS).filter(subset="01-lower").collect()["entries"].item()
    made = []
    for noise_m, slice_entries in ((0.2, entries - 1), (0.3, entries - 1), (0.2, entries // 2)):
        values = {"reconstruct_noise_m": noise_m, "slice_entries": slice_entries}
        (commit,) = run_stage(root, "reconstruct", Settings(lake=root, **values), key)
        made.append((commit, scan(root, load(root), RECONSTRUCTED, dataset="highd", subset="01-lower").collect()))
    (before, whole), (other, _), (again, rows) = made
    assert before.fingerprint == again.fingerprint != other.fingerprint
    assert 1 < len(list_own(before)) < len(list_own(again)), "it is divided otherwise"
    assert_frame_equal(rows, whole, check_exact=True)  # by name, files are in order of vehicles
    assert whole.select("vehicle_id", "frame").is_unique().all()
    assert whole.select("vehicle_id", "frame").equals(whole.select("vehicle_id", "frame").sort("vehicle_id", "frame"))


def list_own(commit):
    return [file for file in commit.files[RECONSTRUCTED.name] if "subset=01-lower" in file.path]


def test_what_a_long_subset_keeps_in_files_is_deleted_before_the_next_one(lake, tmp_path, monkeypatch):
    root = tmp_path / "lake"
    shutil.copytree(lake.root, root)
    found, real = [], tensors.build_subset

    def build_subset(*given, **named):
        found.append([sorted(file.name for file in folder.iterdir()) for folder in find_scratch(root)])
        yield from real(*given, **named)
        found.append([len(list(folder.iterdir())) for folder in find_scratch(root)])

    monkeypatch.setattr(tensors, "build_subset", build_subset)
    for stage in ("samples", "split", "tensors"):
        run_stage(root, stage, Settings(lake=root, slice_entries=2_000, tensor_positions="int16-decimetres"))
    before, after = found[::2], found[1::2]
    assert len(before) > 1
    assert before == [[[]]] * len(before), "one folder, still empty"
    assert max(after) > [0], "some subset is long"


def find_scratch(root):
    """What stages leave in the lake's staging folder."""
    return (root / ".staging").glob("numbers-*")
