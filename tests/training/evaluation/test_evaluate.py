"""Errors derived by hand, constant velocity, and what an evaluation refuses."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import polars as pl
import pytest
from scored_runs import evaluate
from tensor_tables import CLOCK, TINY, drive, finding, sample_everything, split_row, write

from tracklake.schemas.comparisons import VEHICLE_ERRORS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.evaluations import EVALUATIONS
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import EmptyPartError, measure_errors
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import Density, NotFiniteError, Prediction
from tracklake.training.runs.forecasters import Forecaster, UnknownRunError

BOTH = pl.concat([split_row("a", "train"), split_row("b", "eval")])


def list_rows(frame):
    """The rows of a frame, with the columns as attributes."""
    return [SimpleNamespace(**row) for row in frame.iter_rows(named=True)]


def track(vehicle_id, points):
    """Consecutive ticks of one vehicle through (x, y)."""
    return pl.DataFrame(
        [(vehicle_id, t, 1 + 5 * t, x, y, 1, 0.0, vehicle_id) for t, (x, y) in enumerate(points)],
        schema=CLOCK,
        orient="row",
    )


def sample_at(vehicle_id, tick, *, subset, maneuvers=("keep", "normal")):
    row = ("tiny", "highd", subset, vehicle_id, tick, 1 + 5 * tick, 1, *maneuvers, None)
    return pl.DataFrame([row], schema=SAMPLES.dtypes, orient="row")


def two_samples(folder):
    """Two samples in eval at 2 Hz: one known for 2 s, one for 1 s.

    Both drove 2 m a tick along the road and 0.5 m across it. Constant velocity says (4, 1) after 1 s, (8, 2) after 2 s.
    The first is at (7, 5) and (8, 2) instead: 3 m and 4 m away, then none. The second at (4, 1) after 1 s: none.
    """
    past = [(-4.0, -1.0), (-2.0, -0.5), (0.0, 0.0)]
    clock = pl.concat(
        [
            track(1, [*past, (2.0, 0.5), (7.0, 5.0), (6.0, 1.5), (8.0, 2.0)]),
            track(2, [*past, (2.0, 0.5), (4.0, 1.0)]),
        ]
    )
    samples = pl.concat([sample_at(1, 2, subset="b"), sample_at(2, 2, subset="b")])
    nothing = ("a", pl.DataFrame(schema=CLOCK), SAMPLES.empty(), NEIGHBORS.empty())
    return write(folder, [nothing, ("b", clock, samples, NEIGHBORS.empty())], BOTH)


@pytest.mark.parametrize("stored", ["lane centres", "recorded", None])
def test_lane_centres_leave_errors_along_the_road_alone(tmp_path, stored):
    folder = two_samples(tmp_path / "tensors")
    index = json.loads((folder / "index.json").read_text())
    for subset in index["subsets"]:
        assert subset.pop("lateral_positions") == "recorded"
        subset |= {} if stored is None else {"lateral_positions": stored}  # older tensors do not say
    (folder / "index.json").write_text(json.dumps(index))
    result = evaluate("constant-velocity", folder, tmp_path / "models")
    known = stored != "lane centres"
    errors = VEHICLE_ERRORS.validate(result.to_vehicle_errors(), where="here")
    for figures in (*result.horizons.to_dicts(), *errors.to_dicts()):
        lateral = {name for name in figures if name.endswith(("_m", "_m2")) and "longitudinal" not in name}
        assert len(lateral) in (2, 6)
        assert {figures[name] is not None for name in lateral} == {known}
    assert result.horizons["rmse_longitudinal_m"][0] == pytest.approx(3 / math.sqrt(2), rel=1e-6)
    assert result.horizons["mae_longitudinal_m"][0] == pytest.approx(3 / 2, rel=1e-6)
    assert errors["squared_longitudinal_m2"].sum() == pytest.approx(3**2, rel=1e-6)


def test_lane_centres_of_one_recording_leave_those_of_others(tmp_path):
    """Vehicle 1 of `b` is recorded and 3 m off along the road; vehicle 2 of `c` is at lane centres."""
    past = [(-4.0, -1.0), (-2.0, -0.5), (0.0, 0.0)]
    moved = track(1, [*past, (2.0, 0.5), (7.0, 5.0)]), track(2, [*past, (2.0, 0.5), (4.0, 2.0)])
    tables = [
        (subset, clock, sample_at(number, 2, subset=subset), NEIGHBORS.empty())
        for number, (subset, clock) in enumerate(zip("bc", moved, strict=True), 1)
    ]
    parts = pl.concat([split_row("b", "eval"), split_row("c", "eval")])
    folder = TensorFolder.open(write(tmp_path / "tensors", tables, parts))
    folder.index["subsets"][1]["lateral_positions"] = "lane centres"
    both, recorded, centred = (
        list_rows(evaluate("constant-velocity", own, tmp_path).horizons)[0]
        for own in (folder, folder.narrow(recording="b"), folder.narrow(recording="c"))
    )
    assert (both.rmse_m, both.n) == (None, 2)
    assert both.rmse_longitudinal_m == pytest.approx(3 / math.sqrt(2), rel=1e-6)
    assert (recorded.rmse_m, recorded.rmse_lateral_m) == (pytest.approx(5, rel=1e-6), pytest.approx(4, rel=1e-6))
    assert (centred.rmse_m, centred.rmse_longitudinal_m) == (None, pytest.approx(0, abs=1e-6))


def test_errors_of_constant_velocity_by_hand(tmp_path):
    result = evaluate("constant-velocity", two_samples(tmp_path / "tensors"), tmp_path / "models")
    assert (result.model, result.part, result.split, result.samples) == ("constant-velocity", "eval", "mine", 2)
    after_1_s, after_2_s = list_rows(result.horizons)
    assert (after_1_s.seconds, after_1_s.n) == (1, 2)
    assert after_1_s.rmse_m == pytest.approx(math.sqrt((3**2 + 4**2) / 2), rel=1e-6)
    assert after_1_s.rmse_longitudinal_m == pytest.approx(3 / math.sqrt(2), rel=1e-6)
    assert after_1_s.rmse_lateral_m == pytest.approx(4 / math.sqrt(2), rel=1e-6)
    assert after_1_s.mae_m == pytest.approx(2.5, rel=1e-6)
    assert (after_2_s.seconds, after_2_s.n) == (2, 1)
    assert after_2_s.rmse_m == pytest.approx(0.0, abs=1e-6)
    assert result.to_dict()["horizons"][0]["n"] == 2
    errors = VEHICLE_ERRORS.validate(result.to_vehicle_errors(), where="here")
    assert errors.drop("squared_longitudinal_m2", "squared_lateral_m2", "distance_m").rows() == [
        ("constant-velocity", "constant-velocity", None, "highd", "b", vehicle, seconds, 1, None)
        for vehicle, seconds in ((1, 1.0), (1, 2.0), (2, 1.0))
    ]
    assert errors["squared_longitudinal_m2"].to_list() == pytest.approx([9, 0, 0], abs=1e-6)
    assert errors["squared_lateral_m2"].to_list() == pytest.approx([16, 0, 0], abs=1e-6)
    assert errors["distance_m"].to_list() == pytest.approx([5, 0, 0], abs=1e-6)


class Says:
    """Predicts the same place for everybody at every tick."""

    def __init__(self, place=0.0, **further):
        self.place, self.further = place, further

    def predict(self, observed):
        samples = len(observed.history)
        position = np.full((samples, TINY.horizon_ticks, 2), self.place, dtype=np.float32)
        return Prediction(position, **{name: give(samples) for name, give in self.further.items()})


def test_errors_equal_a_loop_over_samples(tmp_path, monkeypatch):
    monkeypatch.setattr("tracklake.training.runs.forecasters.BATCH_SIZE", 7)
    draw = np.random.default_rng(3)
    tables = []
    for subset in "ab":
        clock = drive(draw, vehicles=6, ticks=15)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    folder = TensorFolder.open(write(tmp_path, tables, BOTH))
    result = measure_errors(Forecaster("still", Says()), folder, "eval")
    where = {(v, t): (x, y) for v, t, x, y in tables[1][1].select("vehicle_id", "tick", "x_m", "y_m").iter_rows()}
    for horizon in list_rows(result.horizons):
        errors = []
        for sample in tables[1][2].iter_rows(named=True):
            now = where[sample["vehicle_id"], sample["tick"]]
            then = where.get((sample["vehicle_id"], sample["tick"] + horizon.seconds * TINY.rate_hz))
            if then is not None:
                errors.append((then[0] - now[0], then[1] - now[1]))
        n = len(errors)
        assert horizon.n == n > 0
        assert horizon.rmse_m == pytest.approx(math.sqrt(sum(dx**2 + dy**2 for dx, dy in errors) / n), rel=1e-5)
        assert horizon.rmse_longitudinal_m == pytest.approx(math.sqrt(sum(dx**2 for dx, _ in errors) / n), rel=1e-5)
        assert horizon.rmse_lateral_m == pytest.approx(math.sqrt(sum(dy**2 for _, dy in errors) / n), rel=1e-3)
        assert horizon.mae_m == pytest.approx(sum(math.hypot(dx, dy) for dx, dy in errors) / n, rel=1e-5)


@pytest.mark.parametrize("severity", ["info", "warning", "error"])
def test_rows_of_a_part_by_vehicle_maneuver_findings_and_dataset(tmp_path, severity):
    """Vehicle 1 of subset b stops 3 m short of where it is said to be, vehicle 1 of subset c 1 m; b's has a finding."""
    stops = [(0.0, 0.0)] * 5
    tables = [
        ("a", pl.DataFrame(schema=CLOCK), SAMPLES.empty(), NEIGHBORS.empty()),
        ("b", track(1, stops), sample_at(1, 2, subset="b"), NEIGHBORS.empty()),
        ("c", track(1, stops), sample_at(1, 2, subset="c", maneuvers=("left", "brake")), NEIGHBORS.empty()),
    ]
    splits = pl.concat([BOTH, split_row("c", "eval")])
    findings = finding(1, severity, 1 + 5 * 3, 1 + 5 * 3, subset="b")
    plain = TensorFolder.open(write(tmp_path, tables, splits, findings=findings))
    subsets = [
        own | {"dataset": dataset}
        for own, dataset in zip(plain.index["subsets"], ("highd", "highd", "ngsim"), strict=True)
    ]
    folder = replace(plain, index=plain.index | {"subsets": subsets})

    class OneThenTheOther(Says):
        """3 m for a sample alone in its batch or the first of several, 1 m for the second."""

        def predict(self, observed):
            said = super().predict(observed)
            said.position_m[0, :, 0] = 3.0
            said.position_m[1:, :, 0] = 1.0
            return said

    with mock.patch("tracklake.training.evaluation.evaluate.refuse_future"):
        result = measure_errors(Forecaster("one", OneThenTheOther()), folder, "eval")
    assert (result.samples, result.vehicles) == (2, 2), "the same id in two subsets is two vehicles"
    found = {(row.dataset, row.group, row.average): row for row in list_rows(result.scores) if row.seconds == 1.0}
    expected = {
        ("all", "all"): (2, 2.0),
        ("all", "lateral=keep"): (1, 3.0),
        ("all", "lateral=left"): (1, 1.0),
        ("all", "lateral=right"): (0, None),
        ("all", "longitudinal=normal"): (1, 3.0),
        ("all", "longitudinal=brake"): (1, 1.0),
        ("all", "findings=touched"): (0, None) if severity == "info" else (1, 3.0),
        ("all", "findings=untouched"): (2, 2.0) if severity == "info" else (1, 1.0),
        ("all", "findings=error"): (1, 3.0) if severity == "error" else (0, None),
        ("all", "findings=no error"): (1, 1.0) if severity == "error" else (2, 2.0),
        ("highd", "all"): (1, 3.0),
        ("highd", "lateral=left"): (0, None),
        ("ngsim", "all"): (1, 1.0),
        ("ngsim", "findings=touched"): (0, None),
        ("ngsim", "findings=no error"): (1, 1.0),
    }
    for (dataset, group), (n, mae_m) in expected.items():
        for average in ("samples", "vehicles"):
            row = found[dataset, group, average]
            assert (row.n, row.vehicles, row.mae_m) == (n, n, mae_m), (dataset, group)


