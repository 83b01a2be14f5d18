"""Geodesy against pymap3d, arcs of the ellipsoid worked out by hand, and the formula that the paper prints."""

import math

import numpy as np
import pymap3d
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.onboard.geodesy import (
    convert_to_ecef,
    convert_to_geodetic,
    locate_from_ego_frame,
    place_in_ego_frame,
    turn_by_heading,
)

A_M = 6_378_137.0
"""Semi-major axis of WGS-84, m."""
E2 = 0.00669437999014
"""Squared eccentricity of WGS-84."""


def place_one(position, ego, heading_deg):
    return place_in_ego_frame(np.array([position]), np.array([ego]), np.array([heading_deg]))[0]


def draw_scene(count):
    draw = np.random.default_rng(16)
    ego = np.stack(
        (draw.uniform(-89, 89, count), draw.uniform(-179.9, 179.9, count), draw.uniform(-50, 3000, count)), 1
    )
    near = ego + np.stack((draw.normal(0, 1e-3, count), draw.normal(0, 1e-3, count), draw.normal(0, 5, count)), 1)
    return near, ego, draw.uniform(0, 360, count)


def test_frame_agrees_with_pymap3d():
    near, ego, heading_deg = draw_scene(2_000)
    east, north, up = pymap3d.geodetic2enu(*near.T, *ego.T)
    sine, cosine = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    expected = np.stack((east * sine + north * cosine, east * cosine - north * sine, up), 1)
    np.testing.assert_allclose(place_in_ego_frame(near, ego, heading_deg), expected, rtol=0, atol=1e-7)


def test_round_trip_is_far_below_a_millimetre():
    near, ego, heading_deg = draw_scene(2_000)
    back = locate_from_ego_frame(place_in_ego_frame(near, ego, heading_deg), ego, heading_deg)
    error_m = np.linalg.norm(convert_to_ecef(*back.T) - convert_to_ecef(*near.T), axis=1)
    assert error_m.max() < 1e-6
    assert np.allclose(np.stack(convert_to_geodetic(convert_to_ecef(*near.T)), 1), near, rtol=0, atol=1e-6)


def test_ten_thousandth_of_a_degree_north_by_hand():
    # Radius of curvature along the meridian: a (1 - e2) / (1 - e2 sin2(lat))^1.5; at the equator 6,335,439.3 m.
    # 1e-4 deg = 1.745329e-6 rad: 6,335,439.3 * 1.745329e-6 = 11.057 m, at 45 deg 6,367,381.8 * 1.745329e-6 = 11.113 m.
    assert np.allclose(place_one((1e-4, 0, 0), (0, 0, 0), 0.0), (11.0574, 0, 0), atol=1e-3)
    assert np.allclose(place_one((45 + 1e-4, 0, 0), (45, 0, 0), 0.0), (11.1132, 0, 0), atol=1e-3)


def test_ten_thousandth_of_a_degree_east_by_hand():
    # At the equator a * 1.745329e-6 = 11.132 m; at 45 deg N cos(45) = a / sqrt(1 - e2 / 2) * 0.70711: 7.885 m.
    assert np.allclose(place_one((0, 1e-4, 0), (0, 0, 0), 0.0), (0, 11.1319, 0), atol=1e-3)
    assert np.allclose(place_one((45, 1e-4, 0), (45, 0, 0), 0.0), (0, 7.8847, 0), atol=1e-3)


def test_axes_of_the_ego():
    north_m = 11.0574
    assert np.allclose(
        place_one((1e-4, 0, 2), (0, 0, 0), 90.0), (0, -north_m, 2), atol=1e-3
    )  # heading east: to its left
    assert np.allclose(place_one((1e-4, 0, 2), (0, 0, 0), 180.0), (-north_m, 0, 2), atol=1e-3)  # behind it
    assert np.allclose(place_one((1e-4, 0, 2), (0, 0, 0), 270.0), (0, north_m, 2), atol=1e-3)  # to its right


def test_across_the_date_line():
    ahead = place_one((0, -180 + 5e-5, 0), (0, 180 - 5e-5, 0), 90.0)
    assert np.allclose(ahead, (11.1319, 0, 0), atol=1e-3)


def test_printed_equation_misses_the_ellipsoid():
    """Equation (1) of Choi et al. (2021) has (1 + e2) N for z; at 45 degrees that is 60 km off the ellipsoid."""
    lat = math.radians(45.0)
    radius_m = A_M / math.sqrt(1 - E2 * math.sin(lat) ** 2)
    right_m, printed_m = ((1 + sign * E2) * radius_m * math.sin(lat) for sign in (-1, 1))
    x_m, _, z_m = convert_to_ecef(np.array([45.0]), np.array([0.0]), np.array([0.0]))[0]
    assert abs(z_m - right_m) < 1e-6
    # (x / a)^2 + (z / b)^2 = 1 on the ellipsoid, with b^2 = a^2 (1 - e2)
    assert abs((x_m / A_M) ** 2 + right_m**2 / (A_M**2 * (1 - E2)) - 1) < 1e-12
    assert (x_m / A_M) ** 2 + printed_m**2 / (A_M**2 * (1 - E2)) - 1 > 0.01
    assert round((printed_m - right_m) / 1000) == 60
    # Differences suffer as well: 1e-4 degrees north are 11.11 m, and 11.21 m with the printed sign.
    step = math.radians(1e-4)
    stretch_m = [(1 + sign * E2) * radius_m * step * math.cos(lat) for sign in (-1, 1)]
    assert (
        math.hypot(stretch_m[1], radius_m * step * math.sin(lat))
        - math.hypot(stretch_m[0], radius_m * step * math.sin(lat))
        > 0.05
    )


def test_heading_error_of_one_degree_at_50_m():
    off = place_one((0, 50 / 111_319.5, 0), (0, 0, 0), 91.0)
    assert round(-off[1], 2) == 0.87


@settings(max_examples=30, deadline=None)
@given(heading=st.floats(-7, 7), x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_turning_twice_is_no_turn(heading, x, y):
    once = turn_by_heading(np.array([[x, y]]), np.array([heading]))
    assert np.allclose(turn_by_heading(once, np.array([heading])), [[x, y]], atol=1e-9)
    assert np.isclose(np.hypot(*once[0]), np.hypot(x, y))


def test_no_rows():
    assert place_in_ego_frame(np.empty((0, 3)), np.empty((0, 3)), np.empty(0)).shape == (0, 3)
