"""Samples of drives: which there are, their histories and futures, labels, split and augmentation."""

from dataclasses import fields

import numpy as np
import polars as pl
import pytest
from drive_tables import LANE_M, make_drive, make_traffic
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.perception import FIRST_LIDAR_ID
from tracklake.training.lane_changes.examples import KEEP, LEFT, RIGHT
from tracklake.training.onboard.models import predict_turns
from tracklake.training.onboard.samples import (
    FEATURE_NUMBER,
    FEATURES,
    augment_samples,
    build_samples,
    describe_truth,
    match_truth,
    split_samples,
)

X = FEATURE_NUMBER["rel_x_m"]


def assert_equal(one, other):
    for own in fields(one):
        np.testing.assert_array_equal(getattr(one, own.name), getattr(other, own.name), err_msg=own.name)


def test_41_ticks_make_one_sample():
    surrounding, truth, drives = make_drive([{"speed": 27.0, "x_m": 10.0}], ticks=41)
    samples, left_out = build_samples(surrounding, truth, drives)
    assert (len(samples), samples.tick.tolist()) == (1, [20])
    # 2 m/s faster than the ego: 0.2 m a tick, from 10 m on.
    np.testing.assert_allclose(samples.feature[0, :, X], 10 + 0.2 * np.arange(1, 21), rtol=1e-6)
    np.testing.assert_allclose(samples.place_m[0, :, 0], 10 + 0.2 * np.arange(21, 41), rtol=1e-6)
    np.testing.assert_allclose(samples.velocity_mps, [[2, 0]], atol=1e-5)
    assert samples.ego_size_m.tolist() == [[np.float32(4.4), np.float32(1.8)]]
    assert samples.vehicle.tolist() == ["highd/01-lower/100"]
    assert samples.feature[0, :, FEATURE_NUMBER["steering_angle_deg"]].tolist() == [0.0] * 20  # not sent
    # Ticks 0 to 15 have no history, 25 to 40 no future.
    assert list(left_out.values()) == [4, 0, 4]


def test_no_rows_and_one_row_make_no_samples():
    surrounding, truth, drives = make_drive([{}], ticks=60)
    for rows in (0, 1):
        assert len(build_samples(surrounding[:rows], truth[:rows], drives).samples) == 0


def test_a_gap_at_a_tables_end_is_not_bridged():
    surrounding, truth, drives = make_drive([{}], ticks=41)
    for lost in (2, 19):  # rows at the first end: tick 1 is 19 before tick 20, with a gap between them
        assert len(build_samples(surrounding[1:].filter(pl.col("tick") != lost), truth, drives).samples) == 0
    assert len(build_samples(surrounding, truth.filter(pl.col("tick") != 30), drives).samples) == 0


@settings(max_examples=20)
@given(st.data())
def test_samples_are_those_of_a_loop_whatever_the_gaps_and_the_order(data):
    surrounding, truth, drives = make_drive([{"x_m": 10.0}, {"x_m": -20.0}], ticks=80, ids=[1, FIRST_LIDAR_ID - 1])
    lost = data.draw(st.sets(st.integers(0, 159), max_size=4))
    unknown = data.draw(st.sets(st.integers(0, 159), max_size=4))
    surrounding = surrounding[[row for row in range(160) if row not in lost]]
    truth = truth[[row for row in range(160) if row not in unknown]]
    shuffled = surrounding.sample(fraction=1, shuffle=True, seed=data.draw(st.integers(0, 9)))
    samples, left_out = build_samples(shuffled, truth.reverse(), drives)
    seen = set(surrounding.select("vehicle_id", "tick").rows())
    true = set(truth.select("vehicle_id", "tick").rows())
    expected = [
        (own, tick)
        for own, tick in sorted(seen)
        if tick % 5 == 0
        and all((own, tick - back) in seen for back in range(20))
        and all((own, tick + ahead) in true for ahead in range(21))
    ]
    assert list(zip(samples.vehicle_id.tolist(), samples.tick.tolist(), strict=True)) == expected
    assert len(samples) + sum(left_out.values()) == sum(tick % 5 == 0 for _, tick in seen)


def test_features_are_causal_and_futures_are_true():
    surrounding, truth, drives = make_drive([{"accel": 0.5}], ticks=60, noise_m=0.3)
    samples = build_samples(surrounding, truth, drives).samples
    first = samples.select(samples.tick == 20)
    np.testing.assert_allclose(first.place_m[0], truth[21:41].select("rel_x_m", "rel_y_m").to_numpy(), rtol=1e-6)
    for name in ("smoothed_x_m", "smoothed_y_m", "smoothed_speed_mps", "smoothed_accel_mps2"):
        surrounding = surrounding.with_columns(pl.col(name) + 7)
    later = surrounding.with_columns(pl.when(pl.col("tick") > 20).then(99.0).otherwise(pl.col(FEATURES)).name.keep())
    changed = build_samples(later, truth, drives).samples
    assert_equal(changed.select(changed.tick == 20), first)


