"""Whole subsets judged: injected defects found entry for entry, random scenes as the slow loop finds them."""

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rule_scenes import change, driver, entries_found, scene_of

from tracklake.pipeline.synthetic.expected_findings import RULE_TESTS, find_broken
from tracklake.pipeline.synthetic.scenery import Entry, Surface
from tracklake.quality_reports.rules.evaluate import judge, tracks_needed
from tracklake.quality_reports.rules.findings import SubsetOrderError
from tracklake.quality_reports.rules.registry import RULES, ThresholdError
from tracklake.quality_reports.rules.scene import Scene, find_lacking
from tracklake.schemas import FINDINGS, SUBSET_SCORES, SUBSETS, TRACKS, VEHICLE_SCORES

LARGEST = 2**31 - 1
ROAD = Surface(rate_hz=10.0, markings=(0.0, 4.0, 8.0, 12.0), has_headings=True, lanes=3)
FRAMES = range(1, 41)
JUDGED = tuple(rule for rule in RULES if rule.name in RULE_TESTS)
"""The rules that the slow loop knows; any other has its own case alone (test_rule_cases.py)."""
TRACKED = {
    *("hard_deceleration", "acceleration_bound", "lateral_acceleration", "heading_motion_mismatch"),
    *("track_fragment", "cross_section_flow", "duplicate_track", "size_change"),
}
"""Rules with a scene of their own."""


def platoon() -> dict:
    """Sound traffic at 20 m/s: vehicles 1 to 8 in lane 1, 50 m apart; in lane 3, 9 to 11: 6 m and 200 m apart."""
    entries = {}
    for vehicle in range(1, 9):
        leader = {"leader": vehicle - 1, "headway": 50.0} if vehicle > 1 else {}
        entries |= driver(vehicle, FRAMES, x=500.0 - 50 * vehicle, **leader)
    lane = {"lane": 3, "y": 10.0}
    entries |= driver(9, FRAMES, x=400.0, **lane)
    entries |= driver(10, FRAMES, x=394.0, leader=9, headway=6.0, **lane)
    return entries | driver(11, FRAMES, x=194.0, leader=10, headway=200.0, **lane)


def test_sound_traffic_has_no_findings():
    judged = judge(scene_of(platoon(), ROAD))
    assert judged.findings.equals(FINDINGS.empty())
    assert judged.unchecked == ()


