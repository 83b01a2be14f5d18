"""Raw coordinates to the driver's, by hand and by symmetry."""

import math

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.orientation import (
    EAST,
    LOWER,
    NORTH,
    SOUTH,
    UPPER,
    WEST,
    orient_highd,
    orient_ngsim,
)

FOOT_M = 0.3048
UPPER_M, LOWER_M = [8.5, 12.25, 16.0], [20.2, 23.95, 27.7]


def boxes(rows):
    """Boxes of one vehicle each, at frame 1."""
    names = ("x", "y", "width", "height", "xVelocity", "yVelocity", "xAcceleration")
    schema = {**dict.fromkeys(names, pl.Float64), "laneId": pl.Int16}
    table = pl.DataFrame(rows, schema=schema, orient="row")
    return table.with_columns(id=pl.int_range(1, pl.len() + 1, dtype=pl.Int32), frame=pl.lit(1, pl.Int32))


def places(feet):
    schema = dict.fromkeys(("Local_X", "Local_Y", "v_Vel", "v_Acc"), pl.Float64)
    return pl.DataFrame(feet, schema=schema, orient="row")


def test_lower_carriageway():
    found = orient_highd(boxes([(10, 21, 4, 2, 25, -0.5, -1, 5)]), LOWER, UPPER_M, LOWER_M, 25.0)
    assert found["x_m"].to_list() == [14]
    # The middle is 22 - 20.2; the front is 4 / 2 * 0.5 / 25 = 0.04 m left of it.
    assert found["y_m"].to_list() == [1.76]
    assert found.select("lane", "speed_mps", "accel_mps2", "lateral_speed_mps").row(0) == (1, 25, -1, -0.5)


def test_upper_carriageway():
    found = orient_highd(
        boxes([(10, 13, 4, 2, -25, -0.5, -1, 3), (300, 9, 12, 2.5, -20, 0, 2, 2)]), UPPER, UPPER_M, LOWER_M, 25.0
    )
    assert found["x_m"].to_list() == [290, 0]
    assert found["y_m"].to_list() == [2.04, 5.75]
    assert found["lane"].to_list() == [1, 2]
    assert found["speed_mps"].to_list() == [25, 20]
    assert found["accel_mps2"].to_list() == [1, -2]
    assert found["lateral_speed_mps"].to_list() == [0.5, 0]


def test_the_front_centre_lies_ahead_of_the_bodys_middle():
    """A truck of 15 m that drives (30, 1) m/s has its front 7.5 sin(h) = 0.250 m right of its middle, at 2.25 m."""
    sine, cosine = 1 / math.hypot(30, 1), 30 / math.hypot(30, 1)
    lower = orient_highd(boxes([(100, 23, 15, 2.5, 30, 1, 0, 5)]), LOWER, [8, 12, 16], [22, 26, 30], 25.0)
    assert lower["y_m"].to_list() == [2.5]
    assert lower["x_m"].to_list() == [pytest.approx(107.5 + 7.5 * cosine, abs=6e-4)]
    assert lower["heading_rad"].to_list() == [pytest.approx(math.atan2(1, 30), abs=6e-5)]
    # Mirrored: the image turned by half, so that it drives up and left, under the marking at -22.
    rows = [(-115, -25.5, 15, 2.5, -30, -1, 0, 3), (0, -25.5, 4, 2.5, -30, 0, 0, 3)]
    upper = orient_highd(boxes(rows), UPPER, [-30, -26, -22], [8, 12, 16], 25.0)
    assert upper["y_m"].to_list() == [2.5, 2.25]
    assert upper["x_m"].to_list() == [pytest.approx(107.5 + 7.5 * cosine, abs=6e-4), 0.0]
    assert upper["heading_rad"].to_list() == [*lower["heading_rad"].to_list(), 0.0]
    # To the left by as much.
    left = orient_highd(boxes([(100, 23, 15, 2.5, 30, -1, 0, 5)]), LOWER, [8, 12, 16], [22, 26, 30], 25.0)
    assert left["y_m"].to_list() == [pytest.approx(2.25 - 7.5 * sine, abs=6e-4)]


number = st.integers(-400, 400).map(float)


@given(rows=st.lists(st.tuples(number, number, number, number, number), min_size=1, max_size=6))
@settings(max_examples=20, deadline=None)
def test_a_picture_turned_by_half_gives_the_same_tracks_on_the_other_carriageway(rows):
    """Turning the image by 180 degrees about (0, 0) turns the lower carriageway into an upper one."""
    length, width = 4.0, 2.0
    lower = boxes([(x, y, length, width, v, w, a, 6) for x, y, v, w, a in rows])
    upper = boxes([(-x - length, -y - width, length, width, -v, -w, -a, 3) for x, y, v, w, a in rows])
    turned = [-marking for marking in reversed(LOWER_M)]
    one = orient_highd(lower, LOWER, UPPER_M, LOWER_M, 25.0)
    other = orient_highd(upper, UPPER, turned, UPPER_M, 25.0)
    first = min(one["x_m"])
    assert other["x_m"].to_list() == pytest.approx(
        [x - first for x in one["x_m"]], abs=1.1e-3
    )  # rounded before or after
    assert other["y_m"].to_list() == pytest.approx(one["y_m"].to_list(), abs=1.1e-3)
    # Lane 6 of 2 + 2 is the lower right one; turned, it is lane 2, or here 3 - 1.
    assert one["lane"].to_list() == [2] * len(rows)
    assert other["lane"].to_list() == [1] * len(rows)
    for name in ("speed_mps", "accel_mps2", "lateral_speed_mps"):
        assert other[name].to_list() == one[name].to_list()


def test_a_freeway_is_converted_and_not_moved():
    found = orient_ngsim(places([(-2, 100, 50, -10), (12.5, -3, 0, 0)]), None)
    assert found["x_m"].to_list() == pytest.approx([30.48, -0.9144])
    assert found["y_m"].to_list() == pytest.approx([-0.6096, 3.81])
    assert found["speed_mps"].to_list() == pytest.approx([15.24, 0])
    assert found["accel_mps2"].to_list() == pytest.approx([-3.048, 0])


AHEAD = {EAST: (1, 0), NORTH: (0, 1), WEST: (-1, 0), SOUTH: (0, -1)}
"""Local_X runs east and Local_Y north."""

RIGHT = {EAST: (0, -1), NORTH: (1, 0), WEST: (0, 1), SOUTH: (-1, 0)}


@pytest.mark.parametrize("direction", [EAST, NORTH, WEST, SOUTH])
def test_ahead_and_right_of_the_driver(direction):
    here = (7.0, 300.0)
    ahead = tuple(value + 10 * step for value, step in zip(here, AHEAD[direction], strict=True))
    right = tuple(value + 10 * step for value, step in zip(here, RIGHT[direction], strict=True))
    found = orient_ngsim(places([(*place, 1, 1) for place in (here, ahead, right)]), direction)
    x, y = found["x_m"], found["y_m"]
    assert (x[1] - x[0], y[1] - y[0]) == pytest.approx((10 * FOOT_M, 0))
    assert (x[2] - x[0], y[2] - y[0]) == pytest.approx((0, 10 * FOOT_M))
    if direction != NORTH:
        assert x.min() == pytest.approx(0)


@pytest.mark.parametrize("direction", [None, EAST, NORTH, WEST, SOUTH])
def test_missing_accelerations_stay_missing_and_no_rows_are_no_rows(direction):
    assert orient_ngsim(places([(1, 2, 3, None)]), direction)["accel_mps2"].to_list() == [None]
    assert orient_ngsim(places([]), direction).is_empty()
