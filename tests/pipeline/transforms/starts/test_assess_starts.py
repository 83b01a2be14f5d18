"""Coverage and excess of the estimates, on tracks cut on purpose: against repair itself, slow loops and by hand."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from start_scenes import NAMES, US101, creep, cross_slowly, drive, make_tracks, read_us101, summarise

from tracklake.pipeline.transforms.starts.assessment import POSITIONS_M, assess_starts, cut_and_estimate
from tracklake.pipeline.transforms.starts.late_starts import classify_starts, estimate_missing_starts
from tracklake.schemas.start_assessments import ESTIMATORS, START_ASSESSMENTS

RATE_HZ = 10.0


def all_whole(tracks):
    """`vehicle_starts` that holds every vehicle to be fully tracked."""
    ids = tracks["vehicle_id"].unique(maintain_order=True)
    return pl.DataFrame({"vehicle_id": ids}).with_columns(
        starts_late=pl.lit(value=False), fully_tracked=pl.lit(value=True)
    )


def cut(tracks, *, cutoff_m=0.0, first_frame=0, starts=None):
    starts = all_whole(tracks) if starts is None else starts
    return cut_and_estimate(tracks, starts, cutoff_m=cutoff_m, first_frame=first_frame, frame_rate_hz=RATE_HZ)


def assess(tracks, *, cutoff_m=0.0, first_frame=0, frame_rate_hz=RATE_HZ):
    table = assess_starts(
        tracks, all_whole(tracks), **NAMES, cutoff_m=cutoff_m, first_frame=first_frame, frame_rate_hz=frame_rate_hz
    )
    return START_ASSESSMENTS.validate(table, where="test")


def scene(seed, vehicles):
    random = np.random.default_rng(seed)
    return [creep(random, vehicle, 5 * vehicle + int(random.integers(0, 9))) for vehicle in range(vehicles)]


@pytest.mark.parametrize(
    ("seed", "vehicles", "methods"),
    [
        (0, 30, {"regression", "mean_speed"}),
        (1, 18, {"regression", "mean_speed"}),
        (2, 11, {"regression", "mean_speed"}),
        (3, 7, {"mean_speed"}),
        (4, 2, {"mean_speed"}),
        (5, 1, {"mean_speed"}),
    ],
)
def test_the_headline_is_what_repair_makes_of_a_track_that_is_really_cut(seed, vehicles, methods):
    """Each track cut, each time, by a loop; the vehicle then is a late start, and repair's own function estimates."""
    tracks = scene(seed, vehicles)
    frame = make_tracks([entry for track in tracks for entry in track])
    cutoff_m, first_frame = 2.0, -10
    expected = []
    for beyond_m in POSITIONS_M:
        for number, track in enumerate(tracks):
            left = [i for i, entry in enumerate(track) if entry[2] >= cutoff_m + beyond_m]
            if not left:
                continue
            others = [entry for other in tracks if other is not track for entry in other]
            really_cut = make_tracks(others + track[left[0] :]).sort("vehicle_id", "frame")
            starts = all_whole(frame).with_columns(
                starts_late=pl.col("vehicle_id") == number, fully_tracked=pl.col("vehicle_id") != number
            )
            (repaired,) = estimate_missing_starts(
                lambda frame=really_cut: [frame],
                starts,
                **NAMES,
                cutoff_m=cutoff_m,
                first_frame=first_frame,
                frame_rate_hz=RATE_HZ,
            ).to_dicts()
            begun = next(entry[1] for entry in track if entry[2] >= cutoff_m)
            expected.append((repaired, beyond_m, begun, cross_slowly(track, cutoff_m)[0]))
    found = (
        cut(frame, cutoff_m=cutoff_m, first_frame=first_frame).filter(pl.col("estimator") == "regression").to_dicts()
    )
    assert len(found) == len(expected) > 0
    for row, (repaired, beyond_m, begun, crossed) in zip(found, expected, strict=True):
        for name in ("vehicle_id", "start_frame", "references", "first_missing_frame"):
            assert row[name] == repaired[name], name
        assert (row["beyond_m"], row["first_true_frame"]) == (beyond_m, begun)
        assert row["frames_true"] == pytest.approx(row["start_frame"] - crossed)
        assert row["frames_estimated"] == pytest.approx(repaired["frames_estimated"])
        assert row["margin_frames"] == pytest.approx(2 * repaired["frames_sigma"])
    assert {repaired["method"] for repaired, *_ in expected} == methods


