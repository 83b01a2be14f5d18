"""A long recording: ingested and worked on in slices of time, it has the tables that it has undivided, value for value.

The corridor is one of I-24 MOTION, seen for 40 s around the border of two periods: vehicles begin and end at all
times, some stand in a jam, are lost for a while, change lanes, drive beside all lanes, or have two tracks.
"""

import json

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal
from stage_runs import run_stage

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.lake import Manifest, load, open_for_writing, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.schemas import (
    FINDINGS,
    LANE_CHANGE_EVENTS,
    NEIGHBORS,
    RECONSTRUCTED,
    SAMPLES,
    SPLIT_LEFT_OUT,
    SPLITS,
    TABLES,
    TRACKS,
    UNKEPT_BOUNDS,
)

START = 1_669_118_400 + 300 - 24
"""24 s before a period ends, in s since 1970."""
STAGES = ("validate", "repair", "assess", "reconstruct", "revalidate", "traffic", "samples", "split", "tensors")
LANES_FT = (18.0, 30.0, 42.0)


def drive(number, rng):
    """Frames, way in ft and lateral position in ft of one vehicle: there is a jam from frame 500 to frame 700."""
    first = int(rng.integers(-200, 700)) if number > 3 else 0
    frames = np.arange(max(first, 0), min(first + int(rng.integers(300, 1000)), 1000))
    speed_ftps = 80 + 5 * np.sin(frames / 50 + number)
    speed_ftps[(frames > 500) & (frames < 700)] *= 0.02
    way = np.cumsum(speed_ftps) / 25 + rng.normal(0, 0.02, len(frames)) - 900 * (number // 3 % 4)
    lane, middle = number % 3, frames[0] + len(frames) * rng.random()
    moves = rng.integers(-1, 2) if 0 < lane < 2 else 0
    y = LANES_FT[lane] + 12 * moves / (1 + np.exp((middle - frames) / 12)) + 0.02 * rng.normal(size=len(frames))
    kept = np.ones(len(frames), bool)
    for lost in rng.integers(1, [250, 60, 3]) if number % 2 else ():
        begin = rng.integers(1, len(frames))
        kept[begin : begin + lost] = False
    kept[:2] = True
    return frames[kept], way[kept], y[kept]


def write_corridor(folder):
    rng = np.random.default_rng(5)
    documents = []
    for number in range(17):
        sign = 1 if number < 13 else -1
        frames, way, y = drive(number, rng)
        if number == 16:
            y = y + 90  # on no lane
        again = [(frames, way, y)] * (2 if number == 7 else 1)
        for frames, way, y in again:
            documents.append(
                {
                    "_id": {"$oid": f"{len(documents):024x}"},
                    "timestamp": (START + frames / 25).tolist(),
                    "x_position": (60 * 5280 + sign * way).round(4).tolist(),
                    "y_position": y.round(4).tolist(),
                    "length": 15.0,
                    "width": 6.0,
                    "coarse_vehicle_class": 0,
                    "direction": sign,
                }
            )
    folder.mkdir(parents=True)
    (folder / "corridor.json").write_text(json.dumps(documents), encoding="utf-8")


def make_lake(source, root, entries):
    rules = {"safety_thresholds": {"ttc_s": 5.0}, "max_backward_share": 1}
    settings = Settings(slice_entries=entries, split="time-blocks", split_block_s=11, **rules)
    with open_for_writing(root) as writer:
        found = discover(source, recording="day", digest=hash_raw)
        for dataset, file in ingest.find_unread_files(found, writer.manifest):
            writer.remember_sources({file.sha256: ingest.read_file(root, dataset.name, file)})
        for job in ingest.plan(found, writer.manifest):
            writer.commit(ingest.build(root, job, entries))
    for stage in STAGES:
        run_stage(root, stage, settings)
    return root


def read_tables(root):
    manifest = load(root)
    frames = {table: scan(root, manifest, table).collect() for table in TABLES}
    return {table: frame.sort([*table.partition, *table.key]) for table, frame in frames.items() if frame.height}


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corridor") / "raw"
    write_corridor(folder)
    return folder


def read_tensors(root):
    return {file.path: (root / file.path).read_bytes() for file in load(root).live("tensors")}


@pytest.fixture(scope="module")
def undivided(corridor, tmp_path_factory):
    """The lake of the undivided recording."""
    return make_lake(corridor, tmp_path_factory.mktemp("whole") / "lake", 10**9)


@pytest.fixture(scope="module")
def whole(undivided):
    """The tables of the undivided recording."""
    return read_tables(undivided)


def test_the_corridor_has_what_slices_could_spoil(whole):
    tracks = whole[TRACKS]
    assert set(tracks["subset"]) == {"day-east", "day-west"}
    east = tracks.filter(subset="day-east")
    assert east["frame"].min() < 7500 < east["frame"].max(), "two periods"
    assert (east["speed_mps"] < 1).sum() > 500
    steps = east.select(pl.col("frame").diff().over("vehicle_id"))["frame"]
    assert steps.max() > 150
    assert {"frame_gap", "duplicate_track", "overlap"} <= set(whole[FINDINGS]["rule"])
    assert whole[LANE_CHANGE_EVENTS].height > 2
    assert set(whole[SAMPLES]["subset"]) == {"day-east"}, "an entry of the other has no lane"
    assert whole[RECONSTRUCTED].select("imputed", "constrained").sum().row(0) > (10, 10)
    assert whole[UNKEPT_BOUNDS].height > 5
    assert whole[SPLITS]["part"].n_unique() > 1
    assert whole[SPLIT_LEFT_OUT].height > 0


@pytest.mark.parametrize("entries", [pytest.param(1, marks=pytest.mark.thorough), 2_001])
def test_slices_have_the_tables_of_the_whole(corridor, undivided, whole, tmp_path, entries):
    root = make_lake(corridor, tmp_path / "lake", entries)
    made = read_tables(root)
    assert {table.name for table in made} == {table.name for table in whole}
    for table, frame in whole.items():
        assert_frame_equal(made[table], frame, check_exact=True)
    assert read_tensors(root) == read_tensors(undivided)
    files = [file for table in (TRACKS, RECONSTRUCTED, SAMPLES, NEIGHBORS) for file in load(root).live(table.name)]
    assert len(files) > 6
    # Files by name are slices in order of time, in the store and in the live folders.
    shown = pl.scan_parquet(root / TRACKS.name)
    for rows in (scan(root, load(root), TRACKS), shown):
        assert rows.select((pl.col("frame").diff() > 0).over("subset", "vehicle_id").all()).collect().item()
    assert shown.select(pl.len()).collect().item() == whole[TRACKS].height
    # A subset is read in the order of its key, in however many files it is.
    reader = LakeReader(root, load(root)).open_subset("i24", "day-east")
    assert reader.table(TRACKS, "frame", "x_m").equals(whole[TRACKS].filter(subset="day-east").select("frame", "x_m"))


def test_a_file_of_which_no_trajectory_can_be_used_is_refused(tmp_path):
    document = {"timestamp": [START, START + 0.04], "x_position": [1.0, 2.0], "y_position": [18.0, 18.0]}
    file = tmp_path / "corridor.json"
    file.write_text(json.dumps([{**document, "length": 15.0, "width": 6.0, "direction": 3}]), encoding="utf-8")
    ((source, unread),) = ingest.find_unread_files(discover(file, recording="day", digest=hash_raw), Manifest())
    with pytest.raises(SourceError, match="none of its 1 rows can be read; this one: direction is neither 1 nor -1"):
        ingest.read_file(tmp_path / "lake", source.name, unread)


def test_a_recording_of_decades_is_refused(tmp_path):
    steps = np.arange(20)
    documents = [
        {
            "timestamp": (begin + steps / 25).tolist(),
            "x_position": (60.0 * 5280 + 3 * steps).tolist(),
            "y_position": [18.0] * 20,
            **{"length": 15.0, "width": 6.0, "coarse_vehicle_class": 0, "direction": 1},
        }
        for begin in (0, START)
    ]
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "corridor.json").write_text(json.dumps(documents), encoding="utf-8")
    with pytest.raises(SourceError, match="day: its trajectories are from 1970-01-01 to 2022-11-22; expected"):
        make_lake(tmp_path / "raw", tmp_path / "lake", 10)
