"""Raw coordinates to the driver's, by hand and by symmetry."""

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
    names = ("x", "y", "width", "height", "xVelocity", "yVelocity", "xAcceleration")
    schema = {**dict.fromkeys(names, pl.Float64), "laneId": pl.Int16}
    return pl.DataFrame(rows, schema=schema, orient="row")


def places(feet):
    schema = dict.fromkeys(("Local_X", "Local_Y", "v_Vel", "v_Acc"), pl.Float64)
    return pl.DataFrame(feet, schema=schema, orient="row")


def test_lower_carriageway():
    found = orient_highd(boxes([(10, 21, 4, 2, 25, -0.5, -1, 5)]), LOWER, UPPER_M, LOWER_M)
    assert found["x_m"].to_list() == [14]
    assert found["y_m"].to_list() == pytest.approx([1.8])
    assert found.select("lane", "speed_mps", "accel_mps2", "lateral_speed_mps").row(0) == (1, 25, -1, -0.5)


def test_upper_carriageway():
    found = orient_highd(
        boxes([(10, 13, 4, 2, -25, -0.5, -1, 3), (300, 9, 12, 2.5, -20, 0, 2, 2)]), UPPER, UPPER_M, LOWER_M
    )
    assert found["x_m"].to_list() == [290, 0]
    assert found["y_m"].to_list() == pytest.approx([2.0, 5.75])
    assert found["lane"].to_list() == [1, 2]
    assert found["speed_mps"].to_list() == [25, 20]
    assert found["accel_mps2"].to_list() == [1, -2]
    assert found["lateral_speed_mps"].to_list() == [0.5, 0]


number = st.integers(-400, 400).map(float)


@given(rows=st.lists(st.tuples(number, number, number, number, number), min_size=1, max_size=6))
@settings(max_examples=20, deadline=None)
def test_a_picture_turned_by_half_gives_the_same_tracks_on_the_other_carriageway(rows):
    """Turning the image by 180 degrees about (0, 0) turns the lower carriageway into an upper one."""
    length, width = 4.0, 2.0
    lower = boxes([(x, y, length, width, v, w, a, 6) for x, y, v, w, a in rows])
    upper = boxes([(-x - length, -y - width, length, width, -v, -w, -a, 3) for x, y, v, w, a in rows])
    turned = [-marking for marking in reversed(LOWER_M)]
    one = orient_highd(lower, LOWER, UPPER_M, LOWER_M)
    other = orient_highd(upper, UPPER, turned, UPPER_M)
    first = min(one["x_m"])
    assert other["x_m"].to_list() == pytest.approx([x - first for x in one["x_m"]])
    assert other["y_m"].to_list() == pytest.approx(one["y_m"].to_list())
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
