"""Plan views of findings: boxes at their places by hand, the other vehicle of a finding against a slow obvious loop."""

import math
import re

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.pages.subset_scenes import find_partners
from tracklake.quality_reports.plots.plan_views import SHOWN, Road, draw_plan_views

SCHEMA = {
    "vehicle_id": pl.Int32,
    "frame": pl.Int32,
    "x_m": pl.Float64,
    "y_m": pl.Float64,
    "heading_rad": pl.Float32,
    "speed_mps": pl.Float32,
    "lane": pl.Int16,
    "leader_id": pl.Int32,
    "length_m": pl.Float64,
    "width_m": pl.Float64,
}
ROAD = Road([0.0, 4.0, 8.0], [(1, 2.0), (2, 6.0)], 1.0, 7.0)


def entry(vehicle, frame, x_m, y_m, *, heading=0.0, speed=10.0, lane=2, leader=None, size=(4.0, 2.0)) -> tuple:
    return vehicle, frame, x_m, y_m, heading, speed, lane, leader, *size


def draw(entries: list[tuple], *shown: tuple):
    frame = pl.DataFrame(entries, schema=SCHEMA, orient="row").sort("vehicle_id", "frame")
    return draw_plan_views(frame, pl.DataFrame(shown, schema=SHOWN, orient="row"), ROAD, 30.0)


def test_boxes_lie_at_eight_pixels_a_metre_around_the_findings_vehicles():
    entries = [
        entry(1, 10, 100.0, 5.0),
        entry(2, 10, 103.0, 5.0, size=(None, None)),
        entry(3, 10, 250.0, 5.0),  # out of view
        entry(1, 15, 105.0, 5.0),
        entry(1, 30, 120.0, 5.0),  # after the drawn way
    ]
    (view,) = draw(entries, (0, 1, 2, 10, 5, 20))
    # From 96 to 103 m: the middle is 99.5 m. Across: 2.5 m beside the markings, so that y = 5 m is 7.5 m from the top.
    assert "M4.0 52.0L4.0 68.0L-28.0 68.0L-28.0 52.0Z" in view.svg
    assert "M28.0 52.8L28.0 67.2L-8.0 67.2L-8.0 52.8Z" in view.svg, "of unknown size: 4.5 m by 1.8 m"
    assert re.findall(r'class="way" d="([^"]*)"', view.svg) == ["M4.0 60.0L44.0 60.0"]
    assert re.findall(r">(\d+)</text>", view.svg) == ["1", "2"]
    assert view.facts == (
        "vehicle 1: 36 km/h (10.0 m/s) at 100 m, lane 2; vehicle 2: 36 km/h (10.0 m/s) at 103 m, lane 2"
    )
    assert "lane 1</text>" in view.svg
    assert '"100 m"' in view.svg or ">100 m</text>" in view.svg


def test_a_vehicle_points_where_it_is_heading_and_a_far_leader_is_left_out_of_the_middle():
    entries = [entry(1, 3, 0.0, 4.0, heading=math.pi / 6, speed=-0.04), entry(2, 3, 40.0, 4.0, lane=None)]
    (view,) = draw(entries, (0, 1, 2, 3, 3, 3))
    # Half a width to the left of the front: (sin 30, -cos 30) * 8 pixels from (0, 52).
    assert "M4.0 45.1L-4.0 58.9" in view.svg
    assert view.facts.startswith("vehicle 1: 0 km/h (0.0 m/s) at 0 m")
    assert view.facts.endswith("at 40 m")


def test_a_vehicle_without_an_entry_at_the_moment_has_no_view():
    assert draw([entry(1, 3, 0.0, 4.0)], (0, 1, None, 4, 0, 9), (1, 1, None, 3, 0, 9))[0] is None


BOX = st.tuples(st.integers(0, 12), st.integers(0, 4), st.sampled_from([(4.0, 2.0), (9.0, 2.5), (None, None)]))


@settings(max_examples=40, deadline=None)
@given(st.lists(BOX, min_size=2, max_size=6))
def test_the_partner_of_an_overlap_is_the_deepest(boxes):
    rows = [entry(number, 7, 1.0 * x, 1.0 * y, size=size) for number, (x, y, size) in enumerate(boxes)]
    finding = {"vehicle_id": 0, "moment": 7, "partner": "overlap"}
    found = find_partners(pl.DataFrame(rows, schema=SCHEMA, orient="row"), [finding])
    (x, y, (length, width)), best = boxes[0], None
    for number, (other_x, other_y, (other_length, other_width)) in enumerate(boxes[1:], start=1):
        if length is None or other_length is None:
            continue
        apart = max(other_x - other_length - x, x - length - other_x, abs(y - other_y) - (width + other_width) / 2)
        if best is None or apart < best[0]:
            best = (apart, number)
    assert found == [best and best[1]]


@pytest.mark.parametrize(("leader", "there", "partner"), [(2, True, 2), (2, False, None), (None, True, None)])
def test_the_partner_of_a_gap_is_the_recorded_leader(leader, there, partner):
    rows = [entry(1, 7, 0.0, 0.0, leader=leader), entry(3, 7, 1.0, 0.0)] + [entry(2, 7, 50.0, 0.0)] * there
    finding = {"vehicle_id": 1, "moment": 7}
    frame = pl.DataFrame(rows, schema=SCHEMA, orient="row")
    assert find_partners(frame, [{**finding, "partner": "leader"}, {**finding, "partner": None}]) == [partner, None]
