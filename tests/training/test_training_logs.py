"""The logs of a training, and how fast it went."""

import time

import numpy as np
import pytest
import torch
from tiny_network import read_log, register, write_tiny

import training.running.feeding
import training.train
from training.running.feeding import make_resident_reader
from training.surroundings import gather_surroundings
from training.tensors import TensorFolder
from training.train import TrainConfig, train


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


def test_the_logs_say_what_was_done(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    losses = []
    real = training.train.TrainingState.take_step
    monkeypatch.setattr(
        training.train.TrainingState,
        "take_step",
        lambda self, loss, samples: (losses.append((loss, samples)), real(self, loss, samples)),
    )
    train("forgetful", tensors, tmp_path / "run", TrainConfig(log_steps=3))
    course, epochs = (read_log(tmp_path / "run" / name) for name in ("course.csv", "epochs.csv"))
    # 12 steps in three epochs of 4; `mse` ends after 8, and no row is of two phases.
    assert [(int(row["step"]), int(row["epoch"]), row["phase"]) for row in course] == [
        (3, 0, "mse"), (6, 1, "mse"), (8, 1, "mse"), (9, 2, "distance"), (12, 2, "distance")
    ]  # fmt: skip
    of_row = [losses[0:3], losses[3:6], losses[6:8], losses[8:9], losses[9:12]]
    for row, part in zip(course, of_row, strict=True):
        assert float(row["loss"]) == pytest.approx(sum(loss for loss, _ in part) / len(part), rel=1e-12)
    assert [(row["epoch"], row["step"], row["phase"]) for row in epochs] == [
        ("0", "4", "mse"), ("1", "8", "mse"), ("2", "12", "distance")
    ]  # fmt: skip
    for number, row in enumerate(epochs):
        part = [loss for loss, _ in losses[4 * number : 4 * number + 4]]
        assert float(row["loss"]) == pytest.approx(sum(part) / 4, rel=1e-12)
        assert row["validation_loss"] == row["best"] == ""


def test_the_share_of_reading_is_measured(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    real = training.running.feeding.read_samples

    def read_slowly(*given):
        time.sleep(0.02)
        return real(*given)

    monkeypatch.setattr(training.running.feeding, "read_samples", read_slowly)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(steps=9, log_steps=2))
    assert 0.5 < metrics["data_share"] < 1.0
    assert 0 < metrics["samples_per_s"] < 32 / 0.02
    for row in read_log(tmp_path / "run" / "course.csv"):
        assert 0.5 < float(row["data_share"]) < 1.0
        assert 0 < float(row["samples_per_s"]) < 32 / 0.02


def test_a_resident_reader_reads_the_same(tensors):
    folder = TensorFolder.open(tensors)
    samples = folder.samples_of("train")[[5, 0, 7]]
    observed, truth = make_resident_reader(folder, "grid", torch.device("cpu"))(samples)
    batch = folder.gather(samples)
    np.testing.assert_allclose(observed.neighbor_history.numpy(), batch.neighbor_history, atol=1e-4)
    assert observed.neighbor_cell.tolist() == batch.neighbor_cell.tolist()
    assert truth.future_mask.tolist() == batch.future_mask.tolist()
    assert truth.lateral.tolist() == batch.lateral.tolist()


def test_a_resident_reader_of_scenes_reads_the_same(tensors):
    folder = TensorFolder.open(tensors)
    samples = folder.samples_of("train")[[5, 0, 7]]
    observed, truth = make_resident_reader(folder, "scene", torch.device("cpu"))(samples)
    wanted, came = gather_surroundings(folder, samples, nearest=10)
    np.testing.assert_array_equal(observed.history.numpy(), wanted.history)
    np.testing.assert_array_equal(observed.lanes.numpy(), wanted.lanes)
    assert truth.future_mask.tolist() == came.future_mask.tolist()
