"""The fitted axis of a road: straight lines exactly, circles to centimetres, whatever the order of the points."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.road_axis import RoadAxis, find_direction

LANE_M = 3.6576


def make_points(x, y, lane):
    return pl.DataFrame({"x": x, "y": y, "lane": lane}, schema={"x": pl.Float64, "y": pl.Float64, "lane": pl.Int16})


@settings(max_examples=20)
@given(st.floats(0, 6.28), st.booleans(), st.integers(0, 2**32 - 1))
def test_a_straight_road_gives_distances_along_it_and_to_the_drivers_right(angle, y_points_down, seed):
    random = np.random.default_rng(seed)
    along, lane = random.uniform(0, 300, 200), random.integers(1, 4, 200)
    right = LANE_M * lane
    ahead, turn = np.array([np.cos(angle), np.sin(angle)]), 1 if y_points_down else -1
    x, y = np.outer(ahead, along) + np.outer([-turn * ahead[1], turn * ahead[0]], right)
    # The direction is given roughly.
    axis = RoadAxis.fit(
        make_points(x, y, lane), (np.cos(angle + 0.1), np.sin(angle + 0.1)), y_points_down=y_points_down
    )
    s, d = axis.project(x, y)
    assert np.ptp(s - along) < 1e-6
    assert np.ptp(d - right) < 1e-6


def test_a_curve_of_600_m_radius_is_followed_to_centimetres():
    random = np.random.default_rng(1)
    turned, lane = random.uniform(-0.5, 0.5, 6000), random.integers(1, 4, 6000)
    right = LANE_M * lane + random.normal(0, 0.2, 6000)
    # It turns to the right about (0, 600), in a plane whose y points down.
    x, y = (600 - right) * np.sin(turned), 600 - (600 - right) * np.cos(turned)
    axis = RoadAxis.fit(make_points(x, y, lane), (1.0, 0.05), y_points_down=True)
    s, d = axis.project(x, y)
    inside = np.abs(turned) < 0.45
    assert np.std((d - right)[inside]) < 0.05
    radius = 600 - np.median(right - d)
    assert np.ptp((s - radius * turned)[inside]) < 0.3


def test_a_single_point_and_points_without_lanes_have_an_axis():
    axis = RoadAxis.fit(make_points([5.0], [7.0], [None]), (0.0, 2.0), y_points_down=True)
    s, d = axis.project(np.array([5.0, 4.0]), np.array([7.0, 17.0]))
    assert s == pytest.approx([0, 10], abs=1e-6)
    assert d == pytest.approx([0, 1], abs=1e-6)


def test_the_direction_is_that_of_the_longest_ways_and_x_where_nobody_moved():
    assert np.abs(find_direction(np.array([3.0, -6.0, 0.1]), np.array([4.0, -8.0, 0.0]))) == pytest.approx(
        [0.6, 0.8], abs=0.01
    )
    assert find_direction(np.zeros(2), np.zeros(2)) == (1.0, 0.0)
    assert find_direction(np.empty(0), np.empty(0)) == (1.0, 0.0)
