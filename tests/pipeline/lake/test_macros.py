"""The table macros: numbers derived by hand."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from macro_lake import PAIRS, entry, put_subset

from tracklake.pipeline.lake import QueryError, connect
from tracklake.pipeline.lake.query import LakeConnection
from tracklake.schemas import TRACKS


@pytest.fixture
def pairs(tmp_path: Path) -> Iterator[LakeConnection]:
    put_subset(tmp_path, PAIRS)
    put_subset(tmp_path, [entry(1, 3, 500.0, 2, 1.0, y_m=5.0)], subset="b")
    with connect(tmp_path) as connection:
        yield connection


def test_track_is_all_entries_of_a_vehicle_in_order(pairs: LakeConnection):
    found = pairs.sql("FROM track('a', 1)")
    assert found.columns == list(TRACKS.dtypes)
    rows = found.pl().select("subset", "vehicle_id", "frame", "time_s", "x_m", "leader_id", "gap_m").rows()
    assert rows == [
        ("a", 1, 1, 0.0, 20.0, 2, 30.0),
        ("a", 1, 2, 0.5, 30.0, 2, 25.0),
        ("a", 1, 3, 1.0, 61.0, 2, -1.0),
        ("a", 1, 4, 1.5, 71.0, 2, 5.0),
    ]


def test_leader_follower_pairs_entries_of_the_same_frame(pairs: LakeConnection):
    found = pairs.sql(
        "SELECT follower_id, leader_id, frame, time_s, x_m, follower_class, leader_class, spacing_m, gap_m,"
        " follower_speed_mps, leader_speed_mps, time_headway_s, closing_mps, ttc_s FROM leader_follower('a')"
    )
    assert found.fetchall() == [
        # 42 m at 20 m/s are 2.1 s; 30 m closed at 10 m/s last 3 s
        (1, 2, 1, 0.0, 20.0, "car", "truck", 42.0, 30.0, 20.0, 10.0, 2.1, 10.0, 3.0),
        # 37 m at 10 m/s; not closing
        (1, 2, 2, 0.5, 30.0, "car", "truck", 37.0, 25.0, 10.0, 10.0, 3.7, 0.0, None),
        # 11 m at 20 m/s; closing, but they overlap
        (1, 2, 3, 1.0, 61.0, "car", "truck", 11.0, -1.0, 20.0, 10.0, 0.55, 10.0, None),
        # standing: no time headway
        (3, 1, 1, 0.0, 10.0, "car", "car", 10.0, 6.0, 0.0, 20.0, None, -20.0, None),
        # backwards: none either
        (3, 1, 2, 0.5, 9.0, "car", "car", 21.0, 17.0, -2.0, 10.0, None, -12.0, None),
    ]


def test_a_gap_of_nothing_leaves_no_time(tmp_path: Path):
    put_subset(tmp_path, [entry(2, 1, 32.0, 1, 10.0), entry(1, 1, 20.0, 1, 15.0, leader_id=2, gap_m=0.0)])
    with connect(tmp_path) as connection:
        assert connection.sql("SELECT gap_m, ttc_s FROM leader_follower('a')").fetchall() == [(0.0, 0.0)]


def test_scene_is_everyone_at_a_frame(pairs: LakeConnection):
    found = pairs.sql(
        "SELECT vehicle_id, class, length_m, width_m, lane, x_m, speed_mps, leader_id, gap_m FROM scene('a', 1)"
    )
    assert found.fetchall() == [
        (2, "truck", 12.0, 2.0, 1, 62.0, 10.0, None, None),
        (1, "car", 4.0, 2.0, 1, 20.0, 20.0, 2, 30.0),
        (3, "car", 5.0, 2.0, 1, 10.0, 0.0, 1, 6.0),
    ]
    assert pairs.sql("SELECT subset, frame, time_s, vehicle_id FROM scene('b', 3)").fetchall() == [("b", 3, 1.0, 1)]
    assert pairs.sql("FROM scene('a', 99)").fetchall() == []


def test_near_is_within_the_radius_and_on_it(tmp_path: Path):
    here = [
        entry(1, 1, 103.0, 1, 5.0, y_m=6.0),  # 3 ahead, 4 to the right: 5 m
        entry(2, 1, 94.0, 1, 5.0, y_m=-6.0),  # 6 behind, 8 to the left: 10 m
        entry(3, 1, 100.0, 1, 5.0, y_m=2.0),  # there
        entry(4, 1, 110.01, 1, 5.0, y_m=2.0),  # 1 cm too far
        entry(4, 2, 100.0, 1, 5.0, y_m=2.0),  # another frame
    ]
    put_subset(tmp_path, here)
    with connect(tmp_path) as connection:
        asked = "SELECT vehicle_id, distance_m, dx_m, dy_m FROM near('a', 1, 100, 2, 10)"
        assert connection.sql(asked).fetchall() == [(3, 0.0, 0.0, 0.0), (1, 5.0, 3.0, 4.0), (2, 10.0, -6.0, -8.0)]
        counts = [
            connection.sql(f"FROM near('a', 1, 100, 2, {radius})").count() for radius in ("0", "-0.0", "-10", "NULL")
        ]
        assert counts == [1, 1, 0, 0]  # only the one that is there; none is nearer than that


def test_lane_changes_bridge_no_gaps(tmp_path: Path):
    lanes = {1: 2, 2: 1, 3: 1, 5: 3, 6: None, 7: 2, 8: 3, 9: 1}
    put_subset(
        tmp_path,
        [entry(1, frame, 10.0 * frame, lane, 20.0, lateral_speed_mps=0.5) for frame, lane in lanes.items()]
        # Another vehicle that begins in another lane changes none, nor does one that stays.
        + [entry(2, frame, 10.0 * frame, 5, 20.0) for frame in (9, 10)]
        + [entry(4, 10, 10.0, 1, 20.0)],
    )
    with connect(tmp_path) as connection:
        found = connection.sql(
            "SELECT vehicle_id, frame, time_s, from_lane, to_lane, direction, x_m, speed_mps, lateral_speed_mps"
            " FROM lane_changes('a')"
        ).fetchall()
    assert found == [
        (1, 2, 0.5, 2, 1, "left", 20.0, 20.0, 0.5),
        # frame 5: a gap before it; 6 and 7: no lane on one side
        (1, 8, 3.5, 2, 3, "right", 80.0, 20.0, 0.5),
        (1, 9, 4.0, 3, 1, "left", 90.0, 20.0, 0.5),  # one change, over two lanes
    ]


FLOWING = [
    *(entry(1, frame, 10.0 * (frame - 1), 1, 20.0) for frame in range(1, 6)),
    *(entry(2, frame, 85.0 + 5.0 * (frame - 2), 2, 10.0) for frame in (3, 4, 5)),
    *(entry(3, frame, 50.0, None, 0.0) for frame in (9, 10)),
]


def test_flow_density_by_edies_definitions(tmp_path: Path):
    """2 Hz, 5 s in intervals of 2, 2 and 1 s; the section runs from 0 to 100 m: L T is 200, 200 and 100 m s."""
    put_subset(tmp_path, FLOWING)
    with connect(tmp_path) as connection:
        found = connection.sql("FROM flow_density('a', 2)").pl()
    assert found["section_m"].to_list() == [100.0] * 9
    assert found.drop("dataset", "subset", "section_m").rows() == [
        # lane, interval, start, length, entries; m; s; veh/h; veh/km; m/s
        (1, 0, 0.0, 2.0, 4, 40.0, 2.0, 720.0, 10.0, 20.0),  # 40 / 200 * 3600; 2 / 200 * 1000
        (1, 1, 2.0, 2.0, 1, 10.0, 0.5, 180.0, 2.5, 20.0),
        (1, 2, 4.0, 1.0, 0, 0.0, 0.0, 0.0, 0.0, None),
        (2, 0, 0.0, 2.0, 2, 10.0, 1.0, 180.0, 5.0, 10.0),
        (2, 1, 2.0, 2.0, 1, 5.0, 0.5, 90.0, 2.5, 10.0),
        (2, 2, 4.0, 1.0, 0, 0.0, 0.0, 0.0, 0.0, None),
        (None, 0, 0.0, 2.0, 0, 0.0, 0.0, 0.0, 0.0, None),
        (None, 1, 2.0, 2.0, 0, 0.0, 0.0, 0.0, 0.0, None),
        (None, 2, 4.0, 1.0, 2, 0.0, 1.0, 0.0, 10.0, 0.0),  # 1 / 100 * 1000
    ]


def test_flow_density_of_the_whole_recording_and_of_every_frame(tmp_path: Path):
    put_subset(tmp_path, FLOWING)
    with connect(tmp_path) as connection:
        asked = "SELECT lane, interval_s, distance_m, time_s, flow_veh_per_h, speed_mps FROM flow_density('a', 100)"
        assert connection.sql(asked).fetchall() == [
            (1, 5.0, 50.0, 2.5, 360.0, 20.0),
            (2, 5.0, 15.0, 1.5, 108.0, 10.0),
            (None, 5.0, 0.0, 1.0, 0.0, 0.0),
        ]
        each = connection.sql("SELECT entries, interval_s FROM flow_density('a', 0.5) WHERE lane = 1").fetchall()
        assert each == [(1, 0.5)] * 5 + [(0, 0.5)] * 5
        for wrong in ("0", "-1", "NULL"):
            with pytest.raises(QueryError, match="seconds must be above 0"):
                connection.sql(f"FROM flow_density('a', {wrong})").fetchall()


@pytest.mark.parametrize("seconds", [0.28, 0.7, 0.1])
def test_intervals_hold_the_frames_they_should(tmp_path: Path, seconds: float):
    """28, 70 and 10 frames, asked for in the seconds of the subset's own 2 Hz: 14, 35 and 5 s.

    In floating point, 0.28 * 100 / 2 is a little more than 14.
    """
    rate, frames = 100, 300
    entries = [entry(1, frame, frame / 10, 1, 10.0) for frame in range(1, frames + 1)]
    put_subset(tmp_path, [{**row, "time_s": (row["frame"] - 1) / rate} for row in entries], seconds=frames / rate)
    per_interval = round(seconds * rate)
    whole, rest = divmod(frames, per_interval)
    with connect(tmp_path) as connection:
        # The rate in its row is what counts, whatever time its entries say.
        found = connection.sql(f"SELECT entries FROM flow_density('a', {seconds * rate / 2})").fetchall()
    assert [count for (count,) in found] == [per_interval] * whole + ([rest] if rest else [])


def test_a_recording_of_whole_intervals_has_none_of_no_length(tmp_path: Path):
    put_subset(tmp_path, [entry(1, frame, 10.0 * frame, 1, 20.0) for frame in range(1, 5)], seconds=2.1)
    with connect(tmp_path) as connection:
        found = connection.sql("SELECT interval, interval_s FROM flow_density('a', 0.7)").fetchall()
    assert found == [(0, 0.7), (1, 0.7), (2, pytest.approx(0.7))]  # 2.1 / 0.7 is a little more than 3 in floating point


def test_a_recording_announced_shorter_than_it_is_has_no_endless_flow(tmp_path: Path):
    put_subset(tmp_path, FLOWING, seconds=4.0)  # ten frames at 2 Hz are 5 s
    with connect(tmp_path) as connection:
        found = connection.sql("SELECT DISTINCT interval, interval_s FROM flow_density('a', 2) ORDER BY 1").fetchall()
    assert found == [(0, 2.0), (1, 2.0), (2, 1.0)]
