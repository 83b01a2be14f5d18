"""The ego's state: heading by motion and at a standstill, gaps, records of two kinds, and only records of the past."""

import numpy as np
import polars as pl
import pymap3d
import pytest
from drive_scenes import ORIGIN, conform, drive

from tracklake.pipeline.transforms.onboard.ego import MAX_EGO_AGE_S, estimate_ego, pick_records
from tracklake.schemas import EGO_STATES


def make_states(rows):
    return conform(EGO_STATES, pl.DataFrame(rows))


def compute_error_m(ego, scene):
    east, north, _ = pymap3d.geodetic2enu(ego.lat_deg, ego.lon_deg, ego.height_m, *ORIGIN)
    return np.hypot(east - scene.east_m[0], north - scene.north_m[0])


def test_slow_error_of_the_heading_is_found_by_the_motion():
    errors = []
    for seed in range(5):
        scene = drive([0], [0], [30], seed=seed, heading_error_deg=1.0)
        _, states = scene.make_messages()
        ego = estimate_ego(states, scene.ticks)
        assert ego.known.all()
        errors.append(np.abs(np.degrees(ego.heading_rad - scene.heading_rad[0])))
    assert np.median([error[0] for error in errors]) > 0.8  # as logged
    assert np.median([error[100:].mean() for error in errors]) < 0.3


def test_without_any_heading_the_motion_tells_it():
    scene = drive([0], [0], [20], heading_deg=-100.0, random_m=0.1, gps_m=0.1)
    _, states = scene.make_messages(sent_heading=False)
    ego = estimate_ego(states, scene.ticks)
    assert not ego.known[0]  # before it has moved, nothing tells where it heads
    assert ego.known[5:].all()
    error = np.degrees(ego.heading_rad[50:]) + 100
    assert np.abs(np.mod(error + 180, 360) - 180).max() < 2


def test_heading_holds_at_a_standstill():
    speed = np.clip(10 - 0.2 * np.arange(200), 0, None)
    scene = drive([0], [0], [speed], seconds=20, heading_error_deg=0.0)
    _, states = scene.make_messages()
    wild = pl.when(pl.col("speed_mps") < 0.5).then(123.0).otherwise("heading_deg").cast(pl.Float32)
    ego = estimate_ego(states.with_columns(heading_deg=wild), scene.ticks)
    assert np.abs(np.degrees(ego.heading_rad) - 30).max() < 3
    assert np.ptp(ego.odometry_m[120:], axis=0).max() < 2.0


def test_gap_is_bridged_for_a_bounded_time():
    scene = drive([0], [0], [20], seconds=10, gps_m=0.0, random_m=0.0)
    _, states = scene.make_messages()
    gap = states.filter(~pl.col("time_s").is_between(2.05, 5.95))
    ego = estimate_ego(gap, scene.ticks)
    last = 20 + round(MAX_EGO_AGE_S * 10)
    assert ego.known[: last + 1].all()
    assert not ego.known[last + 1 : 60].any()
    assert ego.known[60:].all()
    assert ego.start[last] == 1
    assert ego.start[60] == 2
    assert compute_error_m(ego, scene)[last] < 1.0


def test_only_records_of_the_past_count():
    scene = drive([0], [0], [20], seconds=6)
    _, states = scene.make_messages()
    whole, part = estimate_ego(states, 60), estimate_ego(states.filter(pl.col("time_s") < 3.05), 31)
    np.testing.assert_array_equal(whole.heading_rad[:31], part.heading_rad)
    np.testing.assert_array_equal(whole.ecef_m[:31], part.ecef_m)


def test_order_of_rows_does_not_matter():
    scene = drive([0], [0], [20], seconds=3)
    _, states = scene.make_messages()
    one, other = estimate_ego(states, 30), estimate_ego(states.sample(fraction=1.0, shuffle=True, seed=3), 30)
    np.testing.assert_array_equal(one.ecef_m, other.ecef_m)


def test_two_kinds_of_records_are_joined():
    """A tick takes the later record; what it lacks comes from the other one."""
    rows = make_states(
        {
            "time_s": [0.0, 0.12, 0.18, 0.31],
            "source": ["bsm", "bsm", "gnss", "gnss"],
            "lat_deg": [42.0, 42.1, 42.2, 42.3],
            "lon_deg": 1.0,
            "speed_mps": [10.0, 11.0, None, None],
            "heading_deg": [None, 90.0, 91.0, None],
        }
    )
    picked = pick_records(rows, 4)
    assert picked["tick"].to_list() == [0, 2]  # 0.31 s is due at tick 4, which the drive does not have
    assert picked["lat_deg"].to_list() == [42.0, 42.2]
    assert picked["speed_mps"].to_list() == [10.0, 11.0]
    assert picked["heading_deg"].to_list() == [None, 91.0]
    assert picked["age_s"].to_list() == pytest.approx([0.0, 0.02])


def test_north_is_north_after_a_hundred_kilometres():
    """Along a parallel, the heading stays 90 degrees from the north of the place, not from that of the start."""
    lon = np.arange(400) * 0.003 / 1.0
    rows = make_states(
        {"time_s": np.arange(400) / 10, "source": "gnss", "lat_deg": 60.0, "lon_deg": lon, "speed_mps": 1671.0}
    )
    ego = estimate_ego(rows, 400)
    assert abs(np.degrees(ego.heading_rad[-1]) - 90) < 0.1


def test_no_record_and_one_record():
    none = estimate_ego(
        make_states({"time_s": [0.0], "source": ["bsm"], "lat_deg": [1.0], "lon_deg": [1.0]}).clear(), 3
    )
    assert not none.known.any()
    one = make_states({"time_s": [0.0], "source": ["bsm"], "lat_deg": [1.0], "lon_deg": [1.0], "heading_deg": [0.0]})
    ego = estimate_ego(one, 1)
    assert ego.known.tolist() == [True]
    assert ego.lat_deg[0] == pytest.approx(1.0, abs=1e-9)
