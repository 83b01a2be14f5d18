"""The page of a subset shows its fundamental diagram by cells and its car following; quality.json has the figures."""

import re

import pytest

from tracklake.quality_reports.pages.subsets import render_pages
from tracklake.quality_reports.summaries import collect, query

WHERE = {"dataset": "highd", "subset": "01-lower"}
FACTS = {
    **WHERE, "recording": "01", "site": "1", "origin": "recorded", "direction": "lower", "freeway": True,
    "frame_rate_hz": 25.0, "lanes": 1, "seconds": 10.0, "first_frame": 1, "last_frame": 250, "vehicles": 1,
    "entries": 50, "ids_split": 0, "columns_missing": [], "on_ramp_lanes": [], "source_files": [],
}  # fmt: skip
TRACKS = [
    {**WHERE, "vehicle_id": 1, "frame": f, "time_s": f / 25, "x_m": 0.8 * f, "y_m": 2.0, "lane": 1, "speed_mps": 20.0}
    for f in range(1, 51)
]


def cell(from_m: float, from_s: float, **values) -> dict:
    usual = {"lane": 1, "length_m": 100.0, "seconds": 30.0, "vehicles": 2, "distance_m": 900.0, "time_s": 30.0}
    figures = {"flow_vph": 1080.0, "density_vpkm": 10.0, "speed_mps": 30.0}
    return {**WHERE, "from_m": from_m, "from_s": from_s, **usual, **figures, **values}


@pytest.fixture(scope="module")
def traffic(open_lake):
    cells = [
        cell(0, 0), cell(0, 30, flow_vph=1500.0, density_vpkm=50.0, speed_mps=8.0), cell(100, 0, length_m=40.0),
        cell(100, 30, vehicles=0, time_s=0.0),
    ]  # fmt: skip
    episode = {**WHERE, "leader_id": 2, "lane": 1, "last_frame": 40, "entries": 9, "ends_by": "view"}
    runs = {**WHERE, "leader_id": 2, "threshold": 1.5, "last_frame": 9, "entries": 1, "worst": 1.0, "vehicle_id": 1}
    change = {**WHERE, "first_frame": 1, "last_frame": 9, "from_lane": 1, "to_lane": 2, "vehicle_id": 1}
    return open_lake(
        subsets=[FACTS],
        tracks=TRACKS,
        edie=cells,
        car_following=[
            {**episode, "vehicle_id": 1, "first_frame": 1, "seconds": 4.0, "begins_by": "cut_in"},
            {**episode, "vehicle_id": 3, "first_frame": 1, "seconds": 8.0, "begins_by": "view"},
        ],
        lane_change_events=[
            {**change, "crossing_frame": 5, "seconds": 6.0, "begin_seen": True, "end_seen": True},
            {**change, "crossing_frame": 9, "seconds": 1.0, "begin_seen": True, "end_seen": False},
        ],
        safety=[
            {**runs, "measure": "ttc_s", "first_frame": 1, "seconds": 0.5},
            {**runs, "measure": "ttc_s", "first_frame": 8, "seconds": 1.0},
            {**runs, "measure": "pet_s", "first_frame": 5, "seconds": 0.04},
        ],
    )


def test_quality_json_has_the_figures(traffic):
    (figures,) = collect(traffic, {})["traffic"]
    assert figures == {
        **WHERE, "episodes": 2, "following_s": 12.0, "median_episode_s": 6.0, "cut_ins": 1, "lane_changes": 2,
        "median_lane_change_s": 6.0, "ttc_exposed_s": 1.5, "drac_exposed_s": 0.0, "headway_exposed_s": 0.0,
        "encroachments": 1,
    }  # fmt: skip


def test_small_and_empty_cells_are_left_out(traffic):
    shown = query(traffic, "subset_edie")
    assert [(row["density_veh_per_km"], row["flow_veh_per_h"]) for row in shown] == [(10, 1080), (50, 1500)]


def test_the_page_shows_both(traffic):
    (html,) = dict(render_pages(traffic, {})).values()
    diagram = re.search(r'aria-label="Flow against density".*?</svg>', html, flags=re.DOTALL)[0]
    assert diagram.count("<circle") == 2
    assert "20 km/h" in diagram
    text = " ".join(re.sub(r"<[^>]+>", "", html).split())
    assert "2 episodes behind one leader, 0.2 min in all, median 6.0 s; 1 begin by a cut-in." in text
    assert "2 lane changes, median 6.0 s. Time beyond the thresholds: 1.5 s with too short a time to coll" in text


def test_without_the_stage_the_diagram_is_that_of_intervals(open_lake):
    (html,) = dict(render_pages(open_lake(subsets=[FACTS], tracks=TRACKS), {})).values()
    assert 'id="traffic"' not in html
    assert "one mark per interval" in html
