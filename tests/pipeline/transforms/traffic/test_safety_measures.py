"""Time to collision, deceleration to avoid a crash, time headway and post-encroachment time, by runs of entries."""

import pytest
from hypothesis import given, settings
from traffic_scenes import complete, draw_rows, drive, make_scene

from tracklake.pipeline.transforms.traffic.lane_changes import find_lane_changes
from tracklake.pipeline.transforms.traffic.safety import find_exposures
from tracklake.schemas import SAFETY
from tracklake.schemas.traffic import SAFETY_THRESHOLDS


def find(rows, thresholds=SAFETY_THRESHOLDS, **arguments):
    scene = make_scene(rows, **arguments)
    found, skipped = find_exposures(scene, find_lane_changes(scene, lateral_mps=0.2)[0], thresholds=thresholds)
    return complete(found, SAFETY).to_dicts(), {name: count for name, count in skipped.items() if count}


def test_runs_have_frames_seconds_and_the_worst_value():
    """Closing at 10 m/s from a gap of 16 m: 1.6 s, 1.5 s, then 1.4 s. DRAC = 100 / (2 * 14); headway 18 m / 20 m/s."""
    rows = drive(1, range(3), 40, 10) + drive(2, range(3), 20, 20, leader_id=1)
    runs, skipped = find(rows)
    found = {run["measure"]: (run["first_frame"], run["last_frame"], run["entries"], run["worst"]) for run in runs}
    assert found == {
        "ttc_s": (2, 2, 1, pytest.approx(1.4)),
        "drac_mps2": (2, 2, 1, pytest.approx(100 / 28)),
        "time_headway_s": (1, 2, 2, pytest.approx(0.9)),
    }
    assert {run["seconds"] for run in runs} == {0.1, 0.2}
    assert skipped == {}


def test_overlaps_and_leaders_behind_have_no_measure():
    rows = drive(1, range(3), 3, 10) + drive(2, range(3), 0, 20, leader_id=1)
    assert [run["measure"] for run in find(rows)[0]] == ["time_headway_s"], "3 m ahead and 4 m long"
    assert find(drive(1, range(3), -3, 10) + drive(2, range(3), 0, 20, leader_id=1))[0] == []


def test_what_has_no_value_is_counted():
    rows = drive(1, range(3), 50, 10, lane=lambda frame: 2 if frame == 2 else 1)
    rows += drive(2, range(4), 20, 20, leader_id=1)
    assert find(rows, lengths={1: None})[1] == {"leader_absent": 1, "leader_in_other_lane": 1, "no_gap": 2}
    assert find(drive(2, range(4), 20, 20))[1] == {"no_leader_known": 4}


def make_change():
    """Vehicle 1 enters lane 2 at frame 10 with its front at 100 m, between vehicles 2 and 3, all at 20 m/s, 4 m long.

    The rear of 2 is 10 m ahead of the front of 1: it left that place 0.5 s before. The front of 3 is 5 m behind the
    rear of 1, and reaches that place 0.25 s later.
    """
    frames = range(30)
    rows = drive(1, frames, 80, 20, lane=lambda frame: 1 if frame < 10 else 2)
    for row in rows:
        row |= {"leader_id": 2, "follower_id": 3} if row["frame"] >= 10 else {}
    return rows + drive(2, frames, 94, 20, lane=2) + drive(3, frames, 71, 20, lane=2)


def test_the_post_encroachment_times_of_a_lane_change():
    runs = [run for run in find(make_change())[0] if run["measure"] == "pet_s"]
    assert [(run["vehicle_id"], run["leader_id"], run["first_frame"], run["last_frame"]) for run in runs] == [
        (1, 2, 10, 10),
        (3, 1, 10, 10),
    ]
    assert [run["worst"] for run in runs] == pytest.approx([0.5, 0.25])
    few = find(make_change(), {**SAFETY_THRESHOLDS, "pet_s": 0.3})[0]
    assert [run["vehicle_id"] for run in few if run["measure"] == "pet_s"] == [3]


def test_a_gap_in_the_track_of_the_other_ends_the_search():
    rows = [row for row in make_change() if (row["vehicle_id"], row["frame"]) not in {(2, 6), (3, 12)}]
    assert [run["worst"] for run in find(rows)[0] if run["measure"] == "pet_s"] == []


def slow_runs(tracks, lengths, thresholds):
    """Every entry's values, then runs, one entry after the other; without post-encroachment times."""
    entries = {(row["vehicle_id"], row["frame"]): row for row in tracks.to_dicts()}
    runs = []
    for measure in ("ttc_s", "drac_mps2", "time_headway_s"):
        for row in tracks.to_dicts():
            leader = entries.get((row["leader_id"], row["frame"]))
            if leader is None or (None not in (row["lane"], leader["lane"]) and row["lane"] != leader["lane"]):
                continue
            spacing = leader["x_m"] - row["x_m"]
            gap, closing, speed = spacing - lengths, row["speed_mps"] - leader["speed_mps"], row["speed_mps"]
            gap = round(gap, 3)
            value = {
                "ttc_s": gap / closing if gap >= 0 and closing > 0 else None,
                "drac_mps2": closing**2 / (2 * gap) if gap > 0 and closing > 0 else None,
                "time_headway_s": spacing / speed if spacing > 0 and speed > 0 else None,
            }[measure]
            sign = -1 if measure == "drac_mps2" else 1
            if value is None or sign * value >= sign * thresholds[measure]:
                continue
            who = (row["vehicle_id"], row["leader_id"], measure)
            if runs and runs[-1][0] == who and runs[-1][2] == row["frame"] - 1:
                runs[-1][2] = row["frame"]
                runs[-1][3] = sign * min(sign * runs[-1][3], sign * value)
            else:
                runs.append([who, row["frame"], row["frame"], value])
    return sorted((*who, first, last, worst) for who, first, last, worst in runs)


@settings(max_examples=50)
@given(draw_rows())
def test_any_scene_gives_what_a_loop_gives(rows):
    scene = make_scene(rows)
    runs = [run for run in find(rows)[0] if run["measure"] != "pet_s"]
    names = ("vehicle_id", "leader_id", "measure", "first_frame", "last_frame", "worst")
    found = [tuple(run[name] for name in names) for run in runs]
    expected = slow_runs(scene.tracks, 4.0, SAFETY_THRESHOLDS)
    assert [run[:-1] for run in found] == [run[:-1] for run in expected]
    assert [run[-1] for run in found] == pytest.approx([run[-1] for run in expected], rel=1e-5)


def test_no_tracks_give_no_runs():
    assert find([]) == ([], {})
