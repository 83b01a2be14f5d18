import numpy as np
import polars as pl
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from overhead_tracks import make_tracks, make_vehicles

from tracklake.pipeline.synthetic.onboard.earth import Road, locate
from tracklake.pipeline.synthetic.onboard.motion import compute_motion, find_headings
from tracklake.schemas.errors import UsageError


def test_fronts_become_centres_at_10_hz():
    tracks = make_tracks({1: (100.0, 5.0, 20.0), 2: (140.0, 1.0, 25.0)})
    vehicles = make_vehicles({1: ("car", 4.0, 1.8), 2: ("truck", 10.0, 2.5)})
    motion = compute_motion(tracks.sample(fraction=1.0, shuffle=True, seed=1), vehicles, 1, "01-lower")
    assert motion.time_s[[0, 1, -1]] == pytest.approx([0, 0.1, 6.0])
    # Tick 1 lies between frames 3 and 4: the front at 102 m, half a length ahead of the centre.
    assert motion.x_m[1] == pytest.approx([100.0, 137.5])
    assert motion.y_m[1] == pytest.approx([5.0, 1.0])
    assert motion.size_m[1] == pytest.approx([10.0, 2.5, 3.5])
    ahead_m, aside_m, turn_rad = motion.place_relative()
    assert (ahead_m[0, 1], aside_m[0, 1], turn_rad[0, 1]) == pytest.approx((37.0, -4.0, 0.0))
    assert motion.steering_deg == pytest.approx(0)


def test_headings_follow_motion_and_hold_at_a_stop():
    slope = np.tan(np.radians(10))
    x_m = np.concatenate((np.arange(20) * 1.0, np.full(20, 19.0)))[:, None]
    headings = find_headings(x_m, x_m * slope)
    assert np.degrees(headings) == pytest.approx(10)
    assert find_headings(np.full((5, 1), 3.0), np.zeros((5, 1))) == pytest.approx(0)
    backwards = np.concatenate((np.arange(20.0), np.arange(19.0, -1, -1)))[:, None]
    assert find_headings(backwards, 0 * backwards) == pytest.approx(0)


def test_a_curve_turns_the_steering_wheel():
    """On a circle of 200 m at 20 m/s the yaw rate is 0.1 rad/s: atan(2.4 m * 0.1 / 20) * 16 = 11 degrees."""
    tracks = make_tracks({1: (0.0, 0.0, 20.0)}, rate_hz=10.0)
    angle = pl.col("time_s") * 0.1
    curved = tracks.with_columns(x_m=200 * angle.sin(), y_m=200 * (1 - angle.cos()))
    motion = compute_motion(curved, make_vehicles({1: ("car", 4.0, 1.8)}), 1, "01-lower")
    middle = slice(15, -15)
    assert motion.yaw_rate_radps[middle] == pytest.approx(0.1, abs=1e-3)
    assert motion.steering_deg[middle] == pytest.approx(np.degrees(np.arctan(0.012)) * 16, rel=0.01)


@settings(max_examples=25)
@given(st.sets(st.integers(1, 150), max_size=60), st.sampled_from([10.0, 25.0, 30.0]), st.integers(0, 40))
def test_gaps_are_never_bridged(missing, rate_hz, late):
    """Against a loop over ticks that looks for the frames around each."""
    tracks = make_tracks({1: (0.0, 0.0, 20.0), 7: (30.0, 3.0, 21.0)}, rate_hz=rate_hz)
    kept = tracks.filter(~((pl.col("vehicle_id") == 7) & pl.col("frame").is_in(list(missing))))
    kept = kept.filter((pl.col("vehicle_id") == 1) | (pl.col("frame") > late))
    motion = compute_motion(kept, make_vehicles({1: (None, None, None), 7: ("car", 4.0, 2.0)}), 1, "01-lower")
    there = dict(kept.filter(pl.col("vehicle_id") == 7).select("frame", "x_m").iter_rows())
    for tick, time_s in enumerate(motion.time_s):
        place = 1 + time_s * rate_hz
        low, high = int(np.floor(place + 1e-6)), int(np.ceil(place - 1e-6))
        found = motion.x_m[tick, list(motion.vehicle_id).index(7)] if 7 in motion.vehicle_id else np.nan
        if low in there and high in there:
            front = there[low] + (place - low) * (there[high] - there[low])
            assert found == pytest.approx(front - 2.0, abs=1e-4)
        else:
            assert np.isnan(found)
    assert motion.usual_sizes == 1
    assert motion.size_m[0] == pytest.approx([4.5, 1.8, 1.5])


def test_the_ego_drives_its_longest_run_without_a_gap():
    tracks = make_tracks({1: (0.0, 0.0, 20.0)}, seconds=10).filter(pl.col("frame") != 60)
    motion = compute_motion(tracks, make_vehicles({1: ("car", 4.0, 1.8)}), 1, "01-lower")
    assert (motion.time_s[0], motion.time_s[-1]) == pytest.approx((2.4, 10.0))
    with pytest.raises(UsageError, match=r"recorded for 2\.3 s without a gap; a drive takes at least 4 s"):
        compute_motion(tracks.filter(pl.col("frame") < 60), make_vehicles({1: ("car", 4.0, 1.8)}), 1, "01-lower")
    with pytest.raises(UsageError, match=r"01-lower has no vehicle 11: did you mean 1\?"):
        compute_motion(tracks, make_vehicles({}), 11, "01-lower")


@settings(max_examples=20)
@given(st.floats(-80, 80), st.floats(-179, 179), st.floats(0, 359.9), st.floats(-2000, 2000), st.floats(-500, 500))
def test_places_on_the_earth_agree_with_pymap3d(lat_deg, lon_deg, bearing_deg, x_m, y_m):
    road = Road(lat_deg, lon_deg, 110.0, bearing_deg)
    found = locate(road, np.array([x_m]), np.array([y_m]))
    bearing = np.radians(bearing_deg)
    east, north = x_m * np.sin(bearing) + y_m * np.cos(bearing), x_m * np.cos(bearing) - y_m * np.sin(bearing)
    lat, lon, height_m = pymap3d.enu2geodetic(east, north, 0.0, lat_deg, lon_deg, 110.0)
    assert found["lat_deg"][0] == pytest.approx(lat, abs=1e-10)
    assert (found["lon_deg"][0] - lon + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)
    assert found["elevation_m"][0] == pytest.approx(height_m, abs=1e-4)
