"""The table macros: numbers derived by hand, a slow loop over a messy subset, and how they may be called."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import duckdb
import numpy as np
import polars as pl
import pytest
from small_lake import put

from pipeline.lake import QueryError, connect, open_for_writing
from pipeline.lake.macros import MACROS
from pipeline.lake.sandbox import LakeConnection
from schemas import SUBSETS, TRACKS, VEHICLES, Table

CALLS = {
    "flow_density": "{subset}, 2",
    "lane_changes": "{subset}",
    "leader_follower": "{subset}",
    "near": "{subset}, 3, 50, 2, 60",
    "scene": "{subset}, 3",
    "track": "{subset}, 1",
}
EMPTY = {"leader_id": None, "follower_id": None, "gap_m": None, "headway_recorded_m": None}
CLASSES = {1: "car", 2: "truck", 3: "car", 4: "motorcycle"}
LENGTHS = {1: 4.0, 2: 12.0, 3: 5.0, 4: 2.0}


def call(name: str, subset: str = "'a'") -> str:
    return f"{name}({CALLS[name].format(subset=subset)})"


def entry(vehicle: int, frame: int, x: float, lane: int | None, speed: float, **more: object) -> dict[str, object]:
    """At 2 Hz, frames counted from 1."""
    named = {"vehicle_id": vehicle, "frame": frame, "time_s": (frame - 1) / 2, "x_m": x, "lane": lane}
    return {**named, "y_m": 2.0, "speed_mps": speed, **EMPTY, **more}


def put_subset(
    root: Path, entries: list[dict[str, object]], subset: str = "a", dataset: str = "highd", seconds: float = 5.0
) -> None:
    """One subset of 2 Hz with its entries, its vehicles and itself."""
    values = {"dataset": dataset, "subset": subset}

    def fill(table: Table, rows: list[dict[str, object]]) -> pl.DataFrame:
        given = [{name: row.get(name) for name in table.dtypes} | values for row in rows]
        return pl.DataFrame(given, schema=table.dtypes)

    tracks = fill(TRACKS, entries).sort("vehicle_id", "frame")
    vehicles = [
        {
            "vehicle_id": vehicle, "source_vehicle_id": vehicle, "class": CLASSES.get(vehicle, "car"),
            "length_m": LENGTHS.get(vehicle, 4.0), "width_m": 2.0, "first_frame": own["frame"].min(),
            "last_frame": own["frame"].max(), "entries": own.height, "start_x_m": own["x_m"][0],
            "end_x_m": own["x_m"][-1], "start_lane": own["lane"][0], "mean_speed_mps": own["speed_mps"].mean(),
        }
        for (vehicle,), own in tracks.group_by("vehicle_id", maintain_order=True)
    ]  # fmt: skip
    facts = {
        "recording": subset, "site": "1", "direction": "upper", "freeway": True, "frame_rate_hz": 2.0, "lanes": 2,
        "seconds": seconds, "first_frame": 1, "last_frame": tracks["frame"].max(), "vehicles": len(vehicles),
        "entries": tracks.height, "ids_split": 0, "on_ramp_lanes": [], "columns_missing": [],
        "source_files": [{"file": "a.csv", "sha256": "00"}],
    }  # fmt: skip
    with open_for_writing(root) as writer:
        for table, frame in ((TRACKS, tracks), (VEHICLES, fill(VEHICLES, vehicles)), (SUBSETS, fill(SUBSETS, [facts]))):
            writer.commit(put(root, f"{table.name}/{dataset}/{subset}", 1, frame, table, **values))


PAIRS = [
    # A truck ahead of a faster car, which closes in, is as fast at frame 2, and overlaps it at frame 3.
    entry(2, 1, 62.0, 1, 10.0),
    entry(1, 1, 20.0, 1, 20.0, leader_id=2, gap_m=30.0),
    entry(2, 2, 67.0, 1, 10.0),
    entry(1, 2, 30.0, 1, 10.0, leader_id=2, gap_m=25.0),
    entry(2, 3, 72.0, 1, 10.0),
    entry(1, 3, 61.0, 1, 20.0, leader_id=2, gap_m=-1.0),
    # Its leader has no entry at this frame.
    entry(1, 4, 71.0, 1, 20.0, leader_id=2, gap_m=5.0),
    # Stands, then rolls back, behind the car.
    entry(3, 1, 10.0, 1, 0.0, leader_id=1, gap_m=6.0),
    entry(3, 2, 9.0, 1, -2.0, leader_id=1, gap_m=17.0),
]


CHANGES = [entry(4, 6, 100.0, 1, 9.0), entry(4, 7, 104.5, 2, 9.0)]


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
            with pytest.raises(duckdb.Error, match="seconds must be above 0"):
                connection.sql(f"FROM flow_density('a', {wrong})").fetchall()


@pytest.mark.parametrize("seconds", [0.28, 0.7, 0.1])
def test_intervals_hold_the_frames_they_should(tmp_path: Path, seconds: float):
    """25 Hz and 0.28 s: seven frames; in floating point, 0.28 * 25 is a little more."""
    rate, frames = 100, 300
    entries = [entry(1, frame, frame / 10, 1, 10.0) for frame in range(1, frames + 1)]
    put_subset(tmp_path, [{**row, "time_s": (row["frame"] - 1) / rate} for row in entries], seconds=frames / rate)
    per_interval = round(seconds * rate)
    whole, rest = divmod(frames, per_interval)
    with connect(tmp_path) as connection:
        # The subset says 2 Hz: the rate in its row is what counts, so ask in its own seconds.
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


# ------------------------------------------------------------------------------------------- a messy subset


@pytest.fixture(scope="module")
def messy(tmp_path_factory: pytest.TempPathFactory) -> tuple[LakeConnection, list[dict[str, object]]]:
    """Thirty vehicles with gaps, missing lanes, leaders that are not there, standing and rolling back."""
    random = np.random.default_rng(5)
    entries = []
    for vehicle in (*range(1, 30), 2**31 - 1):
        for frame in range(int(random.integers(1, 30)), int(random.integers(30, 60))):
            if random.random() < 0.1:
                continue
            lane = None if random.random() < 0.1 else int(random.integers(1, 4))
            speed = float(random.choice([-1.5, 0.0, 0.25, 8.5, 20.0, 31.75]))
            leader = None if random.random() < 0.3 else int(random.integers(1, 40))
            gap = None if leader is None else float(round(random.uniform(-5, 60), 3))
            x, y = round(random.uniform(0, 400), 3), round(random.uniform(0, 12), 3)
            entries.append(entry(vehicle, frame, x, lane, speed, y_m=y, leader_id=leader, gap_m=gap))
    root = tmp_path_factory.mktemp("messy")
    put_subset(root, entries, seconds=31.7)
    return connect(root), entries


def close_to(row: tuple[float | None, ...]) -> tuple[object, ...]:
    return tuple(value if value is None else pytest.approx(value, rel=1e-9, abs=1e-9) for value in row)


def test_leader_follower_finds_what_a_loop_finds(messy):
    connection, entries = messy
    at = {(row["vehicle_id"], row["frame"]): row for row in entries}
    expected = []
    for row in sorted(entries, key=lambda row: (row["vehicle_id"], row["frame"])):
        ahead = at.get((row["leader_id"], row["frame"]))
        if ahead is None:
            continue
        spacing, closing = ahead["x_m"] - row["x_m"], row["speed_mps"] - ahead["speed_mps"]
        headway = spacing / row["speed_mps"] if row["speed_mps"] > 0 else None
        ttc = row["gap_m"] / closing if closing > 0 and row["gap_m"] >= 0 else None
        expected.append((row["vehicle_id"], row["leader_id"], row["frame"], round(spacing, 3), headway, closing, ttc))
    asked = "SELECT follower_id, leader_id, frame, spacing_m, time_headway_s, closing_mps, ttc_s"
    found = connection.sql(f"{asked} FROM leader_follower('a')").fetchall()
    assert len(expected) > 200
    assert len([row for row in expected if row[-1] is not None]) > 50
    assert found == [close_to(row) for row in expected]


def test_lane_changes_finds_what_a_loop_finds(messy):
    connection, entries = messy
    at = {(row["vehicle_id"], row["frame"]): row["lane"] for row in entries}
    expected = [
        (vehicle, frame, at[vehicle, frame - 1], lane, "right" if lane > at[vehicle, frame - 1] else "left")
        for (vehicle, frame), lane in sorted(at.items(), key=lambda item: item[0])
        if lane is not None and at.get((vehicle, frame - 1)) not in (None, lane)
    ]
    asked = "SELECT vehicle_id, frame, from_lane, to_lane, direction FROM lane_changes('a')"
    assert len(expected) > 300
    assert connection.sql(asked).fetchall() == expected


def test_flow_density_finds_what_a_loop_finds(messy):
    connection, entries = messy
    xs = [row["x_m"] for row in entries]
    section, rate, end, length = max(xs) - min(xs), 2.0, 31.7, 3.0
    expected = []
    for lane in (1, 2, 3, None):
        for interval in range(11):  # 10 of 3 s and one of 1.7 s
            duration = length if interval < 10 else end - 30.0
            # six frames an interval
            own = [row for row in entries if row["lane"] == lane and (row["frame"] - 1) // 6 == interval]
            metres, seconds = sum(row["speed_mps"] for row in own) / rate, len(own) / rate
            area = section * duration
            flow, density = metres / area * 3600, seconds / area * 1000
            expected.append((lane, interval, len(own), flow, density, metres / seconds if own else None))
    asked = "SELECT lane, interval, entries, flow_veh_per_h, density_veh_per_km, speed_mps FROM flow_density('a', 3)"
    assert sum(row[2] for row in expected) == len(entries)
    assert connection.sql(asked).fetchall() == [close_to(row) for row in expected]


def test_near_and_scene_find_what_a_loop_finds(messy):
    connection, entries = messy
    for frame in (1, 29, 40):
        here = [row for row in entries if row["frame"] == frame]
        found = connection.sql(f"SELECT vehicle_id FROM scene('a', {frame})").fetchall()
        assert sorted(vehicle for (vehicle,) in found) == sorted(row["vehicle_id"] for row in here)
        far = {row["vehicle_id"]: ((row["x_m"] - 200) ** 2 + (row["y_m"] - 6) ** 2) ** 0.5 for row in here}
        expected = sorted((metres, vehicle) for vehicle, metres in far.items() if metres <= 120)
        found = connection.sql(f"SELECT distance_m, vehicle_id FROM near('a', {frame}, 200, 6, 120)").fetchall()
        assert found == [close_to(row) for row in expected]


# ------------------------------------------------------------------------------------------- how they are called


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three subsets, one of which stands in both data sets."""
    root = tmp_path_factory.mktemp("several")
    for dataset, subset in (("highd", "a"), ("highd", "b"), ("ngsim", "b"), ("ngsim", "c")):
        put_subset(root, PAIRS[: {"a": 9, "b": 7, "c": 4}[subset]], subset=subset, dataset=dataset)
    return root


