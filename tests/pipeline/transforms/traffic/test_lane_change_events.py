"""Lane changes as events: crossings, lane flicker, begin and end of the lateral motion, gaps in the target lane."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from traffic_scenes import complete, draw_rows, drive, make_scene

from tracklake.pipeline.transforms.traffic.lane_changes import find_lane_changes
from tracklake.schemas import LANE_CHANGE_EVENTS


def find(rows, *, lateral_mps=0.2, **scene):
    events, skipped = find_lane_changes(make_scene(rows, **scene), lateral_mps=lateral_mps)
    return complete(events, LANE_CHANGE_EVENTS).to_dicts(), {name: count for name, count in skipped.items() if count}


def glide(vehicle, frames, *, begins, ends, rate_hz, **columns):
    """A vehicle that moves 3.5 m to the right from frame `begins` to `ends` and crosses half-way."""
    across = lambda frame: float(np.clip((frame - begins) / (ends - begins), 0, 1))  # noqa: E731  (a column as a function of the frame)
    lane = lambda frame: 2 if across(frame) > 0.5 else 1  # noqa: E731  (a column as a function of the frame)
    return drive(
        vehicle, frames, 0, 20, rate_hz=rate_hz, y_m=lambda f: 2 + 3.5 * across(f), lane=lane, **columns
    )  # fmt: skip


@pytest.mark.parametrize("rate_hz", [10.0, 25.0])
def test_the_motion_begins_and_ends_with_the_lateral_speed(rate_hz):
    """3.5 m within 4 s are 0.875 m/s. The speed over 1 s is below 0.2 m/s where less than 0.2 m are moved.

    0.2 m take 0.23 s, so that is 0.5 - 0.23 = 0.27 s outside the motion.
    """
    second = round(rate_hz)
    begins, ends = 5 * second, 9 * second
    ((event,), skipped) = find(glide(1, range(14 * second), begins=begins, ends=ends, rate_hz=rate_hz), rate_hz=rate_hz)
    assert skipped == {}
    assert event["crossing_frame"] == 7 * second + 1
    assert event["first_frame"] == pytest.approx(begins - 0.27 * rate_hz, abs=1)
    assert event["last_frame"] == pytest.approx(ends + 0.27 * rate_hz, abs=1)
    assert event["seconds"] == pytest.approx(4.54, abs=2 / rate_hz)
    assert (event["begin_seen"], event["end_seen"], event["direction"]) == (True, True, "right")
    assert event["lateral_move_m"] == pytest.approx(3.5)
    assert event["greatest_lateral_speed_mps"] == pytest.approx(0.875)


def test_a_motion_at_the_end_of_a_track_has_no_seen_end():
    ((event,), _) = find(glide(1, range(60, 85), begins=50, ends=90, rate_hz=10.0))
    assert (event["begin_seen"], event["end_seen"]) == (False, False)
    assert (event["first_frame"], event["last_frame"]) == (60, 84)


def test_a_drift_slower_than_the_threshold_is_an_event_without_motion():
    ((event,), _) = find(glide(1, range(500), begins=0, ends=500, rate_hz=10.0))
    assert event["first_frame"] == event["last_frame"] == event["crossing_frame"] == 251
    assert (event["seconds"], event["begin_seen"], event["end_seen"]) == (0, False, False)


LANES = {
    "taken back within 2 s": ("1" * 30 + "2" * 20 + "1" * 30, [], 1),
    "taken back after 2.1 s": ("1" * 30 + "2" * 21 + "1" * 30, [30, 51], 0),
    "wavering, then changed": ("1" * 30 + "2" * 5 + "1" * 4 + "2" * 30, [39], 2),
    "wavering, not changed": ("1" * 30 + "2" * 5 + "1" * 4 + "2" * 3 + "1" * 30, [], 3),
    "two lanes at once": ("1" * 30 + "2" * 5 + "3" * 30, [30, 35], 0),
    "at the end of the track": ("1" * 30 + "2" * 5, [30], 0),
}


@pytest.mark.parametrize("name", LANES)
def test_flicker_is_no_lane_change(name):
    lanes, crossings, flickers = LANES[name]
    events, skipped = find(drive(1, range(len(lanes)), 0, 20, lane=lambda frame: int(lanes[frame])))
    assert [event["crossing_frame"] for event in events] == crossings
    assert skipped.get("lane_flicker", 0) == flickers


def test_changes_in_gaps_and_without_lanes_are_counted():
    frames = [*range(10), *range(12, 20)]
    lane = lambda frame: None if frame == 15 else 1 if frame < 12 else 2 if frame < 15 else 3  # noqa: E731  (a column as a function of the frame)
    assert find(drive(1, frames, 0, 20, lane=lane)) == ([], {"lane_change_in_gap": 1, "no_lane": 1})


def test_neighbors_and_gaps_at_the_crossing():
    """Front of the changer at 20 m, 4 m long; the new leader's front at 45 m (5 m long), the new follower's at 6 m."""
    rows = glide(1, range(20, 121), begins=50, ends=90, rate_hz=10.0)
    at = 71
    for row in rows:
        row |= {"leader_id": 8, "follower_id": 9} if row["frame"] < at else {"leader_id": 2, "follower_id": 3}
    x_m = next(row["x_m"] for row in rows if row["frame"] == at)
    rows += drive(2, [at], x_m + 25, 20, lane=2) + drive(3, [at], x_m - 14, 20, lane=2)
    ((event,), _) = find(rows, lengths={2: 5.0})
    names = ("old_leader_id", "old_follower_id", "new_leader_id", "new_follower_id", "lead_gap_m", "lag_gap_m")
    assert [event[name] for name in names] == pytest.approx([8, 9, 2, 3, 20.0, 10.0])
    assert event["speed_mps"] == 20


def slow_crossings(tracks):
    """Stays in lanes, one after the other, and the changes between those that are no flicker."""
    stays = []
    for row in tracks.to_dicts():
        last = stays[-1] if stays else None
        adjacent = last and last["vehicle"] == row["vehicle_id"] and last["end"] == row["frame"] - 1
        joined = adjacent and last["lane"] is not None and row["lane"] is not None
        if joined and last["lane"] == row["lane"]:
            last["end"] = row["frame"]
            continue
        piece = last["piece"] if joined else (last["piece"] + 1 if last else 0)
        stay = {"vehicle": row["vehicle_id"], "lane": row["lane"], "piece": piece}
        stays.append(stay | {"start": row["frame"], "end": row["frame"]})
    kept = []
    for number, stay in enumerate(stays):
        around = stays[number - 1 : number + 2 : 2] if 0 < number < len(stays) - 1 else []
        flicker = len({(each["piece"], each["lane"]) for each in around}) == 1 and around[0]["piece"] == stay["piece"]
        if not (flicker and (stay["end"] - stay["start"] + 1) / 10 <= 2):
            kept.append(stay)
    return [
        (one["vehicle"], one["start"], before["lane"], one["lane"])
        for before, one in pairwise(kept)
        if before["piece"] == one["piece"] and before["lane"] != one["lane"]
    ]


@settings(max_examples=50)
@given(draw_rows())
def test_any_scene_gives_what_a_loop_gives(rows):
    scene = make_scene(rows)
    events = complete(find_lane_changes(scene, lateral_mps=0.2)[0], LANE_CHANGE_EVENTS)
    found = events.select("vehicle_id", "crossing_frame", "from_lane", "to_lane").rows()
    assert found == slow_crossings(scene.tracks)
    for event in events.to_dicts():
        assert event["first_frame"] <= event["crossing_frame"] <= event["last_frame"] + 1


def test_no_tracks_give_no_events():
    assert find([]) == ([], {})
