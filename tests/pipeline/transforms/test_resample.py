"""Entries on the clock: by frame and never by row, gaps never bridged."""

from fractions import Fraction

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from tracklake.pipeline.transforms.resample import CLOCK_DTYPES, cut_runs, find_stride, put_on_clock
from tracklake.schemas.arrays import bound_runs
from tracklake.schemas.errors import TracklakeError

INT32_MAX = 2**31 - 1


def make_tracks(entries, dtype=pl.Float64):
    """(vehicle_id, frame, x_m, lane) rows; y_m = 10 x_m and speed_mps = x_m / 2."""
    rows = [(vehicle, frame, x, 10 * x, lane, x / 2) for vehicle, frame, x, lane in entries]
    schema = {
        "vehicle_id": pl.Int32,
        "frame": pl.Int32,
        "x_m": dtype,
        "y_m": pl.Float64,
        "lane": pl.Int16,
        "speed_mps": pl.Float32,
    }
    return pl.DataFrame(rows, schema=schema, orient="row")


def clock_rows(clock, *names):
    return clock.select(names).rows()


def test_every_fifth_frame_from_25_to_5_hz():
    tracks = make_tracks([(7, frame, float(frame), 2) for frame in range(3, 18)])
    clock = put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=5)
    assert dict(clock.schema) == CLOCK_DTYPES
    assert clock_rows(clock, "tick", "frame", "x_m", "y_m", "lane", "speed_mps") == [
        (1, 6, 6.0, 60.0, 2, 3.0),
        (2, 11, 11.0, 110.0, 2, 5.5),
        (3, 16, 16.0, 160.0, 2, 8.0),
    ]
    assert clock["segment"].n_unique() == 1


def test_ten_hertz_is_linear_between_the_two_frames_around_the_tick():
    """Tick k lies at frame 1 + 2.5 k: 1, 3.5, 6, 8.5, 11."""
    x = {1: 0.0, 2: 1.0, 3: 2.0, 4: 5.0, 5: 5.0, 6: 6.0, 7: 7.0, 8: 8.0, 9: 10.0, 10: 10.0}
    lane = {frame: 1 if frame <= 3 else 2 for frame in x}
    tracks = make_tracks([(7, frame, x[frame], lane[frame]) for frame in x])
    clock = put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=10)
    assert clock_rows(clock, "tick", "frame", "x_m", "y_m", "lane", "speed_mps") == [
        (0, 1, 0.0, 0.0, 1, 0.0),
        (1, None, 3.5, 35.0, 1, 1.75),  # lane of the earlier frame
        (2, 6, 6.0, 60.0, 2, 3.0),
        (3, None, 9.0, 90.0, 2, 4.5),
    ]


def test_same_rate_keeps_every_entry():
    tracks = make_tracks([(7, frame, float(frame), 2) for frame in range(63, 80)])
    clock = put_on_clock(tracks, first_frame=12, frame_rate_hz=10.0, rate_hz=10)
    assert clock["tick"].to_list() == list(range(51, 68))
    assert clock["frame"].to_list() == tracks["frame"].to_list()


def test_gap_is_not_bridged_and_begins_a_segment():
    """Frame 4 is missing, so tick 1 (frame 3.5) is; frame 9 is missing, so tick 3 (frame 8.5) is."""
    frames = [1, 2, 3, 5, 6, 7, 8, 10, 11]
    tracks = make_tracks([(7, frame, float(frame), 2) for frame in frames])
    clock = put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=10)
    assert clock["tick"].to_list() == [0, 2, 4]
    assert clock["segment"].n_unique() == 3


def test_a_skipped_frame_off_the_clock_still_begins_a_segment():
    tracks = make_tracks([(7, frame, float(frame), 2) for frame in (0, 1, 2, 4, 5, 6)])
    clock = put_on_clock(tracks, first_frame=0, frame_rate_hz=10.0, rate_hz=5)
    assert clock["tick"].to_list() == [0, 1, 2, 3]
    assert clock["segment"].diff().to_list()[1:] == [0, 1, 0]


def test_vehicles_are_not_joined():
    """Vehicle 1 ends on frame 3 and vehicle 2 has frame 4: nothing lies between them."""
    tracks = make_tracks([(1, 3, 1.0, 1), (2, 4, 9.0, 1)])
    assert put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=10).is_empty()
    both = make_tracks([(1, 1, 1.0, 1), (2, 2, 9.0, 1)])
    clock = put_on_clock(both, first_frame=1, frame_rate_hz=10.0, rate_hz=10)
    assert clock["segment"].n_unique() == 2