@pytest.mark.parametrize("name", CALLS)
def test_a_macro_reads_its_subset_and_no_other(several: Path, tmp_path: Path, name: str):
    root = tmp_path / "lake"
    shutil.copytree(several, root)
    for file in root.glob("*/*/subset=[bc]/*.parquet"):
        file.write_bytes(b"x" * file.stat().st_size)
    with connect(several) as whole, connect(root) as connection:
        expected = whole.sql(f"FROM {call(name)}").fetchall()
        assert connection.sql(f"FROM {call(name)}").fetchall() == expected
        for subset, parameters in (("'a'", None), ("$asked", {"asked": "a"})):
            explained = f"EXPLAIN (ANALYZE, FORMAT json) FROM {call(name, subset)}"
            plan = whole.sql(explained, parameters).fetchall()[0][1]
            # Of four, or of one where the others were left out even earlier; for every reading there is.
            counts = re.findall(r'"Scanning Files": "(\d+)/[14]"', plan)
            assert counts == ["1"] * plan.count('"Function": "READ_PARQUET"')
        with pytest.raises(duckdb.Error):
            connection.sql("SELECT sum(x_m) FROM tracks").fetchall()


@pytest.mark.parametrize("name", CALLS)
def test_a_subset_of_two_data_sets_gives_both_apart(tmp_path: Path, name: str):
    here = {"highd": PAIRS + CHANGES, "ngsim": [{**row, "x_m": row["x_m"] + 10.0} for row in PAIRS[:7] + CHANGES]}
    expected = []
    for dataset, entries in here.items():
        put_subset(tmp_path / dataset, entries, dataset=dataset)
        put_subset(tmp_path / "both", entries, dataset=dataset)
        with connect(tmp_path / dataset) as connection:
            expected += connection.sql(f"FROM {call(name)}").fetchall()
    with connect(tmp_path / "both") as connection:
        assert connection.sql(f"FROM {call(name)}").fetchall() == expected
    assert {row[0] for row in expected} == set(here)


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("alias", ["subsets", "entry", "asked", "tracks", "recording", "follower", "vehicle"])
def test_arguments_may_be_columns_whatever_their_table_is_called(several: Path, name: str, alias: str):
    """Never taken for a column of the macro's own tables, which would give every subset's rows for each."""
    with connect(several) as connection:
        expected = {
            subset: connection.sql(f"SELECT count(*) FROM {call(name, repr(subset))}").fetchall()[0][0]
            for subset in ("a", "c")
        }
        for argument in (f'"{alias}".subset', "subset"):
            found = connection.sql(
                f'SELECT asked_for, count(*) FROM (SELECT subset, subset AS asked_for FROM subsets) AS "{alias}",'
                f" {call(name, argument)} AS given WHERE asked_for <> 'b' GROUP BY ALL"
            ).fetchall()
            assert dict(found) == {subset: rows for subset, rows in expected.items() if rows}