@pytest.mark.parametrize(("seed", "vehicles", "references"), [(6, 30, {"enough"}), (7, 12, {"few", "enough"})])
def test_the_other_estimators_agree_with_a_loop(seed, vehicles, references):
    tracks = scene(seed, vehicles)
    frame = make_tracks([entry for track in tracks for entry in track])
    cutoff_m = 1.0
    found = {(r["vehicle_id"], r["beyond_m"], r["estimator"]): r for r in cut(frame, cutoff_m=cutoff_m).to_dicts()}
    seen = set()
    for number, beyond_m in {key[:2] for key in found}:
        regression, mean_speed, no_margin, local = (found[number, beyond_m, name] for name in ESTIMATORS)
        track = tracks[number]
        i = next(i for i, entry in enumerate(track) if entry[2] >= cutoff_m + beyond_m)
        _, start_frame, x, lane, speed = track[i]
        left = [entry[4] for other in tracks for entry in (other if other is not track else track[i:])]
        assert mean_speed["frames_estimated"] == pytest.approx((x - cutoff_m) / np.mean(left) * RATE_HZ)
        assert mean_speed["margin_frames"] == regression["margin_frames"]
        assert (no_margin["frames_estimated"], no_margin["margin_frames"]) == (regression["frames_estimated"], 0)
        points = []
        for other in tracks:
            there = cross_slowly(other, x)
            if other is not track and there is not None:
                apart = abs(there[0] - start_frame) / RATE_HZ + 10 * abs(there[1][3] - lane)
                points.append((apart, there[1][4], there[0] - cross_slowly(other, cutoff_m)[0]))
        if len(points) < 10:
            assert local["frames_estimated"] == regression["frames_estimated"]
            assert local["margin_frames"] == regression["margin_frames"]
            seen.add("few")
            continue
        _, speeds, frames = np.array(sorted(points)[:10]).T
        design = np.stack([np.ones(len(speeds)), speeds], axis=1)
        line, (squares,), *_ = np.linalg.lstsq(design, frames)
        at = np.array([1, speed])
        error = math.sqrt(squares / (len(speeds) - 2) * (1 + at @ np.linalg.inv(design.T @ design) @ at))
        assert local["frames_estimated"] == pytest.approx(line @ at)
        assert local["margin_frames"] == pytest.approx(2 * error)
        seen.add("enough")
    assert seen == references


def test_coverage_and_excess_by_hand():
    """Twelve vehicles at 1 m a frame that record 8 m/s, and one at half the pace; all cut at 20 m, nowhere else.

    20 m at the mean of 8 m/s are 25 frames. Each of the twelve: the other eleven took 20 frames and the slow one 40, so
    the mean (all speeds are the same, so the line is level) is 260 / 12 = 21 2/3, and the sample variance
    (11 (5/3)2 + (55/3)2) / 11 = 33 1/3. The slow one is estimated at 20 without any spread.
    """
    entries = [entry for vehicle in range(12) for entry in drive(vehicle, 100 + 10 * vehicle, 30)]
    table = assess(make_tracks([*entries, *drive(12, 150, 50, m_per_frame=0.5)]))
    assert table["beyond_m"].to_list() == [20.0] * 4
    rows = {row["estimator"]: row for row in table.to_dicts()}
    assert {(row["starts"], row["frames_missing"], row["start_x_m"]) for row in rows.values()} == {(13, 280, 20.0)}
    sigma = math.sqrt(100 / 3)

    window = math.ceil(65 / 3 + 2 * sigma)
    regression = rows["regression"]
    assert (regression["frames_covered"], regression["starts_covered"]) == (240 + 20, 12)
    assert regression["frames_excess"] == 12 * (window - 20)
    assert regression["coverage"] == pytest.approx(260 / 280)
    assert regression["excess"] == pytest.approx(12 * (window - 20) / 280)
    assert regression["error_mean_s"] == pytest.approx((12 * 5 / 3 - 20) / 13 / 10)
    assert regression["error_median_s"] == pytest.approx(5 / 30)

    assert (rows["no_margin"]["frames_covered"], rows["no_margin"]["frames_excess"]) == (260, 12 * 2)
    assert rows["mean_speed"]["frames_covered"] == 240 + 25
    assert rows["mean_speed"]["frames_excess"] == 12 * (math.ceil(25 + 2 * sigma) - 20)


