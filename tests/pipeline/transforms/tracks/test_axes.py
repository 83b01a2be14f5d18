"""Road axes: circles and lines whose places are known, and tracks that a fit must see through."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.axes import STEP_M, draw_axis, fit_axis, trace_track, wrap_angle
from tracklake.pipeline.transforms.tracks.carriageways import (
    find_lanes,
    name_direction,
    name_movements,
    part_directions,
)
from tracklake.pipeline.transforms.tracks.utm import find_zone, project_utm


def on_circle(radius_m, along_m, right_m):
    """Places along a left bend that begins at (0, 0) to the east."""
    angle = along_m / radius_m
    return (radius_m + right_m) * np.sin(angle), radius_m - (radius_m + right_m) * np.cos(angle)


def draw_circle(radius_m, length_m):
    return draw_axis(*on_circle(radius_m, np.arange(0, length_m, 0.2), 0.0))


def test_places_on_a_straight_line_by_hand():
    axis = draw_axis(np.array([0.0, 0.0]), np.array([10.0, 110.0]))  # to the north: east is right
    places = axis.project(np.array([3.0, -2.0, 1.0]), np.array([10.0, 60.0, 130.0]))
    assert places.along_m == pytest.approx([0, 50, 120])  # straight on beyond its end
    assert places.right_m == pytest.approx([3, -2, 1])
    assert places.angle_rad == pytest.approx([np.pi / 2] * 3)
    assert places.stretch == pytest.approx([1, 1, 1])


@settings(max_examples=30)
@given(
    radius_m=st.floats(25, 3000),
    share=st.floats(0.05, 0.95),
    right_m=st.floats(-12, 20),
)
def test_places_on_a_circle(radius_m, share, right_m):
    length_m = min(400.0, 3 * radius_m)
    axis = draw_circle(radius_m, length_m)
    x, y = on_circle(radius_m, np.array([share * length_m]), right_m)
    places = axis.project(x, y)
    assert places.along_m == pytest.approx([share * length_m], abs=0.02)
    assert places.right_m == pytest.approx([right_m], abs=0.01)
    assert places.stretch == pytest.approx([1 + right_m / radius_m], abs=0.02)
    assert np.stack(axis.locate(places.along_m, places.right_m)) == pytest.approx(np.stack([x, y]), abs=1e-6)


def test_places_on_a_way_that_comes_back_beside_itself():
    # 40 m to the north at x = 2.5, half a circle of 2.5 m to the left, back to the south at x = -2.5.
    north, turn = np.arange(0, 40, 0.1), np.arange(0, np.pi, 0.02)
    x = np.concatenate([np.full(400, 2.5), 2.5 * np.cos(turn), np.full(400, -2.5)])
    axis = draw_axis(x, np.concatenate([north, 40 + 2.5 * np.sin(turn), 40 - north]))
    at = np.arange(3.0, 37.0, 0.25)
    # 1 m towards the other way, which is then 4 m away.
    for x_m, along in ((1.5, at), (-1.5, 80 + 2.5 * np.pi - at)):
        places = axis.project(np.full(len(at), x_m), at)
        assert places.along_m == pytest.approx(along, abs=0.3)
        assert places.right_m == pytest.approx(np.full(len(at), -1.0), abs=0.1)


def test_a_way_along_the_axis_is_as_long_as_its_stretch_says():
    axis = draw_circle(150.0, 300.0)
    along = np.arange(20, 280, 1.0)
    x, y = on_circle(150.0, along, 8.0)
    places = axis.project(x, y)
    ways = np.hypot(np.diff(x), np.diff(y))
    assert ways / np.diff(places.along_m) == pytest.approx(places.stretch[1:], rel=2e-3)


def test_a_fit_sees_through_the_lane_change_of_the_longest_track():
    random = np.random.default_rng(3)
    along = np.arange(0, 400, 0.5)
    x, y = on_circle(500.0, along, 3.5 / (1 + np.exp(-(along - 200) / 15)))
    began = trace_track(x, y, np.full(len(x), 20.0))
    others = random.uniform(0, 400, 5_000)
    lanes = random.choice([-3.5, 0.0, 3.5, 7.0], 5_000)
    fitted = fit_axis(began, *on_circle(500.0, others, lanes), others / 500 + random.normal(0, 0.01, 5_000))
    right = fitted.project(*on_circle(500.0, np.linspace(20, 380, 200), 0.0)).right_m
    assert np.ptp(right) < 0.3
    assert np.ptp(began.project(*on_circle(500.0, np.linspace(20, 380, 200), 0.0)).right_m) > 3


def test_a_fit_grows_to_the_ends_of_the_points():
    random = np.random.default_rng(4)
    began = draw_axis(*on_circle(300.0, np.arange(100, 180, 0.5), 0.0))
    others, lanes = random.uniform(0, 300, 5_000), random.choice([0.0, 3.5, 7.0], 5_000)
    fitted = fit_axis(began, *on_circle(300.0, others, lanes), others / 300)
    assert fitted.length_m == pytest.approx(300, abs=10)
    assert np.ptp(fitted.project(*on_circle(300.0, np.linspace(5, 295, 200), 0.0)).right_m) < 0.3


def test_what_does_not_drive_has_no_axis():
    assert trace_track(np.array([1.0, 1.1, 0.9]), np.zeros(3), np.zeros(3)) is None
    assert trace_track(np.array([]), np.array([]), np.array([])) is None
    assert trace_track(np.array([1.0]), np.array([1.0]), np.array([9.0])) is None
    short = trace_track(np.array([0.0, 1.0, 2.0]), np.zeros(3), np.full(3, 9.0))
    assert short.length_m <= 2
    assert fit_axis(short, np.array([]), np.array([]), np.array([])) is short


def test_a_standing_vehicle_adds_no_way():
    x = np.concatenate([np.arange(0, 20, 0.5), 20 + 0.05 * np.sin(np.arange(500)), np.arange(20, 40, 0.5)])
    speed = np.concatenate([np.full(40, 12.0), np.zeros(500), np.full(40, 12.0)])
    assert trace_track(x, np.zeros(len(x)), speed).length_m == pytest.approx(40, abs=3 * STEP_M)


def test_directions_are_parted_and_named():
    angles = np.radians([5, 8, 2, 186, 190, 178])
    way = part_directions(angles)
    assert [*way[:3]] == [way[0]] * 3
    assert [*way[3:]] == [1 - way[0]] * 3
    assert name_direction(np.radians([350.0, 20.0])) == "east"
    assert name_direction(np.radians([170.0, -170.0])) == "west"
    assert name_direction(np.radians([100.0])) == "north"
    assert wrap_angle(np.radians([190.0])) == pytest.approx(np.radians([-170.0]))


def test_movements_are_named_by_arms_that_need_not_point_to_the_compass():
    # Four arms, turned by 20 degrees: a vehicle that enters to the north comes from the south.
    turned = np.radians(20)
    start, end = (np.radians(each) + turned for each in ([90.0, 90.0, 0.0, 270.0], [90.0, 0.0, 90.0, 180.0]))
    assert name_movements(start, end) == ["south-to-north", "south-to-east", "west-to-north", "north-to-west"]


def lane_points(lanelets):
    """Points of lanelets (id, from, to, right, width) every metre."""
    import polars as pl

    rows = [(name, float(at), right, width) for name, low, high, right, width in lanelets for at in range(low, high)]
    return pl.DataFrame(rows, schema=["lanelet", "along_m", "right_m", "width_m"], orient="row")


def test_lanes_count_from_the_left_and_ramps_are_no_main_lanes():
    found = find_lanes(
        lane_points(
            [(10, 0, 200, -3.6, 3.6), (20, 0, 100, 0.0, 3.6), (21, 100, 200, 0.0, 3.6), (30, 0, 200, 3.6, 3.6),
             (40, 60, 140, 7.2, 3.6), (50, 0, 60, 11.0, 3.6)]
        )
    )  # fmt: skip
    assert dict(found.lanes.iter_rows()) == {10: 1, 20: 2, 21: 2, 30: 3, 40: 4, 50: 4}
    assert (found.main, found.others) == (3, [4])
    assert found.left_m == pytest.approx(-5.4)
    assert found.markings_m == pytest.approx([0, 3.6, 7.2, 10.8])


def test_a_lane_that_begins_on_the_left_makes_no_ramps_of_the_others():
    points = lane_points([(1, 0, 400, 0.0, 3.5), (2, 0, 400, 3.5, 3.5), (3, 60, 400, -3.5, 3.5)])
    found = find_lanes(points)
    # Lane 1 exists in 34 of 40 pieces, 85 %.
    assert dict(found.lanes.iter_rows()) == {3: 1, 1: 2, 2: 3}
    assert (found.main, found.others, found.left_m) == (3, [], -5.25)
    assert found.markings_m == [0, 3.5, 7, 10.5]


def test_a_lane_that_is_out_of_use_for_a_while_is_still_there():
    points = lane_points([(1, 0, 40, 0.0, 3.5), (1, 160, 200, 0.0, 3.5), (2, 0, 200, 3.5, 3.5)])
    assert dict(find_lanes(points).lanes.iter_rows()) == {1: 1, 2: 2}


def test_lanes_that_drift_off_the_axis_have_no_markings():
    points = lane_points([(1, 0, 200, 0.0, 3.5)]).with_columns(right_m="along_m")
    assert find_lanes(points).markings_m is None
    assert find_lanes(points.clear()).main is None


@pytest.mark.parametrize("zone", [1, 31, 32, 60])
def test_the_plane_of_utm_agrees_with_pyproj(zone):
    pyproj = pytest.importorskip("pyproj", reason="the extra [onboard] is not installed")
    random = np.random.default_rng(zone)
    lat, lon = random.uniform(-80, 80, 200), random.uniform(-3, 3, 200) + 6 * zone - 183
    east, north = project_utm(lat, lon, zone)
    hemisphere = [pyproj.Transformer.from_crs(4326, code + zone, always_xy=True) for code in (32600, 32700)]
    expected = np.where(lat < 0, hemisphere[1].transform(lon, lat), hemisphere[0].transform(lon, lat))
    assert np.abs(np.stack([east, north]) - expected).max() < 0.002
    assert find_zone(6 * zone - 183) == zone