def test_a_vehicle_seen_twice_is_one(tmp_path):
    """Its track has a gap: two runs, and a sample on each."""
    clock = pl.concat([track(1, [(0.0, 0.0)] * 5), track(1, [(9.0, 0.0)] * 5)])
    clock = clock.with_columns(
        pl.Series("tick", [*range(5), *range(6, 11)], dtype=pl.Int32),
        pl.Series("segment", [1] * 5 + [2] * 5, dtype=pl.Int32),
    ).with_columns(frame=1 + 5 * pl.col("tick"))
    samples = pl.concat([sample_at(1, 2, subset="b"), sample_at(1, 8, subset="b")])
    folder = TensorFolder.open(write(tmp_path, [("b", clock, samples, NEIGHBORS.empty())], split_row("b", "eval")))
    result = measure_errors(Forecaster("still", Says()), folder, "eval")
    assert (result.samples, result.vehicles) == (2, 1)
    assert [(row.n, row.vehicles) for row in list_rows(result.horizons)] == [(2, 1), (0, 0)]


def test_the_table_of_an_evaluation(tmp_path):
    tensors = two_samples(tmp_path / "tensors")
    result = evaluate("constant-velocity", tensors, tmp_path / "models", with_latency=True)
    table = EVALUATIONS.validate(result.to_table(), where="here")
    # 1 + 3 lateral + 2 longitudinal + 2 by findings twice; over all and of highd; two averages; 1 and 2 s.
    assert table.height == 10 * 2 * 2 * 2
    assert table.select(
        "protocol", "protocol_digest", "split", "part", "origin", "model", "reference"
    ).unique().rows() == [(TINY.name, TINY.digest, "mine", "eval", "measured", "constant-velocity", "")]
    everything = (pl.col("dataset") == "all") & (pl.col("group") == "all")
    timed = table.filter(everything)
    assert timed["latency_ms"].min() > 0
    assert timed["latency_samples"].unique().to_list() == [2.0], "both samples are at one moment"
    assert table.filter(~everything)["latency_ms"].null_count() == table.height - timed.height
    (after_1_s,) = timed.filter((pl.col("average") == "samples") & (pl.col("seconds") == 1.0)).to_dicts()
    assert (after_1_s["n"], after_1_s["vehicles"]) == (2, 2)
    assert after_1_s["mae_m"] == pytest.approx(2.5, rel=1e-6)
    # The first is right after half a second and 5 m off after a whole one; the second is right both times.
    assert after_1_s["ade_m"] == pytest.approx((0 + 5 + 0 + 0) / 4, rel=1e-6)
    assert after_1_s["lateral_accuracy"] is None
    assert after_1_s["majority_lateral_share"] == 1.0