def test_macros_take_named_arguments_and_parameters(several: Path):
    with connect(several) as connection:
        expected = connection.sql("FROM track('a', 1)").fetchall()
        assert connection.sql("FROM track(vehicle := 1, subset := 'a')").fetchall() == expected
        assert connection.sql("FROM track($subset, $id)", {"subset": "a", "id": 1}).fetchall() == expected
        assert connection.sql("FROM track((SELECT min(subset) FROM subsets), 1)").fetchall() == expected
        with pytest.raises(QueryError, match=r"track\(subset, vehicle\)"):
            connection.sql("FROM track('a')")
        for statement in ("CREATE OR REPLACE MACRO track(a) AS TABLE SELECT 1", "DROP MACRO TABLE track"):
            with pytest.raises(QueryError, match="read-only"):
                connection.sql(statement)


@pytest.mark.parametrize("name", CALLS)
def test_a_querys_own_tables_do_not_take_the_lakes_place(several: Path, name: str):
    names = ("tracks", "vehicles", "subsets", "asked", "entry", "recording", "counted", "cells", "lanes", "section")
    own = ", ".join(f"{name} AS (SELECT 1 AS one)" for name in names)
    with connect(several) as connection:
        expected = connection.sql(f"FROM {call(name)}").fetchall()
        assert connection.sql(f"WITH {own} FROM {call(name)}").fetchall() == expected


