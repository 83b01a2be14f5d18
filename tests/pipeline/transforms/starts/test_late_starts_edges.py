"""Odd scenes through the whole of repair: one vehicle, one frame, side by side, lane 0, leaving and returning."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from start_scenes import NAMES, drive, make_tracks, summarise

from tracklake.pipeline.transforms.starts.assessment import assess_starts
from tracklake.pipeline.transforms.starts.late_starts import (
    classify_starts,
    estimate_missing_starts,
    find_would_be_neighbors,
    fit_frames,
)
from tracklake.schemas.missing_starts import MISSING_STARTS, START_CUTOFFS
from tracklake.schemas.start_assessments import START_ASSESSMENTS
from tracklake.schemas.vehicles import VEHICLE_STARTS

HIGHEST_ID = 2**31 - 1
ids = st.integers(0, HIGHEST_ID)
lanes = st.one_of(st.none(), st.integers(0, 8))
starts_m = st.integers(-20, 1200).map(lambda quarters: quarters / 4)
speeds = st.floats(-5, 40, width=32)


@st.composite
def tracks_of_one(draw, vehicle):
    """A track of one frame to some, that may begin anywhere, stand, leave for some frames and return."""
    first, frames = draw(st.integers(0, 60)), draw(st.integers(1, 25))
    step_m = draw(st.sampled_from([-0.25, 0.0, 0.5, 1.5, 4.0]))
    track = drive(vehicle, first, frames, m_per_frame=step_m, lane=draw(lanes), start_x_m=draw(starts_m))
    track = [(*entry[:4], draw(speeds)) for entry in track]
    away = draw(st.integers(0, frames))
    gap = draw(st.integers(0, 40))
    return [(v, frame + (gap if i >= away else 0), *rest) for i, (v, frame, *rest) in enumerate(track)]


@st.composite
def scenes(draw):
    """A few vehicles with ids up to the highest."""
    vehicles = sorted(draw(st.sets(ids, min_size=1, max_size=5)))
    return make_tracks([entry for vehicle in vehicles for entry in draw(tracks_of_one(vehicle))])


def repair(tracks, *, first_frame=0, frame_rate_hz=10.0, on_ramp_lanes=()):
    """(vehicle_starts, start_cutoffs row, missing_starts), each as its schema has it."""
    times = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz}
    starts, cutoffs = classify_starts(summarise(tracks), **NAMES, **times, on_ramp_lanes=on_ramp_lanes)
    missing = estimate_missing_starts(lambda: [tracks], starts, **NAMES, **times, cutoff_m=cutoffs["cutoff_m"][0])
    VEHICLE_STARTS.validate(starts, where="test")
    START_CUTOFFS.validate(cutoffs, where="test")
    return starts, cutoffs.row(0, named=True), MISSING_STARTS.validate(missing, where="test")


@settings(max_examples=30, deadline=None)
@given(scenes(), st.sampled_from([(), (0,), (7,)]))
def test_every_vehicle_is_classified_once_and_every_late_start_has_a_window(tracks, on_ramp_lanes):
    starts, cutoffs, missing = repair(tracks, on_ramp_lanes=on_ramp_lanes)
    vehicles = summarise(tracks)
    assert starts["vehicle_id"].to_list() == vehicles["vehicle_id"].to_list()
    eligible = vehicles.filter(
        (pl.col("first_frame") >= 10) & ~pl.col("start_lane").is_in(on_ramp_lanes).fill_null(value=False)
    )
    assert starts.filter("eligible")["vehicle_id"].to_list() == eligible["vehicle_id"].to_list()
    assert (cutoffs["cutoff_m"] is None) == eligible.is_empty()
    late = eligible.filter(pl.col("start_x_m") > (cutoffs["cutoff_m"] or 0.0))
    assert missing["vehicle_id"].to_list() == late["vehicle_id"].to_list()
    assert missing["start_frame"].to_list() == late["first_frame"].to_list()
    assert (missing["first_missing_frame"] >= 0).all()
    assert (missing["first_missing_frame"] < missing["start_frame"]).all(), "a window holds a frame at least"
    whole = eligible.filter(pl.col("entries") == pl.col("last_frame") - pl.col("first_frame") + 1)
    whole = whole.filter(pl.col("start_x_m") <= (cutoffs["cutoff_m"] or 0.0))
    assert starts.filter("fully_tracked")["vehicle_id"].to_list() == whole["vehicle_id"].to_list()
    assert (missing["references"] <= whole.height).all()


@settings(max_examples=20, deadline=None)
@given(scenes())
def test_whatever_drives_by_can_be_assessed(tracks):
    starts, cutoffs, _ = repair(tracks)
    table = assess_starts(tracks, starts, **NAMES, cutoff_m=cutoffs["cutoff_m"], first_frame=0, frame_rate_hz=10.0)
    START_ASSESSMENTS.validate(table, where="test")
    whole = tracks.join(starts.filter("fully_tracked"), on="vehicle_id", how="semi")
    farthest = whole.group_by("vehicle_id").agg(pl.col("x_m").max())
    reached = [
        (position, sum(x >= cutoffs["cutoff_m"] + position for x in farthest["x_m"]))
        for position in map(float, range(20, 201, 20))
        if not farthest.is_empty()
    ]
    for estimator in ("regression", "mean_speed", "no_margin", "local_regression"):
        found = table.filter(pl.col("estimator") == estimator).select("beyond_m", "starts").rows()
        assert found == [each for each in reached if each[1]]


@settings(max_examples=20, deadline=None)
@given(scenes(), st.integers(0, 4))
def test_would_be_neighbors_agree_with_a_loop(tracks, first_frame):
    _, _, missing = repair(tracks, first_frame=-first_frame)
    clock = tracks.select((pl.col("frame") + first_frame).alias("tick"), "x_m", "lane")
    near = find_would_be_neighbors(clock, missing, first_frame=-first_frame, frame_rate_hz=10.0, rate_hz=10)
    expected = []
    for tick, x_m, lane in clock.rows():
        frame, found = tick - first_frame, False
        for window in missing.to_dicts():
            begin, start = window["first_missing_frame"], window["start_frame"]
            if begin <= frame < start:
                share = (frame - begin) / (start - begin)
                would_be_m = window["cutoff_m"] + share * (window["start_x_m"] - window["cutoff_m"])
                beside = None in (lane, window["lane"]) or abs(lane - window["lane"]) <= 1
                found |= beside and abs(x_m - would_be_m) <= 40 + 1e-6
        expected.append(found)
    assert near.tolist() == expected


@settings(max_examples=20, deadline=None)
@given(ids, st.integers(0, 500), starts_m, lanes, speeds)
def test_one_vehicle_in_one_frame(vehicle, frame, x_m, lane, speed_mps):
    """It cannot be late: its own start makes the cut-off. With one entry it is fully tracked, but reaches nothing."""
    starts, cutoffs, missing = repair(make_tracks([(vehicle, frame, x_m, lane, speed_mps)]))
    assert missing.is_empty()
    assert cutoffs["late"] == 0
    assert cutoffs["eligible"] == cutoffs["fully_tracked"] == (frame >= 10)
    assert starts["early"].to_list() == [False], "no vehicle came before it"


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 7), st.integers(1, 40), st.integers(12, 60))
def test_side_by_side_each_is_the_others_reference(lane, metres, frames_before):
    """Two start together at 0 m in neighboring lanes at 1 m a frame; a third is first seen between them, late.

    Both took as many frames as it has metres, so that sigma is 0; with fewer than ten the estimate is the distance by
    the mean recorded speed, 10 m/s everywhere: a frame per metre, too.
    """
    start_m = metres + 2.5
    pair = [entry for v, side in ((1, lane), (2, lane + 1)) for entry in drive(v, 20, 80, lane=side, speed_mps=10.0)]
    late = (3, 20 + frames_before, start_m, lane, 10.0)
    _, cutoffs, missing = repair(make_tracks([*pair, late]))
    (row,) = missing.to_dicts()
    assert (cutoffs["cutoff_m"], row["vehicle_id"], row["references"], row["lane"]) == (0.0, 3, 2, lane)
    assert row["frames_estimated"] == pytest.approx(start_m)
    assert row["frames_sigma"] == pytest.approx(0, abs=1e-6)
    assert row["first_missing_frame"] in {max(0, 20 + frames_before - metres - k) for k in (2, 3, 4)}


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 60), st.integers(1, 30))
def test_a_vehicle_that_leaves_and_returns_is_late_by_its_first_entry_only(away, back_m):
    """Seen first at the entrance, it is not late however far on it returns; with the gap it is no reference."""
    returns = [*drive(1, 20, 5), *drive(1, 25 + away, 30, start_x_m=5.0 + away + back_m)]
    starts, cutoffs, missing = repair(make_tracks([*returns, *drive(2, 40, 60)]))
    assert cutoffs["cutoff_m"] == 0.0
    assert missing.is_empty()
    assert starts.select("starts_late", "fully_tracked").rows() == [(False, False), (False, True)]


@settings(max_examples=20, deadline=None)
@given(lanes, lanes)
def test_lane_0_is_a_lane_and_an_unknown_one_may_be_any(start_lane, lane):
    missing = pl.DataFrame(
        [(9, start_lane, 0.0, 20.0, 120, 100)],
        schema={
            name: MISSING_STARTS.dtypes[name]
            for name in ("vehicle_id", "lane", "cutoff_m", "start_x_m", "start_frame", "first_missing_frame")
        },
        orient="row",
    )
    clock = pl.DataFrame(
        [(110, 10.0, lane)], schema={"tick": pl.Int32, "x_m": pl.Float64, "lane": pl.Int16}, orient="row"
    )
    near = find_would_be_neighbors(clock, missing, first_frame=0, frame_rate_hz=10.0, rate_hz=10)
    assert near.tolist() == [start_lane is None or lane is None or abs(start_lane - lane) <= 1]


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.integers(-50, 400), st.integers(1, 4000)), min_size=10, max_size=40))
def test_the_fit_solves_the_normal_equations(points):
    """Sums over the points by hand, of integers exactly; r2 is the squared correlation."""
    speeds, frames = ([point[i] for point in points] for i in (0, 1))
    n, sum_v, sum_f = len(points), sum(speeds), sum(frames)
    sum_vv, sum_ff = sum(v * v for v in speeds), sum(f * f for f in frames)
    sum_vf = sum(v * f for v, f in points)
    spread, variation, product = n * sum_vv - sum_v**2, n * sum_ff - sum_f**2, n * sum_vf - sum_v * sum_f
    fit = fit_frames(np.array(speeds, np.float64), np.array(frames, np.float64))
    slope = product / spread if spread else 0.0
    assert fit["slope_frames_per_mps"] == pytest.approx(slope, abs=1e-9)
    assert fit["intercept_frames"] == pytest.approx((sum_f - slope * sum_v) / n, abs=1e-7)
    if not variation:
        assert fit["r2"] is None
    else:
        assert fit["r2"] == pytest.approx(product**2 / spread / variation if spread else 0.0, abs=1e-9)


def test_equal_speeds_that_no_binary_fraction_hits_make_no_slope():
    """The mean of 0.1, ten times or more often, may differ from 0.1 in its last digit."""
    for times in range(10, 40):
        fit = fit_frames(np.full(times, 0.1), np.arange(times, dtype=np.float64))
        assert (fit["slope_frames_per_mps"], fit["r2"]) == (0.0, 0.0)
