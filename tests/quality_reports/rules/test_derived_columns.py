"""Derived columns against numbers worked out by hand, and the order that they rely on."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rule_scenes import ANY_SURFACE, change, driver, scene_of

from tracklake.pipeline.synthetic.scenery import Surface
from tracklake.quality_reports.rules import within_frames
from tracklake.quality_reports.rules.derived import DERIVED, prepare, trace
from tracklake.quality_reports.rules.scene import ABSENT

HALF_TICKS = Surface(rate_hz=25.0)


def accelerations(values: list[float], surface: Surface = ANY_SURFACE, missing: tuple[int, ...] = ()):
    entries = driver(1, range(1, len(values) + 1), x=0.0)
    for frame, value in enumerate(values, start=1):
        change(entries, 1, [frame], accel=value)
    for frame in missing:
        del entries[1, frame]
    return scene_of(entries, surface)


def column(scene, name: str) -> list:
    return prepare(scene, [name])[name].to_list()


def test_jumps_compare_with_the_mean_of_both_speeds():
    entries = driver(1, range(1, 5), x=0.0, speed=20.0)
    change(entries, 1, [2], speed=10.0)
    change(entries, 1, [4], ahead=-5.0)
    # 2 - (20 + 10) / 2 / 10, the same, and 2 - 5 - 2.
    assert column(scene_of(entries), "jump_m") == [None, 0.5, 0.5, 5.0]


def test_frame_gaps_are_charged_to_the_entry_behind_and_end_what_is_compared():
    entries = driver(1, range(1, 8), x=0.0) | driver(2, range(3, 5), x=50.0)
    for frame in (3, 4, 5):
        del entries[1, frame]
    scene = scene_of(entries)
    assert column(scene, "frames_skipped") == [0, 0, 3, 0, 0, 0]
    assert column(scene, "jump_m") == [None, 0.0, None, 0.0, None, 0.0]
    assert scene.age.tolist() == [0, 1, 0, 1, 0, 1]


def test_jerk_at_10_hz_is_the_change_to_the_frame_before():
    assert column(accelerations([0.0, 1.5, 1.5, 0.5]), "jerk_mps3") == [None, 15.0, 0.0, -10.0]
    assert column(accelerations([0.0, 1.5, 1.5, 0.5], missing=(2,)), "jerk_mps3") == [None, None, -10.0]


def test_jerk_at_25_hz_lies_between_two_frames():
    # 0.1 s is 2.5 frames: 0.9 - (0.2 + 0.1) / 2 = 0.75 for the fifth, from the second and third.
    scene = accelerations([0.0, 0.1, 0.2, 0.3, 0.9], HALF_TICKS)
    # The fourth: 0.3 - (0.1 + 0.0) / 2 = 0.25.
    assert column(scene, "jerk_mps3") == [None, None, None, 2.5, 7.5]


def test_a_slow_camera_has_no_jerk():
    scene = accelerations([0.0, 1.5], Surface(rate_hz=12.0))
    assert column(scene, "jerk_mps3") == [None, None]
    assert column(scene, "jerk_reversals") == [0, 0]


@pytest.mark.parametrize(
    ("accels", "last"),
    [
        ([0, 1, 2, 3], 0),
        ([0, 1, 0, 1], 2),
        ([0, 1, 1, 0], 1),  # +, 0, -: one change
        ([0, 1, 1, 2], 0),  # +, 0, +: none
        ([0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0], 9),
        ([0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1], 9),  # ten jerks make one second
        ([1.01, 1.02, 1.01], 1),
    ],
)
def test_reversals_of_jerk_within_a_second(accels, last):
    assert column(accelerations([float(each) for each in accels]), "jerk_reversals")[-1] == last


def test_reversals_do_not_reach_over_a_frame_gap():
    scene = accelerations([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], missing=(4,))
    assert column(scene, "jerk_reversals") == [0, 0, 1, 0, 0]


def test_reversals_at_25_hz_are_counted_on_ticks():
    # At frames 1, 6, 11 (every second tick) 0, 1, 0; linear in between, so that the jerk changes its sign once.
    values = [step / 5 if step <= 5 else (10 - step) / 5 for step in range(11)]
    assert column(accelerations(values, HALF_TICKS), "jerk_reversals")[-1] == 1


def test_a_reversal_of_jerk_is_an_entry_whose_sign_is_another_than_the_last():
    # Jerks: none, +, -, 0, -, +: the change from - over 0 to - is none.
    scene = accelerations([0.0, 1.0, 0.0, 0.0, -1.0, 0.0])
    assert column(scene, "jerk_reverses") == [None, False, True, False, False, True]
    gap = accelerations([0.0, 1.0, 0.0, 0.0, -1.0, 0.0], missing=(3,))
    assert column(gap, "jerk_reverses") == [None, False, None, False, True]
    assert column(accelerations([0.0, 1.0], Surface(rate_hz=12.0)), "jerk_reverses") == [None, None]


def test_lateral_acceleration_is_the_change_of_the_lateral_speed_in_a_tenth_of_a_second():
    entries = driver(1, range(1, 6), x=0.0, lateral=0.0)
    change(entries, 1, [3], lateral=0.5)
    change(entries, 1, [5], lateral=-0.2)
    assert column(scene_of(entries), "lateral_accel_mps2") == [None, 0.0, 5.0, -5.0, -2.0]
    # At 25 Hz 0.1 s before is between the second and the third frame before: 0.0 - (0.5 + 0.0) / 2 in the fifth.
    assert column(scene_of(entries, HALF_TICKS), "lateral_accel_mps2") == [None, None, None, 0.0, -4.5]


def test_headings_are_compared_with_the_direction_of_both_speeds():
    entries = driver(1, range(1, 4), x=0.0, speed=10.0, lateral=0.0)
    change(entries, 1, [1], lateral=10.0)
    change(entries, 1, [2], heading=-0.25)
    errors = column(scene_of(entries), "heading_error_rad")
    assert errors == [round(math.pi / 4, 4), 0.25, 0.0]
    without = scene_of(entries)
    tracks = without.tracks.with_columns(heading_rad=pl.lit(None, pl.Float32))
    assert column(type(without)(tracks, without.vehicles, 10.0), "heading_error_rad") == [None] * 3


def test_two_tracks_in_one_place_are_counted_over_all_their_frames():
    entries = driver(1, range(1, 9), x=100.0) | driver(2, range(1, 9), x=101.0) | driver(3, range(1, 9), x=104.0)
    change(entries, 2, [3, 4], ahead=2.0)
    # 4 m of 5 m are shared by 1 and 2; in frames 3 and 4 it is 2 m, and 4 m by 2 and 3, who share 2 m else.
    one, two = [0.6] * 2 + [0.0] * 2 + [0.6] * 4, [0.6] * 2 + [0.2] * 2 + [0.6] * 4
    assert column(scene_of(entries), "double_track_s") == [*one, *two, *[0.0] * 2, 0.2, 0.2, *[0.0] * 4]
    # A small box is nearly all inside a large one: 2 m of 2.5 m by 1.8 m of 2 m.
    entries = driver(1, range(1, 2), x=100.0, length=10.0) | driver(2, range(1, 2), x=100.5, y=2.2, length=2.5)
    assert column(scene_of(entries), "double_track_s") == [0.1, 0.1]


def test_lane_stays_are_between_the_same_lane_and_seen_from_both_sides():
    entries = driver(1, range(1, 11), x=0.0)
    change(entries, 1, [3, 4, 5], lane=2)
    change(entries, 1, [8, 9], lane=3)
    change(entries, 1, [10], lane=2)
    # 1 1 2 2 2 1 1 3 3 2: three entries of lane 2 lie between lane 1, nothing else does.
    stays = column(scene_of(entries), "lane_stay_s")
    assert stays == [None, None, 0.3, 0.3, 0.3, None, None, None, None, None]
    del entries[1, 4]
    assert column(scene_of(entries), "lane_stay_s") == [None] * 9


def test_overlap_is_the_least_way_to_be_clear():
    entries = driver(1, range(1, 2), x=100.0) | driver(2, range(1, 2), x=95.0) | driver(3, range(1, 2), x=60.0)
    assert column(scene_of(entries), "overlap_m") == [0.0, 0.0, 0.0], "touching is not overlapping"
    change(entries, 2, [1], ahead=0.25)
    assert column(scene_of(entries), "overlap_m") == [0.25, 0.25, 0.0]
    # Side by side, 2 m wide each and 1.9 m apart: 0.1 m across, however long they are.
    change(entries, 2, [1], ahead=4.0, y=3.9)
    assert column(scene_of(entries), "overlap_m") == [0.1, 0.1, 0.0]
    change(entries, 2, [1], y=3.99)
    assert column(scene_of(entries), "overlap_m") == [0.01, 0.01, 0.0]
    change(entries, 2, [1], y=4.0)
    assert column(scene_of(entries), "overlap_m") == [0.0, 0.0, 0.0]
    change(entries, 2, [1], y=3.9)
    # A third one, whatever its lane, deeper in the first.
    change(entries, 3, [1], ahead=37.0, lane=2)
    assert column(scene_of(entries), "overlap_m") == [2.0, 0.1, 2.0]


def test_boxes_point_where_their_vehicles_do():
    """Squares of 2 m, middles 2.2 m apart; one stands on its corner, which reaches 2^0.5 m from its middle."""
    quarter = math.pi / 4
    entries = driver(1, range(1, 2), x=101.0, length=2.0)
    entries |= driver(2, range(1, 2), x=103.2, length=2.0)
    assert column(scene_of(entries), "overlap_m") == [0.0, 0.0]
    nose = math.cos(quarter)
    entries |= driver(2, range(1, 2), x=102.2 + nose, length=2.0, y=2 + nose, heading=quarter)
    assert column(scene_of(entries), "overlap_m") == [0.214, 0.214], "1 + 2^0.5 - 2.2"
    # Two cars of 5 m, fronts 2.05 m apart: heading the same way or towards each other they are clear, and where they
    # head apart, their tails, 2 * 5 sin(0.1) = 1 m nearer, meet.
    for one, other, meets in ((0.1, 0.1, False), (0.1, -0.1, False), (-0.1, 0.1, True)):
        entries = driver(1, range(1, 2), x=50.0, heading=one) | driver(2, range(1, 2), x=50.0, y=4.05, heading=other)
        assert [depth > 0 for depth in column(scene_of(entries), "overlap_m")] == [meets, meets]


def test_a_long_vehicle_overlaps_those_far_behind_its_front():
    entries = driver(1, range(1, 2), x=100.0, length=20.0)
    for vehicle, x in ((2, 99.0), (3, 90.0), (4, 81.0), (5, 80.0)):
        entries |= driver(vehicle, range(1, 2), x=x, y=2.5, length=1.0)
    # The first reaches back to 80 m: 5 touches it; 4 is 1 m inside, but may also leave to the side: 2 m - 0.5 m.
    assert column(scene_of(entries), "overlap_m") == [1.5, 1.5, 1.5, 1.0, 0.0]


def test_vehicles_of_unknown_size_are_passed_over():
    scene = scene_of(driver(1, range(1, 2), x=100.0) | driver(2, range(1, 2), x=99.0) | driver(3, range(1, 2), x=98.0))
    some = pl.when(pl.col("vehicle_id") != 2).then(pl.col("width_m"))
    scene = type(scene)(scene.tracks, scene.vehicles.with_columns(width_m=some), 10.0)
    assert column(scene, "overlap_m") == [2.0, None, 2.0]
    scene = type(scene)(scene.tracks, scene.vehicles.filter(pl.col("vehicle_id") == 1), 10.0)
    assert column(scene, "overlap_m") == [0.0, None, None]


def test_the_nearest_ahead_is_in_the_lane_and_not_abreast():
    entries = {}
    for vehicle, x, lane in ((1, 50.0, 1), (2, 50.0, 1), (3, 70.0, 2), (4, 80.0, 1), (5, 50.0, 1)):
        entries |= driver(vehicle, range(1, 2), x=x, lane=lane)
    assert column(scene_of(entries), "nearest_ahead_m") == [30.0, 30.0, None, None, 30.0]


def test_leaders_are_looked_up_in_their_own_frame_across_gaps():
    entries = driver(1, range(5, 15), x=100.0) | driver(2, range(1, 15), x=0.0, leader=1, headway=60.0)
    for frame in (7, 8):
        del entries[1, frame]
    change(entries, 2, [14], leader=99)
    scene = scene_of(entries)
    # 1 enters at 100 m in frame 5, when 2 has come to 8 m; it is not seen before, in 7 and 8, and 99 never is.
    expected = [None] * 4 + [92.0, 92.0, None, None] + [92.0] * 5 + [None]
    assert column(scene, "leader_ahead_m")[8:] == expected
    assert column(scene, "leader_in_lane")[8:] == [None if each is None else 1.0 for each in expected]
    assert (scene.leader[:8] == ABSENT).all()


@pytest.mark.parametrize("from_fronts", [True, False])
def test_whether_headways_count_from_fronts_is_read_off_the_positions(from_fronts):
    # 20 m from front to front and 15 m from bumper to bumper; one entry says 0.5 m less.
    entries = driver(1, range(1, 12), x=120.0)
    entries |= driver(2, range(1, 12), x=100.0, leader=1, headway=20.0 if from_fronts else 15.0)
    change(entries, 2, [4], headway=19.5 if from_fronts else 14.5)
    gaps = column(scene_of(entries), "recorded_gap_m")[11:]
    assert gaps == [15.0, 15.0, 15.0, 14.5, *[15.0] * 7]


def test_without_positions_headways_count_from_fronts():
    entries = driver(1, range(1, 2), x=100.0) | driver(2, range(5, 6), x=100.0, leader=1, headway=3.0)
    assert column(scene_of(entries, Surface(headway_stands_in=False)), "recorded_gap_m") == [None, -2.0]


def test_the_way_out_of_a_lane():
    road = Surface(markings=(0.0, 4.0, 8.0))
    entries = driver(1, range(1, 8), x=0.0)
    for frame, (y, lane) in enumerate(((2, 1), (4, 1), (4.25, 1), (3.9, 2), (8, 2), (-0.5, 1), (9, 3)), start=1):
        change(entries, 1, [frame], y=float(y), lane=lane)
    assert column(scene_of(entries, road), "out_of_lane_m") == [0.0, 0.0, 0.25, 0.1, 0.0, 0.5, None]
    assert column(scene_of(entries), "out_of_lane_m") == [None] * 7
    # The front has crossed the marking and the middle, 2.5 m behind, has not: 4.2 - 2.5 sin(0.1) = 3.950.
    change(entries, 1, [1], y=4.2, heading=0.1)
    assert column(scene_of(entries, road), "out_of_lane_m")[0] == 0.0
    change(entries, 1, [1], heading=-0.1)
    assert column(scene_of(entries, road), "out_of_lane_m")[0] == 0.45


@pytest.mark.parametrize("name", sorted(DERIVED))
def test_every_derived_column_has_a_value_per_entry_and_leaves_the_others(name):
    scene = scene_of(driver(2**31 - 1, range(1, 4), x=0.0) | driver(0, range(2, 3), x=9.0, leader=2**31 - 1))
    prepared = prepare(scene, [name])
    assert prepared.drop(name).equals(scene.tracks)
    assert prepared.height == 4
    empty = type(scene)(scene.tracks.clear(), scene.vehicles.clear(), 25.0, (0.0, 4.0))
    assert prepare(empty, [name]).schema == prepared.schema


def test_trace_leads_to_what_is_stored():
    assert trace(["speed_mps", "overlap_m", "length_m"]) == (
        "speed_mps", "vehicle_id", "frame", "x_m", "y_m", "heading_rad", "length_m", "width_m",
    )  # fmt: skip


@settings(max_examples=35, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.sampled_from([-(2**31), -1, 0, 3, 2**31 - 1]) | st.integers(-9, 9)] * 2, st.integers()),
        max_size=30,
    )
)
def test_rows_are_sorted_however_wide_the_keys(rows):
    rows = [(a, b, max(-(2**62), min(c, 2**62))) for a, b, c in rows]
    keys = [np.array([row[place] for row in rows], np.int64) for place in range(3)]
    order = within_frames.sort_rows(*keys)
    assert [rows[place] for place in order] == sorted(rows)
    assert sorted(order.tolist()) == list(range(len(rows)))
