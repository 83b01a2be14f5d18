"""A tiny training run: it learns, repeats by seed, is written at once and can be evaluated later."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from tensor_tables import drive, sample_everything, split_row, write

from schemas.protocols import CSP
from training.evaluate import evaluate
from training.models import find_model
from training.tensors import TensorFolder
from training.train import TrainConfig, train

CONFIG = TrainConfig(seconds=30.0, steps=60, batch_size=64, hidden=16, threads=1)
SPLITS = pl.concat([split_row("a", "train"), split_row("b", "eval")])


def make_tables(seed=0, subsets="ab"):
    draw = np.random.default_rng(seed)
    tables = []
    for subset in subsets:
        clock = drive(draw, vehicles=12, ticks=45)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset, protocol=CSP)))
    return tables


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write(tmp_path_factory.mktemp("tensors"), make_tables(), SPLITS, protocol=CSP)


@pytest.fixture(scope="module")
def trained(tensors, tmp_path_factory):
    models = tmp_path_factory.mktemp("models")
    told = []
    metrics = train("lstm", tensors, models / "run", CONFIG, lambda spent, loss: told.append((spent, loss)))
    return models, metrics, told


def test_training_reduces_the_loss_and_beats_constant_velocity(trained, tensors):
    models, metrics, told = trained
    assert metrics["steps"] == 60
    assert metrics["loss_last_m2"] < 0.5 * metrics["loss_first_m2"]
    plain = evaluate("constant-velocity", tensors, models).horizons
    learned = evaluate("run", tensors, models).horizons
    assert [row.n for row in learned] == [row.n for row in plain]
    assert learned[-1].rmse_m < 0.8 * plain[-1].rmse_m
    assert [spent for spent, _ in told] == sorted(spent for spent, _ in told)
    assert told[-1][0] == 1.0


def test_what_is_written_says_how_it_came_about(trained, tensors):
    models, metrics, _ = trained
    assert json.loads((models / "run" / "metrics.json").read_text()) == metrics
    config = json.loads((models / "run" / "config.json").read_text())
    assert (config["model"], config["parameters"], config["split"]) == ("lstm", {"hidden": 16}, "mine")
    assert config["train_subsets"] == ["highd/a"]
    assert config["protocol"]["digest"] == CSP.digest
    assert config["training"]["seed"] == 0
    assert metrics["train_samples"] == len(TensorFolder.open(tensors).samples_of("train"))
    assert metrics["evaluation"]["horizons"] == evaluate("run", tensors, models).to_dict()["horizons"]
    assert sorted(path.name for path in models.iterdir()) == ["run"]


def test_the_same_seed_gives_the_same_weights(tensors, tmp_path):
    few = replace(CONFIG, steps=4)
    losses = [
        [row["loss_m2"] for row in train("lstm", tensors, tmp_path / name, replace(few, seed=seed))["losses"]]
        for name, seed in (("one", 1), ("two", 1), ("three", 2))
    ]
    assert losses[0] == losses[1]
    assert losses[0] != losses[2]


def test_a_run_is_replaced_at_once(tensors, tmp_path):
    for steps in (1, 2):
        metrics = train("lstm", tensors, tmp_path / "run", replace(CONFIG, steps=steps))
    assert metrics["steps"] == 2
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_time_budget_ends_the_training(tensors, tmp_path):
    metrics = train("lstm", tensors, tmp_path / "run", replace(CONFIG, steps=None, seconds=0.3))
    assert 0 < metrics["seconds"] < 1.5
    assert metrics["steps"] > 0


def test_untrained_lstm_predicts_constant_velocity(tensors):
    folder = TensorFolder.open(tensors)
    batch = folder.gather(folder.samples_of("eval")[:50])
    wanted = find_model("constant-velocity").build(folder.protocol).predict(batch)
    got = find_model("lstm").build(folder.protocol, hidden=8).predict(batch)
    assert got.shape == (50, CSP.horizon_ticks, 2)
    np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-5)


def test_constant_velocity_has_nothing_to_learn_and_is_written_all_the_same(tensors, tmp_path):
    metrics = train("constant-velocity", tensors, tmp_path / "cv")
    assert metrics["steps"] == 0
    assert metrics["evaluation"]["samples"] == evaluate("cv", tensors, tmp_path).samples


def test_without_an_evaluation_part_there_is_no_score(tmp_path):
    everything_trains = pl.concat([split_row("a", "train"), split_row("b", "train")])
    folder = write(tmp_path / "tensors", make_tables(), everything_trains, protocol=CSP)
    assert train("constant-velocity", folder, tmp_path / "cv")["evaluation"] is None


def test_without_a_training_part_there_is_nothing_to_learn_from(tmp_path):
    folder = write(tmp_path / "tensors", make_tables(), split_row("b", "eval"), protocol=CSP)
    with pytest.raises(ValueError, match="the split `mine` has no samples in `train`"):
        train("lstm", folder, tmp_path / "run", CONFIG)


def test_a_run_is_not_evaluated_on_what_it_was_trained_on(trained, tmp_path):
    models, *_ = trained
    swapped = pl.concat([split_row("a", "eval"), split_row("b", "train")])
    folder = write(tmp_path / "tensors", make_tables(), swapped, protocol=CSP)
    with pytest.raises(ValueError, match="1 subset\\(s\\) of `eval` \\(highd/a\\) were in its training part"):
        evaluate("run", folder, models)


def test_what_never_learned_cannot_have_seen_anything(tensors, tmp_path):
    for name in ("constant-velocity", "cv"):
        train("constant-velocity", tensors, tmp_path / name)
    swapped = pl.concat([split_row("a", "eval"), split_row("b", "train")])
    folder = write(tmp_path / "tensors", make_tables(), swapped, protocol=CSP)
    for name in ("constant-velocity", "cv"):
        assert evaluate(name, folder, tmp_path).samples > 0


def test_a_run_meets_new_recordings(trained, tmp_path):
    models, *_ = trained
    splits = pl.concat([SPLITS, split_row("c", "eval")])
    folder = write(tmp_path / "tensors", make_tables(subsets="abc"), splits, protocol=CSP)
    assert evaluate("run", folder, models).samples > 0


def test_a_run_of_another_protocol_is_refused(trained, tmp_path):
    models, *_ = trained
    other = replace(CSP, horizon_s=3.0)
    folder = write(tmp_path / "tensors", make_tables(), SPLITS, protocol=other)
    with pytest.raises(ValueError, match=r"trained for the protocol csp \(.*train it again"):
        evaluate("run", folder, models)


def test_no_time_for_one_step(tensors, tmp_path):
    with pytest.raises(ValueError, match="not one step was done"):
        train("lstm", tensors, tmp_path / "run", replace(CONFIG, seconds=1e-9))
    assert list(tmp_path.iterdir()) == []


def test_a_loss_that_explodes_is_told(tensors, tmp_path):
    with pytest.raises(ValueError, match=r"the loss is (nan|inf) after"):
        train("lstm", tensors, tmp_path / "run", replace(CONFIG, learning_rate=1e30))


@pytest.mark.parametrize("bad", [{"seconds": 0.0}, {"batch_size": 0}, {"steps": -1}, {"learning_rate": float("nan")}])
def test_settings_that_cannot_train_are_refused(bad):
    with pytest.raises(ValueError, match=f"expected `{next(iter(bad))}` above 0"):
        TrainConfig(**bad)
