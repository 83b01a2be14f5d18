"""Errors derived by hand, constant velocity, and what an evaluation refuses."""

import math
import subprocess
import sys

import numpy as np
import polars as pl
import pytest
from tensor_tables import CLOCK, TINY, drive, sample_everything, split_row, write

from schemas.samples import NEIGHBORS, SAMPLES
from training.evaluate import EmptyPartError, evaluate, measure_errors
from training.tensors import TensorFolder

BOTH = pl.concat([split_row("a", "train"), split_row("b", "eval")])


def track(vehicle_id, points):
    """Consecutive ticks of one vehicle through (x, y)."""
    return pl.DataFrame(
        [(vehicle_id, t, 1 + 5 * t, x, y, 1, 0.0, vehicle_id) for t, (x, y) in enumerate(points)],
        schema=CLOCK,
        orient="row",
    )


def sample_at(vehicle_id, tick, *, subset):
    row = ("tiny", "highd", subset, vehicle_id, tick, 1 + 5 * tick, 1, "keep", "normal", None)
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


def test_errors_of_constant_velocity_by_hand(tmp_path):
    result = evaluate("constant-velocity", two_samples(tmp_path / "tensors"), tmp_path / "models")
    assert (result.model, result.part, result.split, result.samples) == ("constant-velocity", "eval", "mine", 2)
    after_1_s, after_2_s = result.horizons
    assert (after_1_s.seconds, after_1_s.n) == (1, 2)
    assert after_1_s.rmse_m == pytest.approx(math.sqrt((3**2 + 4**2) / 2), rel=1e-6)
    assert after_1_s.rmse_longitudinal_m == pytest.approx(3 / math.sqrt(2), rel=1e-6)
    assert after_1_s.rmse_lateral_m == pytest.approx(4 / math.sqrt(2), rel=1e-6)
    assert after_1_s.mae_m == pytest.approx(2.5, rel=1e-6)
    assert (after_2_s.seconds, after_2_s.n) == (2, 1)
    assert after_2_s.rmse_m == pytest.approx(0.0, abs=1e-6)
    assert result.to_dict()["horizons"][0]["n"] == 2


class Still:
    """Predicts that everybody stops at once."""

    def predict(self, batch):
        return np.zeros_like(batch.future)


class Nowhere:
    def predict(self, batch):
        return np.full_like(batch.future, np.nan)


def test_errors_equal_a_loop_over_samples(tmp_path, monkeypatch):
    monkeypatch.setattr("training.evaluate.BATCH_SIZE", 7)
    draw = np.random.default_rng(3)
    tables = []
    for subset in "ab":
        clock = drive(draw, vehicles=6, ticks=15)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    folder = TensorFolder.open(write(tmp_path, tables, BOTH))
    result = measure_errors(Still(), folder, "eval", name="still")
    where = {(v, t): (x, y) for v, t, x, y in tables[1][1].select("vehicle_id", "tick", "x_m", "y_m").iter_rows()}
    for horizon in result.horizons:
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


def test_a_horizon_that_no_sample_reaches_has_no_error(tmp_path):
    clock = track(1, [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)])
    tables = [("b", clock, sample_at(1, 2, subset="b"), NEIGHBORS.empty())]
    result = evaluate("constant-velocity", write(tmp_path, tables, split_row("b", "eval")), tmp_path)
    assert [(horizon.n, horizon.rmse_m, horizon.mae_m) for horizon in result.horizons] == [(0, None, None)] * 2


def test_an_empty_part_is_explained(tmp_path):
    with pytest.raises(EmptyPartError, match="no samples in `train` \\(samples: train 0, val 0, eval 2\\)"):
        evaluate("constant-velocity", two_samples(tmp_path), tmp_path, part="train")


def test_predictions_that_are_not_numbers_are_refused(tmp_path):
    folder = TensorFolder.open(two_samples(tmp_path))
    with pytest.raises(ValueError, match="`nan` predicts positions that are not finite"):
        measure_errors(Nowhere(), folder, "eval", name="nan")


def test_unknown_and_untrained_models(tmp_path):
    tensors = two_samples(tmp_path / "tensors")
    with pytest.raises(ValueError, match="unknown model `cv`: expected one of constant-velocity, lstm"):
        evaluate("cv", tensors, tmp_path)
    with pytest.raises(FileNotFoundError, match="no trained run; run `tracklake train lstm` first"):
        evaluate("lstm", tensors, tmp_path)


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None  # importing it now fails as if it were not installed
from pathlib import Path
from training.evaluate import evaluate
from training.train import train
tensors, models = map(Path, sys.argv[1:])
print(evaluate("constant-velocity", tensors, models).samples)
try:
    train("lstm", tensors, models / "lstm")
except ImportError as error:
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
    assert message == 'the model `lstm` needs torch, which is not installed: pip install "tracklake[training]"'
