"""Samples found by vehicle and time, drawn by kind, and the worst held against a loop."""

import math

import numpy as np
import polars as pl
import pytest
from drawn_moment import FAR_SAMPLE, OWN_SAMPLE, open_moment
from tensor_tables import TINY, random_clock, sample_everything, split_row, write

from tracklake.pipeline.cli.sample_choice import NoSampleError, find_sample, measure_last_distance, pick_samples
from tracklake.schemas.errors import UsageError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.runs.forecasters import open_forecaster


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return open_moment(tmp_path_factory.mktemp("moment"))


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    draw = np.random.default_rng(5)
    tables = []
    for subset in "ab":
        clock = random_clock(draw, vehicles=8, ticks=20)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    splits = pl.concat([split_row("a", "train"), split_row("b", "eval")])
    return TensorFolder.open(write(tmp_path_factory.mktemp("many"), tables, splits)), tables


@pytest.mark.parametrize("vehicle", ["b:5", "highd/b:5"])
@pytest.mark.parametrize("time_s", [1.0, 1.2, 0.8])
def test_a_sample_is_found_by_vehicle_and_time(folder, vehicle, time_s):
    """Vehicle 5 is a sample at tick 2, 1 s; half a tick is 0.25 s."""
    assert find_sample(folder, vehicle, time_s) == FAR_SAMPLE


def test_every_sample_is_found_where_it_is(many):
    folder, tables = many
    number = 0
    for subset, _, samples, _ in tables:
        for vehicle, tick in samples.sort("vehicle_id", "tick").select("vehicle_id", "tick").rows():
            assert find_sample(folder, f"{subset}:{vehicle}", tick / TINY.rate_hz) == number
            number += 1
    assert number == len(folder.sample_row) > 20


@pytest.mark.parametrize(
    ("vehicle", "time_s", "message"),
    [
        ("b:5", 1.25, r"no sample of vehicle 5 in b at 1.25 s: it has 1 from 1 to 1 s; the nearest is at 1 s"),
        ("b:5", math.nan, r"no sample of vehicle 5 in b at nan s"),
        ("b:2", 1.0, r"no sample of vehicle 2 in b; the nearest ids with any: 1, 5"),
        ("b:99999999999999999999", 1.0, r"no sample of vehicle 9+ in b"),
        ("c:1", 1.0, r"no subset `c`: expected one of highd/b"),
        ("ngsim/b:1", 1.0, r"no subset `ngsim/b`"),
        ("b", 1.0, r"expected a vehicle as SUBSET:ID, for instance 02-lower:21, got `b`"),
        ("b:", 1.0, r"expected a vehicle as SUBSET:ID"),
        (":1", 1.0, r"expected a vehicle as SUBSET:ID"),
        ("b:-1", 1.0, r"expected a vehicle as SUBSET:ID"),
    ],
)
def test_missing_samples_are_refused_with_the_nearest(folder, vehicle, time_s, message):
    with pytest.raises(NoSampleError, match=message):
        find_sample(folder, vehicle, time_s)


@pytest.mark.parametrize(
    ("pick", "wanted"), [("lane-change", {OWN_SAMPLE}), ("brake", {FAR_SAMPLE}), ("random", {OWN_SAMPLE})]
)
def test_kinds_are_by_the_true_maneuver(folder, pick, wanted):
    """At random, the one with a whole future is preferred."""
    assert {int(pick_samples(folder, "eval", pick, seed=seed, count=9)[0]) for seed in range(5)} == wanted


def test_a_kind_without_samples_is_refused(folder):
    with pytest.raises(NoSampleError, match="no sample to pick by `lane-keep` among the 2 of part `eval`"):
        pick_samples(folder, "eval", "lane-keep")
    with pytest.raises(NoSampleError, match="among the 0 of part `train`"):
        pick_samples(folder, "train", "random")


def test_draws_repeat_by_seed_and_are_of_the_part_and_kind(many):
    folder, tables = many
    rows = [row for *_, samples, _ in tables for row in samples.sort("vehicle_id", "tick").rows(named=True)]
    lanes = [
        {(vehicle, tick): lane for vehicle, tick, lane in clock.select("vehicle_id", "tick", "lane").rows()}
        for _, clock, *_ in tables
    ]
    draws = [pick_samples(folder, "eval", "lane-change", count=3, seed=seed) for seed in (1, 1, 2)]
    assert draws[0].tolist() == draws[1].tolist()
    for number in np.concatenate(draws).tolist():
        row = rows[number]
        assert (row["subset"], row["lateral_maneuver"] != "keep") == ("b", True)
        last = row["tick"] + int(folder.sample_future[number])
        assert lanes[1][row["vehicle_id"], last] != lanes[1][row["vehicle_id"], row["tick"]], "still to come"
    assert len(set(draws[0].tolist())) == len(draws[0])


def test_the_worst_are_those_a_loop_finds(many, monkeypatch):
    monkeypatch.setattr("tracklake.training.runs.forecasters.BATCH_SIZE", 7)
    folder, tables = many
    judge = open_forecaster("constant-velocity", folder, folder.path, frozenset({"eval"}))
    places = {(v, t): (x, y) for v, t, x, y in tables[1][1].select("vehicle_id", "tick", "x_m", "y_m").rows()}
    samples = folder.samples_of("eval")
    wanted = []
    for number, row in zip(samples, tables[1][2].sort("vehicle_id", "tick").rows(named=True), strict=True):
        vehicle, tick, ticks = row["vehicle_id"], row["tick"], int(folder.sample_future[number])
        (x, y), (x_before, y_before) = places[vehicle, tick], places[vehicle, tick - 1]
        then_x, then_y = places[vehicle, tick + ticks]
        wanted.append(math.hypot(x + ticks * (x - x_before) - then_x, y + ticks * (y - y_before) - then_y))
    np.testing.assert_allclose(measure_last_distance(folder, samples, judge), wanted, rtol=1e-4, atol=1e-4)
    whole = folder.sample_future[samples] == TINY.horizon_ticks
    assert whole.sum() > 3
    best = samples[whole][np.argsort(-np.array(wanted)[whole])][:3]
    assert pick_samples(folder, "eval", "worst", count=3, judge=judge).tolist() == best.tolist()


def test_the_worst_is_searched_among_some_of_very_many(many, monkeypatch):
    monkeypatch.setattr("tracklake.pipeline.cli.sample_choice.MOST_SEARCHED", 2)
    folder, _ = many
    judge = open_forecaster("constant-velocity", folder, folder.path, frozenset({"eval"}))
    assert len(pick_samples(folder, "eval", "worst", count=5, judge=judge)) == 2


def test_the_worst_needs_a_model(folder):
    with pytest.raises(UsageError, match="needs a model to judge by"):
        pick_samples(folder, "eval", "worst")
