"""Would-be neighbors of vehicles whose tracks begin late."""

import polars as pl

from tracklake.pipeline.transforms.starts.late_starts import find_would_be_neighbors
from tracklake.schemas.missing_starts import MISSING_STARTS


def make_missing(rows):
    """(vehicle_id, lane, cutoff_m, start_x_m, start_frame, first_missing_frame) rows."""
    names = ("vehicle_id", "lane", "cutoff_m", "start_x_m", "start_frame", "first_missing_frame")
    schema = {name: MISSING_STARTS.dtypes[name] for name in names}
    return pl.DataFrame(rows, schema=schema, orient="row")


def make_clock(rows):
    """(tick, x_m, lane) rows."""
    return pl.DataFrame(rows, schema={"tick": pl.Int32, "x_m": pl.Float64, "lane": pl.Int16}, orient="row")


def near(clock_rows, missing_rows, *, first_frame=0, frame_rate_hz=10.0, rate_hz=10):
    return find_would_be_neighbors(
        make_clock(clock_rows),
        make_missing(missing_rows),
        first_frame=first_frame,
        frame_rate_hz=frame_rate_hz,
        rate_hz=rate_hz,
    ).tolist()


def test_would_be_position_runs_from_the_cutoff_to_the_first_position():
    """From 14 m on frame 100 to 34 m on frame 110: 24 m on frame 105, and 40 m either side of it."""
    missing = [(9, 2, 14.0, 34.0, 110, 100)]
    clock = [(105, 64.0, 2), (105, 64.001, 2), (105, -16.0, 2), (105, -16.001, 2)]
    assert near(clock, missing) == [True, False, True, False]
    assert near([(100, 54.0, 2), (100, 54.001, 2)], missing) == [True, False]
    assert near([(109, 72.0, 2), (109, 72.001, 2)], missing) == [True, False]


def test_window_includes_both_of_its_ends_and_no_more():
    missing = [(9, 2, 14.0, 34.0, 110, 100)]
    assert near([(99, 20.0, 2), (100, 20.0, 2), (109, 20.0, 2), (110, 20.0, 2)], missing) == [False, True, True, False]


def test_would_be_neighbors_are_in_the_same_or_an_adjacent_lane():
    missing = [(9, 3, 14.0, 34.0, 110, 100)]
    clock = [(105, 24.0, lane) for lane in (0, 1, 2, 3, 4, 5, None)]
    assert near(clock, missing) == [False, False, True, True, True, False, True]
    assert near([(105, 24.0, 1)], [(9, None, 14.0, 34.0, 110, 100)]) == [True]


def test_several_missing_starts():
    missing = [(8, 1, 0.0, 10.0, 20, 10), (9, 5, 0.0, 10.0, 40, 15)]
    clock = [(12, 0.0, 1), (17, 0.0, 1), (17, 0.0, 5), (17, 0.0, 3), (30, 0.0, 5), (30, 0.0, 1)]
    assert near(clock, missing) == [True, True, True, False, True, False]
    assert near(clock, []) == [False] * 6
    assert near([], missing) == []


def test_would_be_neighbors_between_frames():
    """25 to 10 Hz: tick k lies at frame 1 + 2.5 k; the window [4, 10] holds 6 and 8.5, and 10.5 stays out at 11.

    Start on frame 11: tick 4 lies on it and is not in the window. Start on frame 9: tick 3 (frame 8.5) lies after
    the window's last frame, 8, but the vehicle has no entry there either.
    """
    clock = [(tick, 0.0, 1) for tick in range(5)]
    rates = {"first_frame": 1, "frame_rate_hz": 25.0, "rate_hz": 10}
    assert near(clock, [(9, 1, 0.0, 10.0, 11, 4)], **rates) == [False, False, True, True, False]
    assert near(clock, [(9, 1, 0.0, 10.0, 9, 3)], **rates) == [False, True, True, True, False]
    # Frame 8.5 of [6, 10]: x = 0 + 10 * 2.5 / 4 = 6.25
    edge = [(3, 46.25, 1), (3, 46.251, 1)]
    assert near(edge, [(9, 1, 0.0, 10.0, 10, 6)], **rates) == [True, False]