def test_injected_defects_are_found_entry_for_entry_and_nothing_else():
    entries = platoon()
    change(entries, 2, [10], accel=3.5)
    change(entries, 2, [33], headway=4.0)
    change(entries, 3, [12, 13], speed=1.0, accel=0.0)
    change(entries, 3, [30, *range(32, 41)], accel=0.6)
    change(entries, 4, [15], speed=-1.0)
    change(entries, 4, range(30, 35), lane=2)
    change(entries, 5, [20], ahead=4.0)
    for frame in (25, 26, 27):
        del entries[6, frame]
    change(entries, 8, [5], leader=6, headway=100.0)
    change(entries, 10, [30, 31], ahead=1.5)
    change(entries, 11, FRAMES, length=12.0)
    change(entries, 11, [3], y=7.5)
    found = judge(scene_of(entries, ROAD), rules=[rule for rule in JUDGED if rule.name not in TRACKED]).findings
    runs = found.select("rule", "vehicle_id", "first_frame", "last_frame", "entries", "worst")
    expected = [
        ("backward", 4, 15, 15, 1, -1.0),
        ("frame_gap", 6, 28, 28, 1, 3.0),
        # The recorded headway says 4 m where positions say 50 m; the others moved from where it was recorded.
        ("headway_mismatch", 2, 33, 33, 1, 46.0),
        ("headway_mismatch", 5, 20, 20, 1, 4.0),
        ("headway_mismatch", 6, 20, 20, 1, 4.0),
        ("headway_mismatch", 10, 30, 31, 2, 1.5),
        ("headway_mismatch", 11, 30, 31, 2, 1.5),
        ("high_acceleration", 2, 10, 10, 1, 3.5),
        # (3.5 - 0.5) / 0.1 s up and down again.
        ("high_jerk", 2, 10, 11, 2, 30.0),
        ("implausible_size", 11, 1, 40, 40, 4.0),
        # Up at 30, down at 31, up at 32: two changes, until the jerk of 30 is ten jerks ago.
        ("jerk_flicker", 3, 32, 39, 8, 2.0),
        ("lane_flicker", 4, 30, 34, 5, 0.5),
        # 4's leader is in another lane, 50 m ahead, and no one is in lane 2; 5's is beside while 3 leads it at 100 m.
        ("leader_mismatch", 4, 30, 34, 5, 50.0),
        ("leader_mismatch", 5, 30, 34, 5, 50.0),
        ("leader_mismatch", 8, 5, 5, 1, 50.0),
        ("low_constant_speed", 3, 12, 13, 2, 1.0),
        # 6 m - 5 m - 1.5 m.
        ("negative_headway", 10, 30, 31, 2, -0.5),
        ("negative_headway_recorded", 2, 33, 33, 1, -1.0),
        ("outside_lane", 4, 30, 34, 5, 2.0),
        ("outside_lane", 11, 3, 3, 1, 0.5),
        ("overlap", 9, 30, 31, 2, 0.5),
        ("overlap", 10, 30, 31, 2, 0.5),
        # 6 m instead of 2 m, then -2 m.
        ("position_jump", 5, 20, 21, 2, 4.0),
        ("speed_mismatch", 3, 12, 13, 2, 19.0),
        ("speed_mismatch", 4, 15, 15, 1, 21.0),
        # (4 m +- 4 m) / 0.2 s beside the jump; (4 m +- 1.5 m) / 0.2 s around the overlap.
        ("speed_mismatch", 5, 19, 19, 1, 20.0),
        ("speed_mismatch", 5, 21, 21, 1, 20.0),
        ("speed_mismatch", 10, 29, 32, 4, 7.5),
    ]
    assert [row[:-1] for row in runs.rows()] == [row[:-1] for row in expected]
    assert runs["worst"].to_list() == pytest.approx([row[-1] for row in expected], abs=1e-6)
    assert set(runs["rule"]) == set(RULE_TESTS) - TRACKED, "every rule has its defect"
    severities = {rule.name: rule.severity for rule in RULES}
    assert all(severities[rule] == severity for rule, severity in found.select("rule", "severity").iter_rows())