def test_density_and_maneuvers_are_scored(tmp_path):
    def even(samples):
        return np.tile([0.2, 0.5, 0.3], (samples, 1))

    def wide(samples):
        ones = np.ones((samples, 1, TINY.horizon_ticks))
        return Density(ones[:, :, 0], np.zeros((*ones.shape, 2)), 2.0 * np.ones((*ones.shape, 2)), 0.0 * ones)

    folder = TensorFolder.open(two_samples(tmp_path))
    said = Says(lateral=even, density=wide)
    after_1_s, after_2_s = list_rows(measure_errors(Forecaster("says", said), folder, "eval").horizons)
    assert after_1_s.lateral_accuracy == 0.0, "left is said, and both keep their lane"
    assert after_1_s.longitudinal_accuracy is None
    # The samples are at (7, 5) and (4, 1) after 1 s, the first at (8, 2) after 2 s; sigma is 2 m either way.
    around = math.log(2 * math.pi * 4)
    assert after_1_s.nll_nats == pytest.approx(around + ((49 + 25) / 8 + (16 + 1) / 8) / 2, rel=1e-6)
    assert after_2_s.nll_nats == pytest.approx(around + (64 + 4) / 8, rel=1e-6)


def test_a_density_that_is_none_is_refused(tmp_path):
    def flat(samples):
        ones = np.ones((samples, 1, TINY.horizon_ticks))
        return Density(ones[:, :, 0], np.zeros((*ones.shape, 2)), np.zeros((*ones.shape, 2)), 0.0 * ones)

    folder = TensorFolder.open(two_samples(tmp_path))
    with pytest.raises(NotFiniteError, match="`flat` predicts densities that are not finite"):
        measure_errors(Forecaster("flat", Says(density=flat)), folder, "eval")