def test_lanes_that_the_source_lacks_stay_null():
    tracks = make_tracks([(1, frame, 1.0, None) for frame in range(1, 7)])
    for rate_hz in (5, 10):
        assert put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=rate_hz)["lane"].is_null().all()


def test_no_tracks():
    clock = put_on_clock(make_tracks([]), first_frame=1, frame_rate_hz=25.0, rate_hz=10)
    assert clock.is_empty()
    assert dict(clock.schema) == CLOCK_DTYPES
    first, last = bound_runs(clock["segment"].to_numpy())
    assert first.size == last.size == 0


def test_clock_faster_than_the_source_is_refused():
    with pytest.raises(TracklakeError, match=r"10 Hz tracks on a 25 Hz clock.*at most 10 Hz"):
        put_on_clock(make_tracks([]), first_frame=1, frame_rate_hz=10.0, rate_hz=25)


def test_stride_is_exact():
    assert find_stride(frame_rate_hz=25.0, rate_hz=10) == Fraction(5, 2)
    assert find_stride(frame_rate_hz=30000 / 1001, rate_hz=10) == Fraction(3000, 1001)


def test_segment_bounds():
    clock = pl.DataFrame({"segment": [1, 1, 1, 2, 4, 4]})
    first, last = bound_runs(clock["segment"].to_numpy())
    assert first.tolist() == [0, 0, 0, 3, 4, 4]
    assert last.tolist() == [2, 2, 2, 3, 5, 5]


@st.composite
def gappy_tracks(draw):
    first_frame = draw(st.sampled_from([0, 1, 12]))
    ids = draw(st.lists(st.sampled_from([0, 1, 2, 900, INT32_MAX]), min_size=1, max_size=3, unique=True))
    entries = []
    for vehicle in sorted(ids):
        offsets = draw(st.lists(st.integers(0, 40), max_size=30, unique=True))
        entries += [(vehicle, first_frame + o, draw(st.integers(-50, 500)) / 4, o % 3) for o in sorted(offsets)]
    return first_frame, entries


@settings(max_examples=20, deadline=None)
@given(gappy_tracks(), st.sampled_from([(25.0, 10), (25.0, 5), (10.0, 10), (10.0, 5), (10.0, 4), (25.0, 8)]))
def test_agrees_with_a_loop_over_ticks(recording, rates):
    first_frame, entries = recording
    frame_rate_hz, rate_hz = rates
    at = {(vehicle, frame): (x, lane) for vehicle, frame, x, lane in entries}
    expected = []
    for vehicle in sorted({vehicle for vehicle, _ in at}):
        for tick in range(50):
            frame = first_frame + Fraction(tick) * Fraction(frame_rate_hz) / rate_hz
            earlier, later = int(frame), int(frame) + 1
            if frame == earlier and (vehicle, earlier) in at:
                x, lane = at[vehicle, earlier]
                expected.append((vehicle, tick, earlier, x, lane))
            elif frame != earlier and (vehicle, earlier) in at and (vehicle, later) in at:
                (x, lane), (x_later, _) = at[vehicle, earlier], at[vehicle, later]
                expected.append((vehicle, tick, None, float(x + (frame - earlier) * Fraction(x_later - x)), lane))
    clock = put_on_clock(make_tracks(entries), first_frame=first_frame, frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    schema = {name: CLOCK_DTYPES[name] for name in ("vehicle_id", "tick", "frame", "x_m", "lane")}
    assert_frame_equal(clock.select(*schema), pl.DataFrame(expected, schema=schema, orient="row"))
    for (_segment,), run in clock.group_by("segment"):
        assert run["vehicle_id"].n_unique() == 1
        assert (np.diff(run["tick"]) == 1).all()


def test_columns_that_are_left_out_are_left_out():
    tracks = make_tracks([(7, frame, float(frame), 2) for frame in range(1, 12)])
    full = put_on_clock(tracks, first_frame=1, frame_rate_hz=25.0, rate_hz=10)
    part = put_on_clock(tracks.drop("speed_mps", "lane"), first_frame=1, frame_rate_hz=25.0, rate_hz=10)
    assert_frame_equal(part, full.drop("speed_mps", "lane"))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 6), max_size=12), st.integers(1, 9))
def test_runs_are_cut_whole_and_in_order(lengths, rows):
    values = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
    pieces = cut_runs(values, rows)
    assert [row for start, end in pieces for row in range(start, end)] == list(range(values.size))
    for start, end in pieces:
        assert end > start
        assert start == 0 or values[start] != values[start - 1]
        # A piece ends with the run that begins in its last place or before.
        assert end - start < rows + max(lengths) or len(set(values[start:end])) == 1