def test_defects_of_tracking_are_found_entry_for_entry_and_nothing_else():
    entries = driver(1, FRAMES, x=0.0, speed=0.1, accel=0.5, box=(5.0, 2.0))
    change(entries, 1, [20], accel=-8.5)
    change(entries, 1, [8], box=(5.0, 2.3))
    entries |= driver(2, FRAMES, x=10.0, speed=20.0)
    change(entries, 2, [5], accel=3.5)
    change(entries, 2, [25], lateral=2.5, speed=10.0)
    entries |= driver(3, range(5, 10), x=420.0, lane=2, y=6.0)
    entries |= driver(4, range(5, 10), x=421.0, lane=2, y=6.2)
    entries |= driver(5, range(5, 9), x=425.0, lane=2, y=6.1)
    # 6 and 7 drive from -20 to 500 m; 8 ends at 229 m; 9 begins at 331 m, and 10 does so on the ramp.
    road = {"lane": 3, "y": 10.0, "speed": 400.0}
    entries |= driver(6, range(11, 25), x=-20.0, **road) | driver(7, range(12, 26), x=-20.0, **road)
    entries |= driver(8, range(13, 20), x=-11.0, **road) | driver(9, range(20, 25), x=331.0, **road)
    entries |= driver(10, range(20, 25), x=331.0, lane=4, y=14.0, speed=400.0)
    judged = judge(scene_of(entries, ROAD), rules=[rule for rule in JUDGED if rule.name in TRACKED])
    runs = judged.findings.select("rule", "vehicle_id", "first_frame", "last_frame", "worst").rows()
    expected = [
        ("acceleration_bound", 2, 5, 5, 0.3),  # 5 m/s2 - 0.09 1/s * 20 m/s
        # Cross sections lie at 0, 100, ... and 400 m: 8 crosses 200 but not 300 m, 9 crosses 400 but not 300 m.
        ("cross_section_flow", 8, 19, 19, 71.0),
        ("cross_section_flow", 9, 20, 20, 31.0),
        ("duplicate_track", 3, 5, 9, 0.5),
        ("duplicate_track", 4, 5, 9, 0.5),
        ("hard_deceleration", 1, 20, 20, -8.5),
        ("heading_motion_mismatch", 2, 25, 25, 0.245),  # atan(2.5 / 10)
        ("lateral_acceleration", 2, 25, 26, 25.0),
        ("size_change", 1, 1, 40, 0.3),
        ("track_fragment", 3, 9, 9, 72.0),
        ("track_fragment", 4, 9, 9, 71.0),
        ("track_fragment", 5, 8, 8, 69.0),
        ("track_fragment", 8, 19, 19, 271.0),
        ("track_fragment", 9, 20, 20, 351.0),
    ]
    assert [row[:-1] for row in runs] == [row[:-1] for row in expected]
    assert [row[-1] for row in runs] == pytest.approx([row[-1] for row in expected], abs=1e-6)
    assert {rule for rule, *_ in runs} == TRACKED
    row = judged.subset_scores.row(0, named=True)
    assert row["fragments_per_1000_vehicles"] == 500
    # 2 drives from 10 to 88 m; 10, on the ramp, crosses the last one only.
    sections = [(0.0, 3, 0, 0), (100.0, 3, 0, 0), (200.0, 3, 1, 0), (300.0, 2, 0, 1), (400.0, 4, None, None)]
    assert [tuple(each.values()) for each in row["cross_sections"]] == sections


WIDTHS = [0.5, 1.8, 2.0, 4.0]
LENGTHS = [2.0, 4.0, 9.0]