def test_in_25_hz_the_error_is_in_seconds():
    entries = [entry for vehicle in range(3) for entry in drive(vehicle, 100 + 10 * vehicle, 30)]
    mean_speed = assess(make_tracks(entries), frame_rate_hz=25.0).filter(pl.col("estimator") == "mean_speed")
    assert mean_speed["error_mean_s"].to_list() == pytest.approx([20 / 8 - 20 / 25])


def test_no_window_begins_before_the_recording():
    entries = [entry for vehicle in range(2) for entry in drive(vehicle, 12 + vehicle, 30, speed_mps=0.1)]
    found = cut(make_tracks(entries), first_frame=10)
    assert set(found["frames_estimated"].round(3)) == {2000.0}
    assert set(found["first_missing_frame"]) == {10}


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 14), st.integers(0, 11))
def test_what_was_cut_off_tells_nothing_of_itself(seed, vehicles, changed):
    """A vehicle that waited before the cut, recording other speeds, is estimated the same; only the truth differs."""
    tracks = scene(seed, vehicles)
    number = changed % vehicles
    before = cut(make_tracks([entry for track in tracks for entry in track]), first_frame=-500).filter(
        pl.col("vehicle_id") == number
    )
    track = tracks[number]
    i = next((i for i, entry in enumerate(track) if entry[2] >= 20), None)
    if i is None:
        assert before.is_empty()
        return
    _, frame, *_ = track[i]
    waited = [(number, frame - 200 + k, 0.0, 3, 1.0) for k in range(199)]
    tracks[number] = [*waited, (number, frame - 1, 0.0, 3, 1.0), *track[i:]]
    after = cut(make_tracks([entry for track in tracks for entry in track]), first_frame=-500).filter(
        pl.col("vehicle_id") == number
    )
    one, two = (found.filter(pl.col("beyond_m") == 20).sort("estimator") for found in (before, after))
    assert one["estimator"].to_list() == two["estimator"].to_list() == sorted(ESTIMATORS)
    assert one["references"].to_list() == two["references"].to_list()
    for name in ("frames_estimated", "margin_frames", "first_missing_frame"):
        assert one[name].to_list() == pytest.approx(two[name].to_list()), name
    assert set(two["first_true_frame"]) == {frame - 200}


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 16), st.floats(0, 8), st.integers(-(10**6), 10**6))
def test_properties(seed, vehicles, cutoff_m, shift):
    """Counts that fit together, whatever the frames are called and however high the ids are."""
    tracks = make_tracks([entry for track in scene(seed, vehicles) for entry in track])
    table = assess(tracks, cutoff_m=cutoff_m)
    counts = table.select("frames_missing", "frames_covered", "frames_excess", "starts_covered", "starts")
    assert (counts["frames_covered"] <= counts["frames_missing"]).all()
    assert (counts["starts_covered"] <= counts["starts"]).all()
    assert (counts["starts"] <= vehicles).all()
    whole = table.filter(pl.col("starts_covered") == pl.col("starts"))
    assert (whole["frames_covered"] == whole["frames_missing"]).all()
    by = table.pivot("estimator", index="beyond_m", values=["frames_covered", "frames_excess", "starts"])
    assert by.height == len(table) / len(ESTIMATORS)
    if by.height:
        for figure in ("frames_covered", "frames_excess"):
            assert (by[f"{figure}_no_margin"] <= by[f"{figure}_regression"]).all(), "a margin only widens"
        assert by["starts_regression"].is_sorted(descending=True), "who reaches 40 m passed 20 m"
    shifted = tracks.with_columns(
        pl.col("frame") + pl.lit(shift, pl.Int32),
        vehicle_id=pl.lit(2**31 - 1 - vehicles, pl.Int32) + pl.col("vehicle_id"),
    )
    again = assess(shifted, cutoff_m=cutoff_m, first_frame=shift)
    errors = ("error_mean_s", "error_median_s")
    assert again.drop(errors).rows() == table.drop(errors).rows()
    for name in errors:
        assert again[name].to_list() == pytest.approx(table[name].to_list(), abs=1e-6)