def test_a_recorded_drive_has_smoothed_futures_and_lane_changes_by_lateral_motion():
    vehicles = [{}, {"to": 3, "at_s": 1.5}, {"to": 1, "at_s": 1.5}]
    surrounding, truth, drives = make_drive(vehicles, ticks=80, noise_m=0.2, with_truth=False)
    samples = build_samples(surrounding, truth, drives).samples
    by_truth = build_samples(*make_drive(vehicles, ticks=80, noise_m=0.2)).samples
    np.testing.assert_array_equal(samples.place_m, by_truth.place_m)  # smoothed without error here
    at = samples.tick == 30  # a change over 4 s from 1.5 s on has crossed the marking at 3.5 s
    assert samples.maneuver[at].tolist() == by_truth.maneuver[at].tolist() == [KEEP, RIGHT, LEFT]
    assert samples.vehicle[0] == "v2v/drive/0"


def test_vehicles_that_only_lidar_saw_are_matched_by_place():
    ids = [3, FIRST_LIDAR_ID, FIRST_LIDAR_ID + 1]
    surrounding, truth, drives = make_drive([{}, {"x_m": -30.0}, {"lane": 3}], ticks=60, noise_m=0.2, ids=ids)
    assert sorted(match_truth(surrounding, truth).rows()) == [
        ("drive", own, true) for own, true in zip(ids, (100, 101, 102), strict=True)
    ]
    far = surrounding.with_columns(rel_x_m=pl.col("rel_x_m") + 5 * (pl.col("vehicle_id") > FIRST_LIDAR_ID))
    samples, left_out = build_samples(far, truth, drives)
    assert set(samples.vehicle_id.tolist()) == set(ids[:2])
    assert left_out["no true vehicle"] > 0


def test_a_vehicle_that_only_lidar_saw_is_no_true_one_where_it_has_strayed():
    surrounding, truth, drives = make_drive([{}], ticks=80, ids=[FIRST_LIDAR_ID])
    strayed = surrounding.with_columns(pl.col("rel_x_m") + 3.1 * (pl.col("tick") >= 50))
    samples, left_out = build_samples(strayed, truth, drives)
    assert samples.tick.tolist() == [20, 25, 30, 35, 40, 45]
    assert left_out["no true vehicle"] == 6
    sends, truth, drives = make_drive([{}], ticks=80, ids=[1])  # its messages name it, wherever they place it
    assert len(build_samples(sends.with_columns(pl.col("rel_x_m") + 9), truth, drives).samples) == 8


def test_slowing_is_judged_at_the_horizon():
    samples = build_samples(*make_drive([{"accel": -0.5}, {"accel": 0.5}, {}], ticks=41)).samples
    assert samples.slowing.tolist() == [True, False, False]
    assert samples.stratum.tolist() == [2, 0, 0]


def make_two_drives():
    one, two = make_traffic(20, subset="one"), make_traffic(20, subset="two")
    return build_samples(*(pl.concat(frames) for frames in zip(one, two, strict=True))).samples


def test_a_vehicle_of_several_drives_is_in_one_part():
    samples = make_two_drives()
    assert len(np.unique(samples.trajectory)) == 40
    train, rest, digest = split_samples(samples, seed=0)
    assert not set(train.vehicle) & set(rest.vehicle)
    assert (len(np.unique(train.trajectory)), len(np.unique(rest.trajectory))) == (28, 12)  # 70:30
    order = np.random.default_rng(1).permutation(len(samples))
    again = split_samples(samples.select(order), seed=0)
    assert again.digest == digest
    assert set(again.train.vehicle) == set(train.vehicle)
    assert split_samples(samples, seed=1).digest != digest


def test_one_vehicle_cannot_be_split():
    with pytest.raises(TracklakeError, match=r"at least two vehicles.*got 1.*40 ticks in a row"):
        split_samples(build_samples(*make_drive([{}])).samples, seed=0)


def test_augmented_samples_are_mirrored_and_shifted():
    samples = build_samples(*make_traffic(6, noise_m=0.1)).samples
    count = len(samples)
    larger = augment_samples(samples, np.random.default_rng(0))
    own, mirrored, shifted = (larger.select(np.arange(count) + first * count) for first in range(3))
    assert_equal(own, samples)
    assert_equal(augment_samples(mirrored, np.random.default_rng(0)).select(np.arange(count, 2 * count)), samples)
    np.testing.assert_allclose(predict_turns(mirrored), predict_turns(samples) * [1, -1], atol=1e-5)
    assert (mirrored.maneuver == RIGHT).tolist() == (samples.maneuver == LEFT).tolist()
    moved = shifted.place_m[:, :, 0] - samples.place_m[:, :, 0]
    assert np.abs(moved).max() <= 5.001
    np.testing.assert_allclose(moved - (shifted.feature - samples.feature)[:, :, X], 0, atol=1e-4)
    np.testing.assert_allclose(predict_turns(shifted)[..., 0] - predict_turns(samples)[..., 0], moved, atol=1e-3)


def test_truth_is_described_as_an_overhead_camera_sees_it():
    surrounding, truth, _ = make_drive([{"to": 3, "accel": 0.3}], ticks=50)
    names = [*FEATURES, "rel_speed_x_mps", "rel_speed_y_mps"]
    seen = describe_truth(truth)
    assert seen["vehicle_id"].unique().to_list() == [100]
    for name in names:
        np.testing.assert_allclose(seen[name].fill_null(0), surrounding[name].fill_null(0), atol=1e-4, err_msg=name)
    assert abs(surrounding["rel_y_m"].max()) < LANE_M