@st.composite
def random_scenes(draw) -> tuple[dict, Surface]:
    """A few vehicles close to each other, with gaps, shared positions and values at and beside the thresholds."""
    rate = draw(st.sampled_from([10.0, 25.0]))
    markings = draw(st.sampled_from([(), (0.0, 4.0, 8.0)]))
    surface = Surface(rate, markings, headway_stands_in=draw(st.booleans()), has_headings=True)
    ids = draw(st.lists(st.sampled_from([1, 2, 3, 7, 90, LARGEST]), min_size=1, max_size=4, unique=True))
    entries = {}
    for vehicle in ids:
        length, width = draw(st.sampled_from(LENGTHS)), draw(st.sampled_from(WIDTHS))
        kind = draw(st.sampled_from(["car", "truck", "motorcycle"]))
        start, step = draw(st.sampled_from([0.0, 4.0, 8.0, 9.5])), draw(st.sampled_from([0.0, 0.8, 2.0]))
        first, seen = draw(st.integers(1, 5)), draw(st.lists(st.booleans(), min_size=1, max_size=40))
        lanes = draw(st.lists(st.sampled_from([1, 1, 1, 2, 3]), min_size=len(seen), max_size=len(seen)))
        noise = draw(st.lists(st.sampled_from([0.0, 0.0, 0.0, 0.1, 1.5, 4.0]), min_size=len(seen), max_size=len(seen)))
        accels = draw(
            st.lists(
                st.sampled_from([0.0, 0.5, 0.51, 2.0, 3.05, 3.06, -1.0, -8.0, -8.01]),
                min_size=len(seen),
                max_size=len(seen),
            )
        )
        calm = draw(st.booleans())
        for place, there in enumerate(seen):
            if not there and draw(st.booleans()):
                continue
            entries[vehicle, first + place] = Entry(
                front=round(start + step * place + noise[place], 3),
                length=length,
                width=width,
                kind=kind,
                speed=draw(st.sampled_from([step * rate, step * rate, 1.52, -0.5])),
                accel=0.5 if calm else accels[place],
                leader=draw(st.sampled_from([0, *ids, 55])),
                headway=draw(st.sampled_from([0.0, 4.0, 5.0, 9.99])),
                y=draw(st.sampled_from([2.0, 2.0, 3.9, 3.99, 4.0, 4.01])),
                lane=lanes[place // 3 * 3] if draw(st.booleans()) else lanes[place],
                heading=draw(st.sampled_from([0.0, 0.0, 0.125, -0.25])),
                lateral=draw(st.sampled_from([None, None, 0.0, 0.3, -0.31])),
                box=draw(st.sampled_from([None, (length, width), (length + 0.1, width), (length, width + 0.11)])),
            )
    return entries, surface


@settings(max_examples=50, deadline=None)
@given(random_scenes())
def test_every_rule_finds_what_the_slow_loop_finds(drawn):
    entries, surface = drawn
    found = entries_found(judge(scene_of(entries, surface), rules=JUDGED).findings)
    assert found == {rule: keys for rule, keys in find_broken(entries, surface) if keys}


def test_one_entry_alone_and_no_entries():
    scene = scene_of(driver(LARGEST, range(LARGEST - 1, LARGEST), x=5.0), ROAD)
    assert judge(scene).findings.is_empty()
    assert judge(scene).vehicle_scores.select("entries", "share_without_error").rows() == [(1, 1.0)]
    nothing = Scene(scene.tracks.clear(), scene.vehicles.clear(), 10.0, None)
    judged = judge(nothing)
    assert judged.findings.equals(FINDINGS.empty())
    assert judged.vehicle_scores.equals(VEHICLE_SCORES.empty())
    assert judged.subset_scores.equals(SUBSET_SCORES.empty())


def facts(**values) -> pl.DataFrame:
    road = {"lanes": 3, "on_ramp_lanes": [], "first_frame": 1, "last_frame": 40, "frame_rate_hz": 10.0}
    row = {**dict.fromkeys(SUBSETS.dtypes), "columns_missing": [], **road, **values}
    return pl.DataFrame([row], schema=SUBSETS.dtypes)


def test_what_a_source_lacks_leaves_rules_unchecked_rather_than_unbroken():
    entries = platoon()
    change(entries, 10, [30, 31], ahead=1.5)
    whole = scene_of(entries, ROAD)
    lacking = find_lacking(whole.vehicles, facts(columns_missing=["leader_id", "lane"], lane_markings_m=None))
    lacking -= {"length_range_m", "width_range_m"}
    assert lacking == {"leader_id", "lane", "lane_markings_m"}
    without = whole.tracks.with_columns(leader_id=pl.lit(None, pl.Int32), lane=pl.lit(None, pl.Int16))
    judged = judge(Scene(without, whole.vehicles, 10.0), lacking, rules=JUDGED)
    unchecked = [
        *("negative_headway_recorded", "lane_flicker", "leader_mismatch", "headway_mismatch", "outside_lane"),
        *("track_fragment", "cross_section_flow"),
    ]
    assert judged.subset_scores["cross_sections"].to_list() == [None]
    assert [rule.name for rule in judged.unchecked] == unchecked
    assert judged.subset_scores["rules_unchecked"].to_list() == [unchecked]
    assert judged.subset_scores["spacings"].to_list() == [0]
    assert judged.subset_scores["spacing_rms_m"].to_list() == [None]
    assert set(judged.findings["rule"]) == {"negative_headway", "overlap", "speed_mismatch"}


def test_headings_that_a_source_lacks_leave_one_rule_unchecked_and_overlaps_judged():
    whole = scene_of(platoon(), ROAD)
    tracks = whole.tracks.with_columns(heading_rad=pl.lit(None, pl.Float32))
    judged = judge(Scene(tracks, whole.vehicles, 10.0, ROAD.markings))
    assert [rule.name for rule in judged.unchecked] == ["heading_motion_mismatch"]


def test_vehicles_of_unknown_size_leave_the_rules_about_size_unchecked():
    whole = scene_of(platoon(), ROAD)
    blank = whole.vehicles.with_columns(
        length_m=pl.lit(None, pl.Float32), width_m=pl.lit(None, pl.Float32), **{"class": pl.lit(None, pl.String)}
    )
    lacking = find_lacking(blank, facts(lane_markings_m=[0.0, 4.0]))
    assert lacking == {"length_m", "width_m", "class", "length_range_m", "width_range_m"}
    judged = judge(Scene(whole.tracks, blank, 10.0, ROAD.markings), lacking, rules=JUDGED)
    assert {rule.name for rule in judged.unchecked} == {
        "negative_headway_recorded",
        "overlap",
        "headway_mismatch",
        "implausible_size",
        "outside_lane",
        "duplicate_track",
        "size_change",
    }


def test_thresholds_reach_the_findings():
    entries = platoon()
    change(entries, 2, [10], accel=3.5)
    scene = scene_of(entries, ROAD)
    assert set(judge(scene).findings["rule"]) == {"high_acceleration", "high_jerk", "acceleration_bound"}
    looser = {"high_acceleration_mps2": 3.5, "high_jerk_mps3": 30.0, "acceleration_bound_car_at_rest_mps2": 5.5}
    assert judge(scene, thresholds=looser).findings.is_empty()
    with pytest.raises(ThresholdError):
        judge(scene, thresholds={"no_such": 1.0})


def test_tracks_out_of_order_are_refused():
    scene = scene_of(platoon(), ROAD)
    for tracks in (scene.tracks.reverse(), scene.tracks.sort("frame"), pl.concat([scene.tracks[:5], scene.tracks])):
        with pytest.raises(SubsetOrderError):
            judge(Scene(tracks, scene.vehicles, 10.0))


def test_the_columns_needed_are_those_of_tracks():
    assert set(tracks_needed()) <= set(TRACKS.dtypes)


def test_scores_by_hand():
    entries = platoon()
    # An error in 2 of 40 entries of 2 vehicles and 4 warnings of 10 (two of them in the entries of the error).
    change(entries, 10, [30, 31], ahead=1.5)
    judged = judge(scene_of(entries, ROAD))
    scores = VEHICLE_SCORES.validate(judged.vehicle_scores, where="01-upper")
    assert scores["entries"].to_list() == [40] * 11
    shares = {vehicle: shares for vehicle, *shares in scores.drop("dataset", "subset", "entries").iter_rows()}
    assert shares[9] == [38 / 40, 38 / 40, 0]
    assert shares[10] == [38 / 40, 36 / 40, 0]
    assert all(shares[vehicle] == [1, 1, 0] for vehicle in shares if vehicle not in (9, 10))
    row = SUBSET_SCORES.validate(judged.subset_scores, where="01-upper").row(0, named=True)
    assert row["entries"] == 440
    assert row["share_without_error"] == pytest.approx(436 / 440)
    assert row["share_without_warning"] == pytest.approx(434 / 440)
    assert row["vehicles_without_error"] == row["vehicles_without_warning"] == pytest.approx(9 / 11)
    # Four entries differ by 7.5 m/s; 38 of the 40 of each of 11 vehicles can be compared.
    assert row["speed_rms_mps"] == pytest.approx((4 * 7.5**2 / (38 * 11)) ** 0.5)
    assert row["accel_rms_mps2"] == row["high_jerk_share"] == row["worst_jerk_mps3"] == row["jerk_flicker_share"] == 0
    # 7 + 2 vehicles have a leader; 10 is 1.5 m nearer to its leader, and 11's leader is as much farther ahead.
    assert row["spacings"] == 9 * 40
    assert row["spacing_rms_m"] == pytest.approx((4 * 1.5**2 / 360) ** 0.5)
    assert row["rules_unchecked"] == []