def test_nothing_to_assess():
    tracks = make_tracks(drive(1, 20, 60))
    none = all_whole(tracks).with_columns(fully_tracked=pl.lit(value=False))
    for starts, cutoff_m in ((none, 0.0), (all_whole(tracks), None)):
        table = assess_starts(tracks, starts, **NAMES, cutoff_m=cutoff_m, first_frame=0, frame_rate_hz=RATE_HZ)
        assert START_ASSESSMENTS.validate(table, where="test").is_empty()
    short = make_tracks([*drive(1, 20, 20), (2, 30, 0.0, 0, 8.0)])
    assert assess(short).is_empty(), "19 m, and one frame: shorter than any window"


def test_one_vehicle_alone_is_estimated_by_its_own_remaining_speed():
    """No references: (20 m / 16 m/s) 12.5 frames and a margin of twice a quarter of it; 20 were missing."""
    rows = assess(make_tracks([*drive(1, 50, 20, speed_mps=1.0), *drive(1, 70, 5, speed_mps=16.0, start_x_m=20.0)]))
    for row in rows.to_dicts():
        window = 12.5 * (1 if row["estimator"] == "no_margin" else 1.5)
        assert (row["starts"], row["frames_missing"]) == (1, 20)
        assert (row["frames_covered"], row["frames_excess"]) == (math.ceil(window), 0), row["estimator"]


def test_two_side_by_side_tell_each_others_truth():
    """In lane 0 and lane 1, one more ahead: with two references the margin is their spread, which is none."""
    tracks = [entry for vehicle, lane in ((1, 0), (2, 1), (3, 0)) for entry in drive(vehicle, 50, 45, lane=lane)]
    found = cut(make_tracks(tracks)).filter(pl.col("estimator") == "mean_speed")
    assert found["margin_frames"].to_list() == [0.0] * 6
    assert found["references"].to_list() == [2] * 6


def test_a_vehicle_that_backs_up_and_returns_starts_where_it_first_got():
    """To 25 m, back to 10 m and on: cut at 20 m it begins on its first way, 20 frames after the cut-off."""
    there = [(1, 50 + i, float(x), 1, 8.0) for i, x in enumerate([*range(26), *range(24, 9, -1), *range(11, 31)])]
    found = cut(make_tracks(there)).filter(pl.col("estimator") == "regression").to_dicts()
    assert [(row["start_frame"], row["frames_true"]) for row in found] == [(70, 20.0)]


@pytest.mark.skipif(not US101.exists(), reason=f"the real excerpt {US101.name} is not beside the project")
def test_us101_excerpt():
    """The contract's windows cover 95 %; the local regression covers at least as much with far less without need."""
    tracks, first_frame = read_us101()
    starts, cutoffs = classify_starts(summarise(tracks), **NAMES, first_frame=first_frame, frame_rate_hz=RATE_HZ)
    cutoff_m = cutoffs["cutoff_m"][0]
    table = assess_starts(tracks, starts, **NAMES, cutoff_m=cutoff_m, first_frame=first_frame, frame_rate_hz=RATE_HZ)
    sums = table.group_by("estimator").agg(pl.col("starts", "frames_missing", "frames_covered", "frames_excess").sum())
    rows = {row["estimator"]: row for row in sums.to_dicts()}
    assert {row["starts"] for row in rows.values()} == {2880}
    coverage = {name: row["frames_covered"] / row["frames_missing"] for name, row in rows.items()}
    assert coverage["regression"] >= 0.95
    assert coverage["local_regression"] >= coverage["regression"] > coverage["mean_speed"] > coverage["no_margin"]
    assert rows["local_regression"]["frames_excess"] < 0.6 * rows["regression"]["frames_excess"]
