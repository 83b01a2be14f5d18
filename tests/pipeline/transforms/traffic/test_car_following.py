"""Episodes of car following: where they begin and end and why, regimes, and what is left out."""

from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from traffic_scenes import complete, draw_rows, drive, make_scene

from tracklake.pipeline.transforms.traffic.car_following import classify_regimes, find_episodes
from tracklake.schemas import CAR_FOLLOWING
from tracklake.schemas.traffic import REGIMES


def find(rows, *, min_s=0.0, **scene):
    episodes, skipped = find_episodes(make_scene(rows, **scene), min_s=min_s)
    return complete(episodes, CAR_FOLLOWING).to_dicts(), {name: count for name, count in skipped.items() if count}


def test_an_episode_is_measured():
    """The follower comes 1 m closer in every frame of 0.1 s: gaps 26, 25, 24 m; 26 m / (10 m/s) at first."""
    rows = drive(1, range(3), 50, 10) + drive(2, range(3), 20, 20, leader_id=1, accel_mps2=-1.0)
    (episode,), skipped = find(rows)
    expected = {
        "vehicle_id": 2, "leader_id": 1, "lane": 1, "first_frame": 0, "last_frame": 2, "entries": 3, "seconds": 0.2,
        "begins_by": "view", "ends_by": "view", "cut_in": False, "cut_out": False, "decelerating_share": 1.0,
        "mean_speed_mps": 20.0, "mean_gap_m": 25.0, "least_gap_m": 24.0, "least_ttc_s": 2.4,
    }  # fmt: skip
    assert {name: episode[name] for name in expected} == pytest.approx(expected)
    assert skipped == {}


def test_a_vehicle_that_cuts_in_ends_an_episode_and_begins_two():
    """Vehicle 3 changes from lane 2 between 1 and 2 at frame 4 and leaves again at frame 8."""
    frames = range(12)
    lane = lambda frame: 1 if 4 <= frame < 8 else 2  # noqa: E731  (a column as a function of the frame)
    rows = drive(1, frames, 90, 20) + drive(
        3, frames, 60, 20, lane=lane, leader_id=lambda f: 1 if lane(f) == 1 else None
    )
    rows += drive(2, frames, 20, 20, leader_id=lambda frame: 3 if lane(frame) == 1 else 1)
    episodes, _ = find(rows)
    found = [
        (e["vehicle_id"], e["leader_id"], e["first_frame"], e["last_frame"], e["begins_by"], e["ends_by"])
        for e in episodes
    ]
    assert found == [
        (2, 1, 0, 3, "view", "cut_in"),
        (2, 3, 4, 7, "cut_in", "leader_left"),
        (2, 1, 8, 11, "leader_left", "view"),
        (3, 1, 4, 7, "lane_change", "lane_change"),
    ]
    assert [(e["cut_in"], e["cut_out"]) for e in episodes] == [
        (True, False),
        (True, True),
        (False, True),
        (False, False),
    ]


def test_gaps_of_either_track_and_other_names_divide_episodes():
    whole = range(10)
    follower = drive(2, [0, 1, 2, 4, 5, 6, 7, 8, 9], 0, 10, leader_id=lambda frame: None if frame == 8 else 1)
    leader = drive(1, [0, 1, 2, 3, 4, 5, 7, 8, 9], 50, 10)
    episodes, skipped = find(leader + follower)
    found = [(e["first_frame"], e["last_frame"], e["begins_by"], e["ends_by"]) for e in episodes]
    assert found == [
        (0, 2, "view", "view"), (4, 5, "view", "view"), (7, 7, "view", "renamed"), (9, 9, "renamed", "view"),
    ]  # fmt: skip
    assert skipped == {"leader_absent": 1}
    assert find(leader + follower, min_s=0.15)[1]["short_episode"] == 3
    assert find(drive(1, whole, 0, 10))[1] == {"no_leader_known": 10}


def test_leaders_in_other_lanes_and_entries_without_lane_are_counted():
    rows = drive(1, range(4), 50, 10, lane=2) + drive(2, range(4), 0, 10, leader_id=1, lane=lambda f: None if f else 1)
    assert find(rows) == ([], {"no_lane": 3, "leader_in_other_lane": 1})


def test_without_lengths_and_accelerations_values_are_null_and_regimes_unknown():
    rows = drive(1, range(3), 50, 10) + drive(2, range(3), 0, 10, leader_id=1, accel_mps2=None)
    ((episode,), _) = find(rows, lengths={1: None})
    assert [episode[name] for name in ("mean_gap_m", "least_gap_m", "least_ttc_s", "following_share")] == [None] * 4


@pytest.mark.parametrize(
    ("speed_mps", "accel_mps2", "spacing_m", "regime"),
    [
        (0.1, -3.0, 5.0, "standing"), (0.0, np.nan, 5.0, "standing"), (20.0, 0.2, 121.0, "cruising"),
        (20.0, 0.21, 121.0, "free_acceleration"), (20.0, 0.2, 120.0, "following"), (20.0, 0.21, 120.0, "accelerating"),
        (20.0, -0.21, 121.0, "decelerating"), (20.0, -0.2, 30.0, "following"), (20.0, np.nan, 30.0, None),
        (-3.0, 1.0, 30.0, "standing"),
    ],
)  # fmt: skip
def test_regimes_have_their_bounds(speed_mps, accel_mps2, spacing_m, regime):
    """Free is a time headway above 6 s: 120 m at 20 m/s."""
    (number,) = classify_regimes(*(np.array([value]) for value in (speed_mps, accel_mps2, spacing_m)))
    assert number == (-1 if regime is None else REGIMES.index(regime))


def slow_episodes(tracks):
    """The rule, entry by entry: vehicle, leader, lane, first and last frame."""
    by_key = {(row["vehicle_id"], row["frame"]): row for row in tracks.to_dicts()}
    runs = []
    for row in tracks.to_dicts():
        leader = by_key.get((row["leader_id"], row["frame"]))
        if leader is None or row["lane"] is None or leader["lane"] != row["lane"]:
            continue
        who = (row["vehicle_id"], row["leader_id"], row["lane"])
        if runs and runs[-1][0] == who and runs[-1][2] == row["frame"] - 1:
            runs[-1][2] = row["frame"]
        else:
            runs.append([who, row["frame"], row["frame"]])
    return [(*who, first, last) for who, first, last in runs]


@settings(max_examples=50)
@given(draw_rows())
def test_any_scene_gives_what_a_loop_gives(rows):
    scene = make_scene(rows)
    episodes, skipped = find_episodes(scene, min_s=0.0)
    episodes = complete(episodes, CAR_FOLLOWING)
    columns = ("vehicle_id", "leader_id", "lane", "first_frame", "last_frame")
    assert episodes.select(columns).rows() == slow_episodes(scene.tracks)
    shares = episodes.select(pl.sum_horizontal(f"{regime}_share" for regime in REGIMES).alias("all"))["all"]
    known = episodes["standing_share"].is_not_null()
    assert shares.filter(known).to_list() == pytest.approx([1.0] * known.sum())
    followed = sum(row["leader_id"] is not None for row in rows)
    left_out = skipped["leader_absent"] + skipped["leader_in_other_lane"]
    without_lane = sum(row["leader_id"] is not None and row["lane"] is None for row in rows)
    assert episodes["entries"].sum() + left_out + without_lane == followed
    ends = episodes.select("vehicle_id", "first_frame", "last_frame").rows()
    assert all(one[0] != other[0] or one[2] < other[1] for one, other in pairwise(ends))


def test_no_tracks_give_no_episodes():
    assert find([]) == ([], {})
