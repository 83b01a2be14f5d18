"""A model that sees the future is refused before it is trained, and none that has seen it leaves a checkpoint."""

from dataclasses import replace

import pytest
from tensor_tables import split_row
from tiny_network import Forgetful, register, write_tiny

from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.prediction import Prediction
from tracklake.training.train import TrainConfig, train

CONFIG = TrainConfig(epochs=1)


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


class Peeks(Forgetful):
    """Holds the tensors, and where it is not honest, what it predicts depends on the speeds of all rows."""

    folder, honest = None, False

    def predict_tensors(self, observed):
        said = super().predict_tensors(observed)
        moved = 0.0 if self.honest else float(self.folder.speed_mps.sum())
        return Prediction(position_m=said.position_m + moved)


def test_a_model_that_sees_the_future_is_refused_before_its_first_step(tensors, tmp_path, monkeypatch):
    built = register(monkeypatch, Peeks)
    folder = TensorFolder.open(tensors)
    monkeypatch.setattr("tracklake.training.train.TensorFolder.open", lambda _: folder)
    Peeks.folder, Peeks.honest = folder, False
    for steps in (1, 2):  # and again: nothing stands in the way
        with pytest.raises(FutureInputError, match="`forgetful` sees the future"):
            train("forgetful", tensors, tmp_path / "run", CONFIG)
        assert len(built) == steps
        assert built[-1].seen == [], "not one step"
        assert list(tmp_path.iterdir()) == []


def test_one_that_learns_to_see_it_leaves_no_checkpoint(tensors, tmp_path, monkeypatch):
    register(monkeypatch, Peeks)
    folder = TensorFolder.open(tensors)
    monkeypatch.setattr("tracklake.training.train.TensorFolder.open", lambda _: folder)
    Peeks.folder, Peeks.honest = folder, True

    def turn(spent, _loss):
        Peeks.honest = spent < 1

    with pytest.raises(FutureInputError, match="`run` sees the future"):
        train("forgetful", tensors, tmp_path / "run", replace(CONFIG, checkpoint_s=1e-9), turn)
    assert list(tmp_path.iterdir()) == []


def test_without_an_evaluation_part_the_training_part_tells(tmp_path, monkeypatch):
    tensors = write_tiny(tmp_path / "tensors", split_row("a", "train"), subsets="a")
    register(monkeypatch, Peeks)
    folder = TensorFolder.open(tensors)
    monkeypatch.setattr("tracklake.training.train.TensorFolder.open", lambda _: folder)
    Peeks.folder, Peeks.honest = folder, False
    with pytest.raises(FutureInputError, match="`forgetful` sees the future"):
        train("forgetful", tensors, tmp_path / "run", CONFIG, without_evaluation=True)
