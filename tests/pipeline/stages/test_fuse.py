"""The stage that tracks the vehicles around an ego: on a lake's drive, without positions, and its reading of scans."""

import numpy as np
import polars as pl
import pytest
from drive_scenes import compare, drive, put_scene

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.fuse import SCANS_PER_READ, STAGE, build, read_scans
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import DRIVES, EGO_STATES, LIDAR_RETURNS, SURROUNDING

PLACE = {"dataset": "v2v", "subset": "trip"}


def open_reader(root):
    return SubsetReader(root, load(root), None, Job("fuse/v2v/trip", ""), PLACE)


@pytest.fixture
def scene():
    return drive([0, 30, 20], [0, 0, 3.7], [20, 20, 22], seconds=6, gps_m=0.3)


def test_vehicles_of_a_drive_are_tracked(tmp_path, scene):
    put_scene(tmp_path, scene)
    (job,) = Planner(tmp_path, load(tmp_path), Settings()).plan("fuse")
    commit = build_job(STAGE, tmp_path, job, Settings())
    assert set(commit.files) == {"surrounding", "association", "lidar_clusters"}
    assert (commit.info["notes"], commit.info["ticks_without_ego"]) == ([], 0)
    rows = compare(scene, build(open_reader(tmp_path), Settings()).tables[SURROUNDING])
    assert rows["error_m"].median() < 1.0
    assert rows["tick"].max() == 59


def test_drive_without_positions_of_the_ego_is_skipped_with_a_reason(tmp_path, scene):
    put_scene(tmp_path, scene, {EGO_STATES: pl.DataFrame.clear})
    result = build(open_reader(tmp_path), Settings())
    assert [frame.height for frame in result.tables.values()] == [0, 0, 0]
    assert result.notes == ["trip: vehicles around the ego are not tracked: no position of the ego was logged"]


def test_drive_with_a_wrong_clock_is_skipped_with_a_reason(tmp_path, scene):
    put_scene(tmp_path, scene, {DRIVES: lambda rows: rows.with_columns(seconds=pl.lit(1e9))})
    assert "1,000,000,000 s, more than a day" in build(open_reader(tmp_path), Settings()).notes[0]


def test_ticks_without_the_ego_are_counted(tmp_path, scene):
    put_scene(tmp_path, scene, {EGO_STATES: lambda rows: rows.filter(pl.col("time_s") < 0.95)})
    result = build(open_reader(tmp_path), Settings())
    assert result.notes == ["trip: the ego's position is unknown at 35 of 60 ticks, which have no rows"]
    assert result.tables[SURROUNDING]["tick"].max() == 24


def test_scans_are_read_in_slices():
    counts = np.arange(SCANS_PER_READ + 7) % 4  # some scans have no returns
    scan = np.repeat(np.arange(len(counts)), counts)
    rows = pl.LazyFrame({"scan": scan, "time_s": scan / 10, "x_m": np.arange(len(scan)) * 1.0, "y_m": 0.0, "z_m": 1.0})
    read = list(read_scans(rows, len(counts)))
    assert [round(time_s * 10) for time_s, _ in read] == np.flatnonzero(counts).tolist()
    assert [len(points) for _, points in read] == counts[counts > 0].tolist()
    assert np.concatenate([points for _, points in read])[:, 0].tolist() == list(range(len(scan)))
    assert list(read_scans(LIDAR_RETURNS.empty().lazy(), 0)) == []