def test_other_horizons_can_be_asked_for(tmp_path):
    folder = TensorFolder.open(two_samples(tmp_path))
    model = ConstantVelocity(TINY)
    result = measure_errors(Forecaster("cv", model), folder, "eval", seconds=(0.5, 1.5))
    assert [(row.seconds, row.n) for row in list_rows(result.horizons)] == [(0.5, 2), (1.5, 1)]


def test_every_tick_of_the_horizon_can_be_asked_for(tmp_path):
    seconds = (0.5, 1.0, 1.5, 2.0)
    result = evaluate("constant-velocity", two_samples(tmp_path / "tensors"), tmp_path, seconds=seconds)
    # After a second the first is 5 m off; otherwise both are where they are said to be, as long as they are known.
    expected = [(0.5, 2, 0.0), (1.0, 2, 2.5), (1.5, 1, 0.0), (2.0, 1, 0.0)]
    assert [(row.seconds, row.n, pytest.approx(row.mae_m, abs=1e-6)) for row in list_rows(result.horizons)] == expected


def test_a_model_of_scenes_is_scored_by_its_egos(tmp_path):
    """Two vehicles side by side, each the other's neighbor; a model that says everybody goes on as it went."""
    folder = TensorFolder.open(two_samples(tmp_path))

    class ByScene:
        def predict(self, observed):
            ego = observed.history[:, 0]
            assert observed.history.shape[1] == 1 + 3
            step = ego[:, -1] - ego[:, -2]
            return Prediction(step[:, None] * np.arange(1, TINY.horizon_ticks + 1, dtype=np.float32)[:, None])

    by_scene = measure_errors(Forecaster("scene", ByScene(), "scene"), folder, "eval", nearest=3)
    by_grid = measure_errors(Forecaster("grid", ConstantVelocity(TINY)), folder, "eval")
    assert by_scene.horizons.equals(by_grid.horizons)
    assert by_scene.horizons["mae_m"][0] == pytest.approx(2.5, rel=1e-6)
    assert by_scene.to_table()["nearest"].unique().to_list() == [3]
    assert by_grid.to_table()["nearest"].unique().to_list() == [None], "a model of the grid is shown no more or fewer"


