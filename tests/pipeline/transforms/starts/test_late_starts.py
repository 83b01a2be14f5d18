"""Cut-off, late starts, the frame estimate and early vehicles."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from start_scenes import NAMES, US101, make_tracks, read_us101, summarise

from tracklake.pipeline.transforms.starts.late_starts import (
    classify_starts,
    estimate_missing_starts,
    find_cutoff,
    fit_frames,
)
from tracklake.schemas.missing_starts import MISSING_STARTS, START_CUTOFFS
from tracklake.schemas.vehicles import VEHICLE_STARTS


def classify(rows, *, frame_rate_hz=10.0, first_frame=0, on_ramp_lanes=()):
    """(vehicle_id, first_frame, last_frame, entries, start_x_m, end_x_m, start_lane) rows -> sets of ids, cut-offs."""
    schema = {
        "vehicle_id": pl.Int32,
        "first_frame": pl.Int32,
        "last_frame": pl.Int32,
        "entries": pl.Int32,
        "start_x_m": pl.Float64,
        "end_x_m": pl.Float64,
        "start_lane": pl.Int16,
    }
    starts, cutoffs = classify_starts(
        pl.DataFrame(rows, schema=schema, orient="row"),
        **NAMES,
        first_frame=first_frame,
        frame_rate_hz=frame_rate_hz,
        on_ramp_lanes=on_ramp_lanes,
    )
    VEHICLE_STARTS.validate(starts, where="test")
    START_CUTOFFS.validate(cutoffs, where="test")
    assert starts.height == len(rows)
    flags = ("eligible", "starts_late", "fully_tracked", "early")
    ids = {flag: set(starts.filter(flag)["vehicle_id"].to_list()) for flag in flags}
    row = cutoffs.row(0, named=True)
    counted = (row["eligible"], row["late"], row["fully_tracked"])
    assert counted == tuple(len(ids[flag]) for flag in flags[:3])
    return ids, row


def full(vehicle, first_frame, start_x_m, *, end_x_m=400.0, lane=1, frames=100):
    """A track without a gap."""
    return (vehicle, first_frame, first_frame + frames - 1, frames, start_x_m, end_x_m, lane)


@pytest.mark.parametrize(
    ("start_x_m", "cutoff_m"),
    [
        ([], None),
        ([-5.0], 0.0),
        ([0.0], 0.0),
        ([0.001], 2.0),
        ([2.0], 2.0),
        ([2.001], 4.0),
        ([155.5], 156.0),
        ([0.0, 0.0, 50.0], 0.0),
        ([0.0, 0.0, 2.001], 0.0),  # (0, 2] is open at 2.001
        ([0.0, 0.0, 2.0], 2.0),  # and closed at 2
        ([0.0, 0.0, 30.0, 30.0], 0.0),  # half is enough
        ([0.0, 30.0, 30.0], 30.0),  # a third is not
        ([0.0, 1.0, 3.0, 5.0, 90.0], 6.0),  # a chain without a free step of 2 m
        ([-20.0, -1.0, -0.5], 0.0),  # never below 0
    ],
)
def test_cutoff(start_x_m, cutoff_m):
    assert find_cutoff(np.array(start_x_m)) == cutoff_m


@settings(max_examples=35, deadline=None)
@given(st.lists(st.integers(-40, 400).map(lambda quarters: quarters / 4), min_size=1, max_size=30))
def test_cutoff_agrees_with_trying_one_after_the_other(start_x_m):
    c = 0.0
    while sum(x <= c for x in start_x_m) < len(start_x_m) / 2 or any(c < x <= c + 2 for x in start_x_m):
        c += 2
    assert find_cutoff(np.array(start_x_m)) == c


def test_late_and_fully_tracked():
    ids, row = classify(
        [
            full(1, 9, 200.0),  # 0.9 s: on the road already
            full(2, 10, 0.0),  # 1.0 s: eligible
            full(3, 50, 0.0),
            full(4, 60, 2.5),  # beyond c = 0, and not in (0, 2]
            (5, 70, 170, 100, 0.0, 400.0, 1),  # 101 frames, 100 entries: a gap
        ]
    )
    assert row["cutoff_m"] == 0.0
    assert ids["eligible"] == {2, 3, 4, 5}
    assert ids["starts_late"] == {4}
    assert ids["fully_tracked"] == {2, 3}
    assert ids["early"] == set()  # vehicle 1 was first seen beyond the cut-off: tracking began everywhere
    assert row["road_seen_from_frame"] is None


def test_first_second_is_counted_from_the_recordings_first_frame():
    ids, _ = classify([full(1, 25, 0.0), full(2, 26, 0.0)], first_frame=1, frame_rate_hz=25.0)
    assert ids["eligible"] == {2}


def test_a_start_on_the_cutoff_is_not_late():
    ids, row = classify([full(1, 20, 4.0), full(2, 30, 4.0), full(3, 40, 90.0)])
    assert row["cutoff_m"] == 4.0
    assert ids["starts_late"] == {3}


def test_vehicles_first_seen_on_a_ramp_neither_count_nor_are_late_nor_references():
    ids, row = classify([full(1, 20, 0.0), *(full(10 + i, 30, 150.0, lane=7) for i in range(9))], on_ramp_lanes=(7,))
    assert row["cutoff_m"] == 0.0
    assert ids["eligible"] == ids["fully_tracked"] == {1}
    assert ids["starts_late"] == set()
    ids, row = classify([full(1, 20, 0.0, lane=None), full(2, 20, 0.0, lane=7)], on_ramp_lanes=(7,))
    assert ids["eligible"] == {1}


def test_nobody_is_eligible():
    ids, row = classify([full(1, 0, 30.0), full(2, 5, 0.0), full(3, 50, 0.0, lane=7)], on_ramp_lanes=(7,))
    assert (row["cutoff_m"], row["road_seen_from_frame"]) == (None, None)
    assert all(not flagged for flagged in ids.values())
    ids, row = classify([])
    assert row["eligible"] == 0


def test_early_until_the_first_fully_tracked_vehicle_reached_the_end():
    """Tracking begins at the entrance; vehicle 2 is the first fully tracked one and ends on frame 111."""
    ids, row = classify(
        [
            full(1, 0, 0.0),
            full(2, 12, 0.0),
            full(3, 20, 0.0, frames=50),  # overtakes vehicle 2 and ends on frame 69
            full(4, 110, 0.0),
            full(5, 111, 0.0),
        ]
    )
    assert row["road_seen_from_frame"] == 111
    assert ids["early"] == {1, 2, 3, 4}


def test_early_is_not_ended_by_a_vehicle_that_left_on_the_way():
    ids, row = classify(
        [
            full(1, 12, 0.0, end_x_m=359.0, frames=30),  # 41 m before the end: left by a ramp
            full(2, 13, 0.0, end_x_m=360.0),  # 40 m before the end counts as there
            full(3, 200, 0.0),
            full(4, 210, 0.0),
            full(5, 220, 0.0),
        ]
    )
    assert row["road_seen_from_frame"] == 112
    assert ids["early"] == {1, 2}


def test_early_applies_only_where_no_track_starts_beyond_the_cutoff_within_the_first_second():
    entrance_only = [full(1, 5, 0.0), full(2, 30, 0.0), full(3, 40, 0.0)]
    assert classify(entrance_only)[1]["road_seen_from_frame"] == 129
    assert classify([*entrance_only, full(4, 9, 2.5)])[1]["road_seen_from_frame"] is None
    assert classify([*entrance_only, full(4, 10, 200.0)])[1]["road_seen_from_frame"] == 129  # late, not early
    on_ramp = [*entrance_only, full(4, 0, 200.0, lane=7)]
    assert classify(on_ramp, on_ramp_lanes=(7,))[1]["road_seen_from_frame"] == 129


def test_without_a_fully_tracked_vehicle_nobody_is_early():
    _, row = classify([(1, 20, 120, 100, 0.0, 400.0, 1)])
    assert row["road_seen_from_frame"] is None


def estimate(tracks, *, first_frame=0, frame_rate_hz=10.0):
    starts, cutoffs = classify_starts(summarise(tracks), **NAMES, first_frame=first_frame, frame_rate_hz=frame_rate_hz)
    missing = estimate_missing_starts(
        lambda: [tracks],
        starts,
        **NAMES,
        cutoff_m=cutoffs["cutoff_m"][0],
        first_frame=first_frame,
        frame_rate_hz=frame_rate_hz,
    )
    return MISSING_STARTS.validate(missing, where="test")


def steady(vehicle, first_frame, frames_per_20_m, speed_mps, *, entries=60, start_x_m=0.0):
    """A track that takes so many frames for 20 m, and records whatever speed."""
    step_m = 20 / frames_per_20_m
    return [(vehicle, first_frame + i, start_x_m + i * step_m, 1, speed_mps) for i in range(entries)]


def test_frames_are_fitted_against_speed():
    """Ten references take 20 ... 29 frames at recorded speeds 10, 9.5 ... 5.5: frames = 40 - 2 speed."""
    references = [row for i in range(10) for row in steady(i, 20 + i, 20 + i, 10 - i / 2)]
    late = [(99, 200 + i, 20.0 + i, 3, 4.0) for i in range(30)]
    (row,) = estimate(make_tracks(references + late)).to_dicts()
    sigma = math.sqrt(110 / 12)  # sample variance of ten consecutive numbers
    assert (row["vehicle_id"], row["lane"], row["cutoff_m"], row["start_x_m"]) == (99, 3, 0.0, 20.0)
    assert (row["start_frame"], row["start_speed_mps"]) == (200, 4.0)
    assert (row["method"], row["references"]) == ("regression", 10)
    assert row["intercept_frames"] == pytest.approx(40)
    assert row["slope_frames_per_mps"] == pytest.approx(-2)
    assert row["r2"] == pytest.approx(1)
    assert row["frames_estimated"] == pytest.approx(32)
    assert row["frames_sigma"] == pytest.approx(sigma)
    assert row["first_missing_frame"] == math.floor(200 - 32 - 2 * sigma) == 161


def test_at_least_one_frame_is_missing_and_none_before_the_recording():
    """At 19.75 m/s the line gives 0.5 frames, at 30 m/s -20: one frame counts. A start at frame 40 is clamped."""
    references = [row for i in range(10) for row in steady(i, 20 + i, 20 + i, 10 - i / 2)]
    late = [(97, 200, 20.0, 1, 19.75), (98, 200, 20.0, 1, 30.0), (99, 40, 20.0, 1, 4.0)]
    missing = estimate(make_tracks(references + late), first_frame=5)
    assert missing["frames_estimated"].to_list() == pytest.approx([0.5, -20, 32])
    assert missing["first_missing_frame"].to_list() == [math.floor(200 - 1 - 2 * math.sqrt(110 / 12))] * 2 + [5]


def test_fewer_than_ten_references_mean_speed():
    """Nine references, 20 ... 28 frames: sigma of consecutive numbers sqrt(90 / 12). All record 8 m/s: 25 frames."""
    references = [row for i in range(9) for row in steady(i, 20 + i, 20 + i, 8.0)]
    (row,) = estimate(make_tracks([*references, (99, 200, 20.0, 1, 8.0)])).to_dicts()
    assert (row["method"], row["references"]) == ("mean_speed", 9)
    assert (row["intercept_frames"], row["slope_frames_per_mps"], row["r2"]) == (None, None, None)
    assert row["frames_estimated"] == pytest.approx(20 / 8 * 10)
    assert row["frames_sigma"] == pytest.approx(math.sqrt(90 / 12))
    assert row["first_missing_frame"] == math.floor(200 - 25 - 2 * math.sqrt(90 / 12)) == 169


def test_fewer_than_two_references_a_quarter_of_the_estimate():
    """One reference reaches 20 m, two do not. Mean speed 8 m/s: 25 frames, sigma 6.25."""
    references = [row for i in range(2) for row in steady(i, 20 + i, 20, 8.0, entries=15)]
    tracks = make_tracks([*references, *steady(5, 40, 20, 8.0), (99, 200, 20.0, 1, 8.0)])
    (row,) = estimate(tracks).to_dicts()
    assert (row["method"], row["references"]) == ("mean_speed", 1)
    assert row["frames_estimated"] == pytest.approx(25)
    assert row["frames_sigma"] == pytest.approx(6.25)
    assert row["first_missing_frame"] == math.floor(200 - 25 - 12.5) == 162


def test_no_reference_reaches_a_start():
    tracks = make_tracks([(1, 20, 0.0, 1, 8.0), (2, 30, 0.0, 1, 8.0), (99, 200, 20.0, 1, 8.0)])
    (row,) = estimate(tracks).to_dicts()
    assert (row["references"], row["frames_sigma"]) == (0, pytest.approx(6.25))


@pytest.mark.parametrize("speed_mps", [0.0, -1.0])
def test_where_traffic_stands_everything_before_may_be_missing(speed_mps):
    tracks = make_tracks([(1, 20, 0.0, 1, speed_mps), (2, 30, 0.0, 1, speed_mps), (99, 200, 20.0, 1, speed_mps)])
    (row,) = estimate(tracks, first_frame=7).to_dicts()
    assert row["first_missing_frame"] == 7
    assert row["frames_estimated"] == 193


def test_tracks_with_a_gap_are_no_references():
    broken = [row for row in steady(5, 40, 20, 8.0) if row[1] != 90]
    tracks = make_tracks([*steady(1, 20, 20, 8.0), *steady(2, 30, 20, 8.0), *broken, (99, 200, 20.0, 1, 8.0)])
    assert estimate(tracks)["references"].to_list() == [2]


def test_nobody_late():
    tracks = make_tracks(steady(1, 20, 20, 8.0))
    assert estimate(tracks).is_empty()
    starts, _ = classify_starts(summarise(tracks), **NAMES, first_frame=15, frame_rate_hz=10.0)
    none = estimate_missing_starts(lambda: [tracks], starts, **NAMES, cutoff_m=None, first_frame=15, frame_rate_hz=10.0)
    assert none.is_empty()


def test_fit_where_nothing_varies():
    fit = fit_frames(np.full(10, 4.0), np.arange(10.0))
    assert (fit["slope_frames_per_mps"], fit["intercept_frames"], fit["r2"]) == (0.0, 4.5, 0.0)
    fit = fit_frames(np.arange(10.0), np.full(10, 4.0))
    assert (fit["slope_frames_per_mps"], fit["intercept_frames"], fit["r2"]) == (0.0, 4.0, None)


def slow_crossing(track, x_m):
    """First crossing of x_m by a loop: frame, speed of the nearer entry; None where it is not reached."""
    for i, (_, frame, x, _, speed) in enumerate(track):
        if x >= x_m:
            if i == 0:
                return frame, speed
            _, frame_before, x_before, _, speed_before = track[i - 1]
            share = (x_m - x_before) / (x - x_before)
            return frame_before + share * (frame - frame_before), speed_before if x_m - x_before <= x - x_m else speed
    return None


@pytest.mark.parametrize("seed", range(6))
def test_estimates_agree_with_a_loop_on_tracks_that_creep_and_stop(seed):
    """Random walks with backward steps, some of which never get far; starts spread over 0 to 60 m.

    All on a grid of half metres, so that some crossings lie midway between two entries.
    """
    rng = np.random.default_rng(seed)
    tracks = []
    for vehicle in range(24):
        x = 0.0 if rng.random() < 0.7 else float(rng.integers(0, 120)) / 2
        track = []
        for i in range(int(rng.integers(2, 80))):
            track.append((vehicle, int(vehicle * 3 + i), x, 1, float(np.float32(rng.uniform(0, 12)))))
            x += float(rng.choice([-0.5, 0.0, 1.0, 2.0]))
        tracks.append(track)
    first_frame = -7
    frame = make_tracks([row for track in tracks for row in track])
    _, cutoffs = classify_starts(summarise(frame), **NAMES, first_frame=first_frame, frame_rate_hz=10.0)
    c = cutoffs["cutoff_m"][0]
    missing = estimate(frame, first_frame=first_frame).to_dicts()

    late = [track for track in tracks if track[0][1] - first_frame >= 10 and track[0][2] > c]
    whole = [track for track in tracks if track[0][1] - first_frame >= 10 and track[0][2] <= c]
    assert [row["vehicle_id"] for row in missing] == [track[0][0] for track in late]
    assert late
    for row, ((_, start_frame, x, _, speed), *_) in zip(missing, late, strict=True):
        pairs = []
        for track in whole:
            there = slow_crossing(track, x)
            if there is not None:
                pairs.append((there[1], there[0] - slow_crossing(track, c)[0]))
        assert row["references"] == len(pairs)
        frames = np.array([frames for _, frames in pairs])
        if len(pairs) >= 10:
            slope, intercept = np.polyfit([speed for speed, _ in pairs], frames, 1)
            expected = intercept + slope * speed
            assert row["method"] == "regression"
            assert row["slope_frames_per_mps"] == pytest.approx(slope)
            r = np.corrcoef([speed for speed, _ in pairs], frames)[0, 1]
            assert row["r2"] == pytest.approx(r**2)
        else:
            expected = (x - c) / np.mean([e[4] for track in tracks for e in track]) * 10
            assert row["method"] == "mean_speed"
        sigma = np.std(frames, ddof=1) if len(pairs) > 1 else expected / 4
        assert row["frames_estimated"] == pytest.approx(expected)
        assert row["frames_sigma"] == pytest.approx(sigma)
        first_missing = math.floor(start_frame - max(1, expected) - 2 * sigma)
        assert row["first_missing_frame"] == max(first_frame, first_missing)


@pytest.mark.skipif(not US101.exists(), reason=f"the real excerpt {US101.name} is not beside the project")
def test_us101_excerpt():
    """DESIGN section 6: cut-off 14 m, and one of 289 tracks late (vehicle 407, first seen at 504.803 ft)."""
    tracks, first_frame = read_us101()
    starts, cutoffs = classify_starts(
        summarise(tracks), **NAMES, first_frame=first_frame, frame_rate_hz=10.0, on_ramp_lanes=(7,)
    )
    row = cutoffs.row(0, named=True)
    assert (row["cutoff_m"], row["eligible"], row["late"]) == (14.0, 289, 1)
    assert starts.filter("starts_late")["vehicle_id"].to_list() == [407]
    (missing,) = estimate(tracks, first_frame=first_frame).to_dicts()
    assert missing["method"] == "regression"
    # 140 m at the recorded 15.6 m/s take 9 seconds, or longer if traffic before was slower.
    assert 50 < missing["frames_estimated"] < 200
