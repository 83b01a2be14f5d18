"""The stage that tracks the vehicles around an ego: on a lake's drive, without positions, and its reading of scans."""

import numpy as np
import polars as pl
import pytest
from drive_scenes import compare, conform, drive, put_scene

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.fuse import SCANS_PER_READ, STAGE, build, read_scans
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import BSM, DRIVES, EGO_STATES, LIDAR_CLUSTERS, LIDAR_RETURNS, SURROUNDING

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
    (note,) = result.notes
    assert note.startswith(
        "trip: vehicles around the ego are not tracked: no position of the ego was logged; add a log"
    )


def test_drive_with_a_wrong_clock_is_skipped_with_a_reason(tmp_path, scene):
    put_scene(tmp_path, scene, {DRIVES: lambda rows: rows.with_columns(seconds=pl.lit(1e9))})
    assert "1,000,000,000 s, more than a day" in build(open_reader(tmp_path), Settings()).notes[0]


def test_ticks_without_the_ego_are_counted(tmp_path, scene):
    put_scene(tmp_path, scene, {EGO_STATES: lambda rows: rows.filter(pl.col("time_s") < 0.95)})
    result = build(open_reader(tmp_path), Settings())
    (note,) = result.notes
    assert note.startswith("trip: the ego's position is unknown at 35 of 60 ticks, which have no rows; add a log")
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


def test_lidar_and_camera_are_used_where_logged_and_wanted(tmp_path):
    """A car that LiDAR shows by its rear, 1.8 m wide, 30 m ahead; its messages are 2 m off to the right."""
    across = np.linspace(-0.9, 0.9, 19)
    rear = np.stack(np.broadcast_arrays(30 - 2.4, across[:, None], np.array([0.5, 0.9])), -1).reshape(-1, 3)
    scans = np.repeat(np.arange(60), len(rear))
    returns = pl.DataFrame(np.tile(rear, (60, 1)), schema=["x_m", "y_m", "z_m"]).with_columns(
        scan=scans, point=np.tile(np.arange(len(rear)), 60), time_s=scans / 10
    )
    alone = drive([0, 30], [0, 0], [20, 20], seconds=6, gps_m=0.0, random_m=0.05, heading_error_deg=0.0)
    shifted = {
        LIDAR_RETURNS: lambda _: conform(LIDAR_RETURNS, returns),
        BSM: lambda rows: rows.with_columns(
            pl.col("lat_deg") - 2 * np.sin(np.radians(30)) / 111_080,
            pl.col("lon_deg") + 2 * np.cos(np.radians(30)) / 82_400,
        ),
        DRIVES: lambda rows: rows.with_columns(scans=pl.lit(60, pl.Int32), images=pl.lit(1, pl.Int32)),
    }
    put_scene(tmp_path, alone, shifted)
    result = build(open_reader(tmp_path), Settings())
    assert result.notes == [
        "trip: camera boxes are not used: `drives` lacks camera_fx_px, camera_fy_px, camera_cx_px, camera_cy_px, "
        "camera_x_m, camera_y_m, camera_z_m"
    ]
    late = pl.col("tick") > 30
    rows = result.tables[SURROUNDING].filter(late)
    assert rows["vehicle_id"].unique().to_list() == [1]
    assert rows["from_lidar"].all()
    assert compare(alone, rows)["error_m"].max() < 0.2
    without = build(open_reader(tmp_path), Settings(onboard_lidar=False, onboard_camera=False))
    assert without.notes == []
    assert without.tables[LIDAR_CLUSTERS].is_empty()
    assert compare(alone, without.tables[SURROUNDING].filter(late))["error_m"].median() == pytest.approx(2.0, abs=0.3)
