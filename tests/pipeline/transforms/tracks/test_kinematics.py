"""Differences of positions against a slow loop over frames."""

import math

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.kinematics import add_kinematics, central_difference

DERIVED = ("speed_cd_mps", "accel_cd_mps2", "speed_10hz_mps", "accel_10hz_mps2")


def make_tracks(tracks):
    """{vehicle: {frame: x}} as a frame."""
    rows = [(vehicle, frame, x) for vehicle, track in sorted(tracks.items()) for frame, x in sorted(track.items())]
    return pl.DataFrame(rows, schema={"vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64}, orient="row")


def between(track, frame):
    """Position at a whole or half frame, linear between the two beside it; None unless both are there."""
    low, high = math.floor(frame), math.ceil(frame)
    if low not in track or high not in track:
        return None
    return track[low] + (track[high] - track[low]) * (frame - low)


def difference(track, frame, steps, rate):
    """(value `steps` later - value `steps` earlier) / their distance in time, over frames that are all there."""
    reach = math.ceil(steps)
    if any(frame + offset not in track for offset in (-reach, reach)):
        return None
    if any(number not in track for number in range(frame - reach, frame + reach + 1)):
        return None
    return (between(track, frame + steps) - between(track, frame - steps)) / (2 * steps / rate)


def slowly(track, rate):
    """frame -> the four columns, frame by frame."""
    speed = {frame: difference(track, frame, 1, rate) for frame in track}
    known = {frame: value for frame, value in speed.items() if value is not None}
    found = {}
    for frame in track:
        accel = difference(known, frame, 1, rate) if frame in known else None
        if rate == 10:
            found[frame] = (speed[frame], accel, speed[frame], accel)
            continue
        steps = rate / 10
        if steps < 1 or steps * 2 != round(steps * 2):
            found[frame] = (speed[frame], accel, None, None)
            continue
        # 0.2 s before and after lie on whole frames: speed(t + 0.1) - speed(t - 0.1) = x(t + 0.2) - 2 x(t) + x(t - 0.2)
        double = round(2 * steps)
        there = all(number in track for number in range(frame - double, frame + double + 1))
        second = (track[frame + double] - 2 * track[frame] + track[frame - double]) / 0.2**2 if there else None
        found[frame] = (speed[frame], accel, difference(track, frame, steps, rate), second)
    return found


def check(tracks, rate):
    frame = add_kinematics(make_tracks(tracks), rate)
    for vehicle, number, *values in frame.select("vehicle_id", "frame", *DERIVED).rows():
        expected = slowly(tracks[vehicle], rate)[number]
        for name, value, wanted in zip(DERIVED, values, expected, strict=True):
            assert (value is None) == (wanted is None), (vehicle, number, name)
            if wanted is not None:
                assert value == pytest.approx(wanted, abs=1e-6), (vehicle, number, name)
    return frame


def test_by_hand_at_10_hz():
    """x = 0, 1, 4, 9, 16 at 0.1 s: speeds 20, 40, 60 in the middle, one acceleration of (60 - 20) / 0.2."""
    frame = add_kinematics(make_tracks({1: {5: 0.0, 6: 1.0, 7: 4.0, 8: 9.0, 9: 16.0}}), 10.0)
    assert frame["speed_cd_mps"].to_list() == [None, *[pytest.approx(v) for v in (20, 40, 60)], None]
    assert frame["accel_cd_mps2"].to_list() == [None, None, pytest.approx(200), None, None]
    assert frame["speed_10hz_mps"].equals(frame["speed_cd_mps"])
    assert frame["accel_10hz_mps2"].equals(frame["accel_cd_mps2"])


def test_by_hand_at_25_hz():
    """x = frame squared: 2.5 frames away lie the means of 2 and 3 frames away."""
    frame = add_kinematics(make_tracks({1: {number: float(number**2) for number in range(11)}}), 25.0)
    by_frame = dict(zip(frame["frame"], frame.select(DERIVED).rows(), strict=True))
    # Frame 5: (36 - 16) / 0.08; ((49 + 64) / 2 - (4 + 9) / 2) / 0.2; (100 - 2 * 25 + 0) / 0.04
    assert by_frame[5] == pytest.approx((250, 1250, 250, 1250))
    assert by_frame[3][2] == pytest.approx(150)
    assert by_frame[2][2] is None
    assert by_frame[4][3] is None


def test_two_vehicles_and_gaps_never_touch():
    tracks = {
        1: {frame: 3.0 * frame for frame in range(1, 8)},
        2: {frame: 100.0 + frame**2 for frame in [*range(8, 14), *range(15, 30)]},
    }
    for rate in (10.0, 25.0, 30.0):
        check(tracks, rate)


@pytest.mark.parametrize("rate", [10.0, 25.0])
@pytest.mark.parametrize("tracks", [{}, {1: {1: 5.0}}, {1: {1: 5.0}, 2: {2: 6.0}, 3: {3: 7.0}}, {1: {1: 5.0, 2: 6.0}}])
def test_short_tracks_have_no_derivatives(tracks, rate):
    frame = add_kinematics(make_tracks(tracks), rate)
    assert all(frame[name].null_count() == frame.height for name in DERIVED)


@pytest.mark.parametrize("rate", [5.0, 12.0])
def test_rates_without_a_tenth_of_a_second_have_no_10_hz_columns(rate):
    frame = check({1: {number: float(number**2) for number in range(30)}}, rate)
    assert frame["speed_cd_mps"].null_count() == 2
    assert frame["speed_10hz_mps"].null_count() == 30


def test_frames_and_ids_at_the_limits_of_int32():
    top = 2**31 - 1
    check({0: dict.fromkeys(range(3), 1.0), top: {top - 3 + step: float(step) for step in range(4)}}, 10.0)


tracks_of_vehicles = st.dictionaries(
    st.integers(0, 4),
    st.dictionaries(st.integers(0, 25), st.integers(-1000, 1000).map(lambda v: v / 8), min_size=1, max_size=26),
    max_size=3,
)


@given(tracks=tracks_of_vehicles, gap=st.integers(0, 30), rate=st.sampled_from([10.0, 20.0, 25.0, 30.0]))
@settings(max_examples=40, deadline=None)
def test_against_a_slow_loop(tracks, gap, rate):
    whole = {number: number**2 / 16 for number in range(30) if number != gap}
    check({**tracks, 9: whole}, rate)


def test_any_column_can_be_differentiated():
    frame = make_tracks({1: {1: 0.0, 2: 1.0, 3: 5.0}}).with_columns(y_m=-pl.col("x_m"))
    assert frame.select(central_difference("y_m", 25.0)).to_series().to_list() == [None, pytest.approx(-62.5), None]