@pytest.mark.parametrize("name", CALLS)
def test_the_catalog_carries_the_macros_also_after_a_move(several: Path, tmp_path: Path, monkeypatch, name: str):
    shutil.copytree(several, tmp_path / "moved")
    with connect(several) as connection:
        expected = connection.sql(f"FROM {call(name)}").fetchall()
    monkeypatch.chdir(tmp_path / "moved")
    with duckdb.connect("catalog.duckdb", read_only=True) as plain:
        assert plain.sql(f"FROM {call(name)}").fetchall() == expected


@pytest.mark.parametrize("macro", MACROS, ids=lambda macro: macro.name)
def test_a_macro_says_what_it_gives(several: Path, macro):
    """Its file's header: meaning, parameters with theirs, and all columns in order."""
    header = [line.removeprefix("--").strip() for line in macro.statement.splitlines() if line.startswith("--")]
    paragraphs = [part.split("\n") for part in "\n".join(header).split("\n\n")]
    assert paragraphs[0][0] == macro.meaning
    assert tuple(line.split(":")[0] for line in paragraphs[-2]) == macro.parameters
    with connect(several) as connection:
        columns = connection.sql(f"FROM {call(macro.name)}").columns
        listed = connection.sql(
            f"SELECT parameters, comment FROM duckdb_functions() WHERE function_name = '{macro.name}' AND NOT internal"
        )
        assert listed.fetchall() == [(list(macro.parameters), macro.meaning)]
    if macro.name == "track":
        assert columns == list(TRACKS.dtypes)
    else:
        named = [name for line in paragraphs[-1] for name in line.split(":")[0].split(", ")]
        assert columns == named
