"""What the training loop refuses, and parts without samples."""

import polars as pl
import pytest
import torch
from scored_runs import evaluate
from tensor_tables import split_row
from tiny_network import PARTS, register, write_tiny

from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.train import DivergedError, TrainConfig, train

FEW = TrainConfig(steps=9, log_steps=2)


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


# Models that do not learn, parts that are empty


def test_constant_velocity_has_nothing_to_learn_and_is_written_all_the_same(tensors, tmp_path):
    metrics = train("constant-velocity", tensors, tmp_path / "cv")
    assert metrics["steps"] == 0
    assert metrics["evaluation"]["samples"] == evaluate("cv", tensors, tmp_path).samples


def test_without_an_evaluation_part_there_is_no_score(tmp_path):
    folder = write_tiny(tmp_path / "tensors", split_row("a", "train"), subsets="a")
    assert train("constant-velocity", folder, tmp_path / "cv")["evaluation"] is None
    with pytest.raises(TracklakeError, match=r"has no samples in `eval`.*--no-evaluation"):
        train("lstm", folder, tmp_path / "run", FEW)
    assert train("lstm", folder, tmp_path / "run", FEW, without_evaluation=True)["evaluation"] is None


def test_without_a_training_part_there_is_nothing_to_learn_from(tmp_path):
    folder = write_tiny(tmp_path / "tensors", split_row("b", "eval"), subsets="b")
    with pytest.raises(TracklakeError, match="the split `mine` has no samples in `train`"):
        train("lstm", folder, tmp_path / "run", FEW)
    assert [path.name for path in tmp_path.iterdir()] == ["tensors"]


def test_patience_needs_a_validation_part(tmp_path):
    folder = write_tiny(tmp_path / "tensors", PARTS.filter(pl.col("part") != "val"), subsets="ab")
    with pytest.raises(
        TracklakeError, match=r"patience 3 needs samples in `val` .* `mine` has none: set `validation_part"
    ):
        train("lstm", folder, tmp_path / "run", TrainConfig(patience=3))


def test_a_loss_that_explodes_is_told_and_nothing_is_left_to_go_on_from(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    config = TrainConfig(steps=50, learning_rate=1e30, checkpoint_s=1e-9)
    with pytest.raises(DivergedError, match=r"the loss is (nan|inf) after \d+ steps, in phase `mse`: .*below 1e\+30"):
        train("forgetful", tensors, tmp_path / "run", config)
    assert list(tmp_path.iterdir()) == []


def test_a_last_step_that_explodes_leaves_nothing_to_go_on_from(tensors, tmp_path, monkeypatch):
    """Its own loss was a number: it is what the weights predict then that is none."""
    register(monkeypatch)
    with pytest.raises(NotFiniteError, match="`run` predicts positions that are not finite numbers"):
        train("forgetful", tensors, tmp_path / "run", TrainConfig(steps=1, learning_rate=1e30))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("bad", "reported"),
    [
        ({"seconds": 0.0}, "`seconds`: expected more than 0, got 0.0"),
        ({"batch_size": 0}, "`batch_size`: expected more than 0"),
        ({"steps": -1}, "`steps`: expected more than 0"),
        ({"learning_rate": float("nan")}, "`learning_rate`: expected more than 0"),
        ({"seed": -1}, "`seed`: expected 0 or more, got -1"),
        ({"steps": "x"}, "`steps`: expected a whole number, got 'x'"),
        ({"batch_size": 2.5}, "`batch_size`: expected a whole number, got 2.5"),
        ({"seconds": "x"}, "`seconds`: expected a number, got 'x'"),
        ({"parameters": 3}, "`parameters`: expected a table, got 3"),
        ({"steps": 5, "seconds": 2.0}, "expected one of seconds, steps, epochs at most, got seconds 2.0 and steps 5"),
        ({"optimizer": "sgd"}, "`optimizer`: expected 'adam' or 'adamw', got 'sgd'"),
        ({"schedule": "linear"}, "`schedule`: expected 'constant' or 'cosine', got 'linear'"),
    ],
)
def test_settings_that_cannot_train_are_refused(bad, reported):
    with pytest.raises(UsageError, match=reported):
        TrainConfig(**bad)


def test_what_a_model_or_this_machine_lacks_is_refused(tensors, tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="model `lstm` has no parameter heads: expected hidden"):
        train("lstm", tensors, tmp_path / "run", TrainConfig(steps=1, parameters={"heads": 2}))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(TracklakeError, match="expected device `cpu`, or `cuda` where torch finds one, got `cuda`"):
        train("lstm", tensors, tmp_path / "run", TrainConfig(steps=1, device="cuda"))
    assert list(tmp_path.iterdir()) == []
