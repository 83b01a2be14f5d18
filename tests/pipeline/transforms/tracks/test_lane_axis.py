"""The fitted axis of lanes: straight lines exactly, circles to centimetres, whatever the order of the points."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.lane_axis import find_direction, fit_lane_axis

LANE_M = 3.6576


def make_points(x, y, lane):
    return pl.DataFrame({"x": x, "y": y, "lane": lane}, schema={"x": pl.Float64, "y": pl.Float64, "lane": pl.Int16})


@settings(max_examples=20)
@given(st.floats(0, 6.28), st.integers(0, 2**32 - 1))
def test_a_straight_road_gives_distances_along_it_and_to_the_drivers_right(angle, seed):
    random = np.random.default_rng(seed)
    along, lane = random.uniform(0, 300, 200), random.integers(1, 4, 200)
    right = LANE_M * lane
    x, y = along * np.cos(angle) + right * np.sin(angle), along * np.sin(angle) - right * np.cos(angle)
    # The direction is given roughly.
    places = fit_lane_axis(make_points(x, y, lane), (np.cos(angle + 0.1), np.sin(angle + 0.1))).project(x, y)
    assert np.ptp(places.along_m - along) < 1e-5
    assert np.ptp(places.right_m - right) < 1e-5


def test_a_curve_of_600_m_radius_is_followed_to_centimetres():
    random = np.random.default_rng(1)
    turned, lane = random.uniform(-0.5, 0.5, 6000), random.integers(1, 4, 6000)
    right = LANE_M * lane + random.normal(0, 0.2, 6000)
    # It turns to the right about (0, -600).
    x, y = (600 - right) * np.sin(turned), (600 - right) * np.cos(turned) - 600
    places = fit_lane_axis(make_points(x, y, lane), (1.0, -0.05)).project(x, y)
    inside = np.abs(turned) < 0.45
    assert np.std((places.right_m - right)[inside]) < 0.05
    radius = 600 - np.median(right - places.right_m)
    assert np.ptp((places.along_m - radius * turned)[inside]) < 0.3


def test_a_single_point_without_a_lane_has_an_axis():
    axis = fit_lane_axis(make_points([5.0], [7.0], [None]), (0.0, 2.0))
    places = axis.project(np.array([5.0, 6.0]), np.array([7.0, 17.0]))
    assert places.along_m == pytest.approx([0, 10], abs=1e-6)
    assert places.right_m == pytest.approx([0, 1], abs=1e-6)


def test_the_direction_is_that_of_the_longest_ways_and_x_where_nobody_moved():
    found = np.abs(find_direction(np.array([3.0, -6.0, 0.1]), np.array([4.0, -8.0, 0.0])))
    assert found == pytest.approx([0.6, 0.8], abs=0.01)
    assert find_direction(np.zeros(2), np.zeros(2)) == (1.0, 0.0)
    assert find_direction(np.empty(0), np.empty(0)) == (1.0, 0.0)
