"""The logs of a training, and how fast it went."""

import time
from dataclasses import fields

import numpy as np
import pytest
import torch
from tiny_network import read_log, register, write_tiny

import tracklake.training.loop
from tracklake.training.data.gathers import gather_nearest, read_samples
from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder
from tracklake.training.train import TrainConfig, train


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


def test_the_logs_say_what_was_done(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    losses = []
    real = tracklake.training.loop.TrainingState.count_step
    monkeypatch.setattr(
        tracklake.training.loop.TrainingState,
        "count_step",
        lambda self, loss, *counts: (losses.append((loss, counts[0])), real(self, loss, *counts)),
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
    real = tracklake.training.loop.read_samples

    def read_slowly(*given):
        time.sleep(0.1)
        return real(*given)

    monkeypatch.setattr(tracklake.training.loop, "read_samples", read_slowly)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(steps=9, log_steps=2))
    assert 0.5 < metrics["data_share"] < 1.0
    assert 0 < metrics["samples_per_s"] < 32 / 0.1
    for row in read_log(tmp_path / "run" / "course.csv"):
        assert 0.5 < float(row["data_share"]) < 1.0
        assert 0 < float(row["samples_per_s"]) < 32 / 0.1


def test_an_epoch_with_two_losses_is_told_by_its_last(tensors, tmp_path, monkeypatch):
    """9 steps, 4 an epoch: `mse` until the sixth. Squares of metres are not averaged with metres."""
    register(monkeypatch)
    train("forgetful", tensors, tmp_path / "run", TrainConfig(steps=9, log_steps=1))
    loss = [float(row["loss"]) for row in read_log(tmp_path / "run" / "course.csv")]
    rows = read_log(tmp_path / "run" / "epochs.csv")
    assert [row["phase"] for row in rows] == ["mse", "distance", "distance"]
    reported = [float(row["loss"]) for row in rows]
    assert reported == pytest.approx([sum(loss[:4]) / 4, (loss[6] + loss[7]) / 2, loss[8]])


def test_a_device_reader_reads_the_same(tensors):
    folder = TensorFolder.open(tensors)
    samples = folder.samples_of("train")[[5, 0, 7]]
    observed, truth = read_samples(DeviceFolder(folder, torch.device("cpu")), torch.from_numpy(samples), "grid")
    batch = folder.gather(samples)
    for got in (observed, truth):
        for own in fields(got):
            np.testing.assert_array_equal(getattr(got, own.name).numpy(), getattr(batch, own.name), err_msg=own.name)


def test_a_device_reader_of_scenes_reads_the_same(tensors):
    folder = TensorFolder.open(tensors)
    samples = folder.samples_of("train")[[5, 0, 7]]
    observed, truth = read_samples(DeviceFolder(folder, torch.device("cpu")), torch.from_numpy(samples), "scene")
    wanted, came = gather_nearest(folder, samples, nearest=10)
    for got, want in ((observed, wanted), (truth, came)):
        for own in fields(got):
            np.testing.assert_array_equal(getattr(got, own.name).numpy(), getattr(want, own.name), err_msg=own.name)
