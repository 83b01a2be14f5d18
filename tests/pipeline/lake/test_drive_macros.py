"""The table macros of drives: numbers derived by hand from the drive of helpers/known_drive.py."""

import pytest
from known_drive import make_drive, put_drive

from tracklake.pipeline.lake import connect


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    root = tmp_path_factory.mktemp("drive")
    put_drive(root, make_drive())
    with connect(root) as connection:
        yield connection


def test_the_vehicles_around_the_ego_come_with_their_sources_the_nearest_first(drive):
    found = drive.sql(
        "SELECT vehicle_id, tick, round(distance_m, 3), rel_x_m, sources, round(since_message_s::DOUBLE, 3), "
        "round(sigma_m, 3)"
        " FROM around_ego('drive-1', 2.55)"
    ).fetchall()
    assert found == [
        (2, 25, 4.95, 3.5, ["v2v"], 0.1, 1.0),  # 2.5 + 1 m ahead, 3.5 m to the left
        (1_000_000, 25, 15.598, 15.2, ["lidar"], None, 0.2),
        (1, 25, 30.2, 30.2, ["lidar"], 0.6, 0.2),  # its last message is of tick 19
    ]
    even = "SELECT sources FROM around_ego('drive-1', 1.2) WHERE vehicle_id = 1"
    assert drive.sql(even).fetchall() == [(["v2v", "lidar", "camera"],)]
    assert drive.sql("FROM around_ego('drive-1', 99)").fetchall() == []


def test_a_gap_is_longer_than_asked_for(drive):
    columns = "vehicle_id, from_s, until_s, gap_s, lost, id_changed"
    expected = [(1, 1.9, 3.0, 1.1, 10, False)]
    assert drive.sql(f"SELECT {columns} FROM message_gaps('drive-1', 0.1)").fetchall() == expected
    assert drive.sql("FROM message_gaps('drive-1', 1.1)").fetchall() == []
    changed = "SELECT vehicle_id, until_s FROM message_gaps('drive-1', 0.05) WHERE id_changed"
    assert drive.sql(changed).fetchall() == [(2, 4.0)]


def test_errors_are_distances_from_the_truth(drive):
    found = drive.sql(
        "SELECT vehicle_id, tick, truth_id, distance_m, round(error_x_m, 6), round(error_y_m, 6), round(error_m, 6),"
        " round(smoothed_error_m, 6), speed_error_mps FROM drive_errors('drive-1') WHERE tick IN (5, 40)"
    ).fetchall()
    assert found == [
        (1, 5, 11, 30.0, 0.0, 1.0, 1.0, 0.5, 0.0),
        (1, 40, 11, 30.0, 0.2, 0.0, 0.2, 0.1, 0.0),
        (2, 5, 12, pytest.approx((7.5**2 + 3.5**2) ** 0.5), 1.0, 0.0, 1.0, 0.5, 0.0),
        (2, 40, 12, pytest.approx((10.0**2 + 3.5**2) ** 0.5), 1.0, 0.0, 1.0, 0.5, 0.0),
    ]
    ((rows,),) = drive.sql("SELECT count(*) FROM drive_errors('drive-1')").fetchall()
    assert rows == 2 * 59, "the vehicle that only LiDAR saw has no truth of its own"