def test_a_horizon_that_no_sample_reaches_has_no_error(tmp_path):
    clock = track(1, [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)])
    tables = [("b", clock, sample_at(1, 2, subset="b"), NEIGHBORS.empty())]
    result = evaluate("constant-velocity", write(tmp_path, tables, split_row("b", "eval")), tmp_path)
    assert [(horizon.n, horizon.rmse_m, horizon.mae_m) for horizon in list_rows(result.horizons)] == [
        (0, None, None)
    ] * 2


def test_an_empty_part_is_explained(tmp_path):
    with pytest.raises(EmptyPartError, match="no samples in `train` \\(samples: train 0, val 0, eval 2\\)"):
        evaluate("constant-velocity", two_samples(tmp_path), tmp_path, part="train")


def test_a_prediction_of_another_shape_is_refused(tmp_path):
    """Places of one tick would be broadcast over all of them."""

    class OneTick(Says):
        def predict(self, observed):
            return Prediction(super().predict(observed).position_m[:, :1])

    folder = TensorFolder.open(two_samples(tmp_path))
    with pytest.raises(TracklakeError, match=r"`short`: expected places of shape \(2, 4, 2\), got \(2, 1, 2\)"):
        measure_errors(Forecaster("short", OneTick()), folder, "eval")


def test_predictions_that_are_not_numbers_are_refused(tmp_path):
    folder = TensorFolder.open(two_samples(tmp_path))
    with pytest.raises(NotFiniteError, match="`nan` predicts positions that are not finite"):
        measure_errors(Forecaster("nan", Says(np.nan)), folder, "eval")


def test_unknown_and_untrained_models(tmp_path):
    tensors = two_samples(tmp_path / "tensors")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").touch()
    with pytest.raises(
        UnknownRunError,
        match=r"no run or model `cv` .did you mean ctrv.*: expected one of the runs mine, .*constant-velocity",
    ):
        evaluate("cv", tensors, tmp_path)
    with pytest.raises(UnknownRunError, match="no trained run; run `tracklake train lstm` first"):
        evaluate("lstm", tensors, tmp_path)


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None  # importing it now fails as if it were not installed
from pathlib import Path
from tracklake.schemas.errors import MissingExtraError
from tracklake.training.train import train
tensors, models = map(Path, sys.argv[1:])
print(train("constant-velocity", tensors, models / "cv")["evaluation"]["samples"])
try:
    train("lstm", tensors, models / "lstm")
except MissingExtraError as error:
    print(error)
"""


def test_constant_velocity_needs_no_torch_and_lstm_says_what_to_install(tmp_path):
    draw = np.random.default_rng(3)
    clock = drive(draw, vehicles=2, ticks=8)
    tables = [(s, clock, *sample_everything(draw, clock, dataset="highd", subset=s)) for s in "ab"]
    tensors = write(tmp_path / "tensors", tables, BOTH)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH, str(tensors), str(tmp_path / "models")],
        capture_output=True,
        text=True,
        check=True,
    )
    samples, message = done.stdout.splitlines()
    assert int(samples) == tables[1][2].height
    assert message == (
        'the model `lstm` needs the extra [training] (not installed: torch): pip install "tracklake[training]"'
    )
