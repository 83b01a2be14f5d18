"""The table macros over a messy subset find what slow, obvious loops find."""

import numpy as np
import pytest
from macro_lake import entry, put_subset

from tracklake.pipeline.lake import connect
from tracklake.pipeline.lake.query import LakeConnection


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
