"""The training loop: what it is shown, what it learns, what it writes, what it refuses."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import torch
from scored_runs import evaluate
from tensor_tables import TINY, sample_everything, split_row, write
from tensor_tables import drive as drive_vehicles
from tiny_network import RECIPE, Forgetful, make_tables, read_log, register, write_tiny

import tracklake.training.train
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.schemas.protocols import CSP
from tracklake.training.data.gathers import read_samples
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MODELS, Phase, Recipe
from tracklake.training.train import TrainConfig, train

LSTM = {"hidden": 16, "anchoring": "both"}
FEW = TrainConfig(steps=9, log_steps=2)


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """The small LSTM on vehicles that keep their speed, brake or accelerate, under the protocol `csp`."""
    draw = np.random.default_rng(0)
    tables = []
    for subset in "ab":
        clock = drive_vehicles(draw, vehicles=12, ticks=45)
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset, protocol=CSP)))
    folder = tmp_path_factory.mktemp("learned")
    splits = pl.concat([split_row("a", "train"), split_row("b", "eval")])
    tensors, reported = write(folder / "tensors", tables, splits, protocol=CSP), []
    config = TrainConfig(steps=60, batch_size=64, parameters={"hidden": 16})
    metrics = train("lstm", tensors, folder / "run", config, lambda spent, loss: reported.append((spent, loss)))
    return folder, metrics, reported


def test_training_reduces_the_loss_and_beats_constant_velocity(learned):
    folder, metrics, reported = learned
    (phase,) = metrics["phases"]
    assert (phase["loss"], phase["steps"], metrics["steps"]) == ("mse", 60, 60)
    assert phase["loss_last"] < 0.5 * phase["loss_first"]
    plain = evaluate("constant-velocity", folder / "tensors", folder).horizons
    better = evaluate("run", folder / "tensors", folder).horizons
    assert better["n"].equals(plain["n"])
    assert better["rmse_m"][-1] < 0.8 * plain["rmse_m"][-1]
    assert len(reported) == 61, "once per step, and at the end"
    assert [spent for spent, _ in reported] == sorted(spent for spent, _ in reported)
    assert reported[-1][0] == 1.0


def test_what_is_written_says_how_it_came_about(learned):
    folder, metrics, _ = learned
    assert json.loads((folder / "run" / "metrics.json").read_text()) == metrics
    config = json.loads((folder / "run" / "config.json").read_text())
    assert (config["model"], config["parameters"], config["split"]) == ("lstm", LSTM, "mine")
    assert config["train_subsets"] == ["highd/a"]
    assert config["protocol"]["digest"] == CSP.digest
    assert (config["training"]["steps"], config["training"]["seed"], config["training"]["epochs"]) == (60, 0, None)
    assert (config["recipe"]["batch_size"], config["recipe"]["optimizer"]) == (64, "adamw")
    samples = len(TensorFolder.open(folder / "tensors").samples_of("train"))
    assert metrics["train_samples"] == samples
    evaluation = json.loads(json.dumps(evaluate("run", folder / "tensors", folder).to_dict()))
    assert metrics["evaluation"]["horizons"] == evaluation["horizons"]
    assert sorted(path.name for path in folder.iterdir()) == ["run", "tensors"], "nothing is left beside the run"
    files = ["config.json", "course.csv", "epochs.csv", "metrics.json", "weights.pt"]
    assert sorted(path.name for path in (folder / "run").iterdir()) == files


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if model.learns])
def test_every_model_that_learns_goes_through_the_loop(name, tensors, tmp_path):
    metrics = train(name, tensors, tmp_path / "run", TrainConfig(steps=2, batch_size=8))
    assert metrics["steps"] == 2
    assert metrics["evaluation"]["samples"] == len(TensorFolder.open(tensors).samples_of("eval"))
    assert evaluate("run", tensors, tmp_path).horizons["rmse_m"][0] == metrics["evaluation"]["horizons"][0]["rmse_m"]


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if model.published])
def test_networks_as_published_go_through_the_loop(name, tensors, tmp_path):
    config = TrainConfig(steps=2, batch_size=8, parameters={"as_published": True})
    metrics = train(name, tensors, tmp_path / "run", config)
    recorded = json.loads((tmp_path / "run" / "config.json").read_text())["parameters"]
    assert recorded == {**MODELS[name].parameters, **MODELS[name].published}
    assert evaluate("run", tensors, tmp_path).horizons["rmse_m"][0] == metrics["evaluation"]["horizons"][0]["rmse_m"]


# What it is shown


def test_training_on_one_recording_is_training_on_a_folder_that_holds_it_alone(tmp_path, monkeypatch):
    """Its neighbors, the order of its samples and its scores are the same; the other recordings change nothing."""
    register(monkeypatch)
    names, parts = ("01-lower", "01-upper", "01-x", "011", "02-lower"), ("train", "eval", "val", "train", "eval")
    splits = pl.concat([split_row(name, part) for name, part in zip(names, parts, strict=True)])
    tables = make_tables(subsets=names)
    every = write(tmp_path / "every", tables, splits)
    alone = write(tmp_path / "alone", tables[:3], splits.filter(pl.col("subset").str.starts_with("01-")))
    config = TrainConfig(epochs=3, patience=2)
    expected = train("forgetful", alone, tmp_path / "expected", config)["evaluation"]
    found = train("forgetful", every, tmp_path / "found", replace(config, recording="01", dataset="highd"))
    assert found["evaluation"] | {"model": "expected"} == expected
    run = json.loads((tmp_path / "found" / "config.json").read_text())
    assert (run["training"]["dataset"], run["training"]["recording"]) == ("highd", "01")
    assert (run["train_subsets"], run["val_subsets"]) == (["highd/01-lower"], ["highd/01-x"])
    narrowed = TensorFolder.open(every).narrow(recording="01")
    assert sorted(narrowed.origins) == ["highd/01-lower", "highd/01-upper", "highd/01-x"]
    assert evaluate("found", narrowed, tmp_path).to_dict() == found["evaluation"]
    assert evaluate("found", every, tmp_path).samples > found["evaluation"]["samples"]
    with pytest.raises(TracklakeError, match="no samples of 02 in `train`"):
        train("forgetful", every, tmp_path / "none", replace(config, recording="02"))
    with pytest.raises(UsageError, match=r"expected the dataset of `01` \(highd\), got `ngsim`"):
        train("forgetful", every, tmp_path / "none", replace(config, recording="01", dataset="ngsim"))
    with pytest.raises(TracklakeError, match="no samples of highd/011 in `eval`"):
        train("forgetful", every, tmp_path / "none", TrainConfig(epochs=1, recording="011"))
    assert not any("none" in path.name for path in tmp_path.iterdir())


def epochs_of(network, steps):
    """The truths shown in each epoch, as sets: a sample is identified by its last position."""
    shown = [[tuple(row.flatten().tolist()) for row in future] for _, training, future in network.seen if training]
    return [[row for batch in shown[first : first + steps] for row in batch] for first in range(0, len(shown), steps)]


def futures_of(tensors, part):
    folder = TensorFolder.open(tensors)
    return sorted(tuple(row.ravel().tolist()) for row in folder.gather(folder.samples_of(part)).future)


def test_an_epoch_is_every_training_sample_once_in_an_order_of_its_own(tensors, tmp_path, monkeypatch):
    built = register(monkeypatch)
    metrics = train("forgetful", tensors, tmp_path / "run")
    n = metrics["train_samples"]
    steps = -(-n // 32)
    epochs = epochs_of(built[0], steps)
    assert len(epochs) == 3, "of the recipe"
    assert (metrics["steps"], metrics["samples_seen"]) == (3 * steps, 3 * n)
    for epoch in epochs:
        assert sorted(epoch) == futures_of(tensors, "train")
    assert epochs[0] != epochs[1]
    assert [len(future) for *_, future in built[0].seen[:steps]] == [32] * (steps - 1) + [n - 32 * (steps - 1)]


@pytest.mark.parametrize("name", ["v-lstm", "attention-h2"])
def test_supervised_positions_are_those_that_the_loss_covers(name, tensors, tmp_path):
    """A scene's loss covers the known future of every vehicle in it, that of a grid the sample's own."""
    folder = TensorFolder.open(tensors)
    train_samples = folder.samples_of("train")
    _, truth = read_samples(folder, train_samples, MODELS[name].reads)
    metrics = train(name, tensors, tmp_path / "run", TrainConfig(epochs=1, batch_size=16))
    assert metrics["samples_seen"] == len(train_samples)
    assert metrics["supervised_positions"] == truth.future_mask.sum() > 0
    per_step = truth.future_mask.sum() / -(-len(train_samples) // 16)
    assert metrics["supervised_positions_per_step"] == pytest.approx(per_step, abs=0.05)


def test_an_epoch_of_fewer_samples_draws_others_each_time(tensors, tmp_path, monkeypatch):
    built = register(monkeypatch)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(samples_per_epoch=40))
    epochs = epochs_of(built[0], 2)
    assert [len(epoch) for epoch in epochs] == [40, 40, 40]
    assert len({frozenset(epoch) for epoch in epochs}) == 3
    everything = Counter(futures_of(tensors, "train"))  # two samples may have the same future
    assert all(Counter(epoch) <= everything for epoch in epochs), "each sample once at most"
    assert metrics["samples_seen"] == 120


@pytest.mark.parametrize(
    ("config", "phases"),
    [
        (TrainConfig(), [("mse", 8), ("distance", 4)]),
        (TrainConfig(epochs=6), [("mse", 16), ("distance", 8)]),
        (TrainConfig(epochs=1), [("mse", 3), ("distance", 1)]),  # 4 steps: the third begins before 2 2/3 are done
        (TrainConfig(steps=9), [("mse", 6), ("distance", 3)]),
        (TrainConfig(steps=1), [("mse", 1)]),
        (TrainConfig(epochs=2, samples_per_epoch=30, batch_size=3), [("mse", 14), ("distance", 6)]),  # 13 1/3 of 20
    ],
)
def test_phases_share_what_is_given_by_their_epochs(config, phases, tensors, tmp_path, monkeypatch):
    built = register(monkeypatch)
    metrics = train("forgetful", tensors, tmp_path / "run", config)
    assert [(phase["loss"], phase["steps"]) for phase in metrics["phases"]] == phases
    assert [loss for loss, *_ in built[0].seen] == [loss for loss, steps in phases for _ in range(steps)]


@pytest.mark.parametrize(("first", "second"), [(5, 3), (1, 6), (7, 11)])
def test_no_step_falls_into_the_wrong_phase_by_rounding(first, second):
    recipe = Recipe(phases=(Phase("one", first), Phase("two", second)))
    for steps in (7, 49, 1563):
        budget = (first + second) * steps
        assert recipe.phase_at(first * steps - 1, budget).loss == "one"
        assert recipe.phase_at(first * steps, budget).loss == "two"
    assert recipe.phase_at(0.0, 30.5).loss == "one"
    assert recipe.phase_at(30.4, 30.5).loss == "two"


def test_the_learning_rate_follows_the_schedule(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    each = TrainConfig(steps=10, log_steps=1, learning_rate=0.5)
    train("forgetful", tensors, tmp_path / "constant", each)
    train("forgetful", tensors, tmp_path / "cosine", replace(each, schedule="cosine"))
    constant, cosine = (
        [float(row["learning_rate"]) for row in read_log(tmp_path / name / "course.csv")]
        for name in ("constant", "cosine")
    )
    assert constant == [0.5] * 10
    # A twentieth at first; after half of the steps, half of a whole.
    assert cosine[0] == pytest.approx(0.5 * 0.05)
    assert cosine[5] == pytest.approx(0.5 * 0.5)
    assert cosine[9] == pytest.approx(0.5 * (1 + np.cos(0.9 * np.pi)) / 2)


def test_steps_are_adams_on_clipped_gradients(tensors, tmp_path, monkeypatch):
    """The first two steps once more by hand, with the batches that the loop showed."""

    class Plain(Forgetful):
        def __init__(self, protocol, *, hidden=8):
            super().__init__(protocol, hidden=hidden)
            self.drop, self.histories = torch.nn.Identity(), []

        def loss(self, observed, truth, phase):
            self.histories.append(observed.history)
            return super().loss(observed, truth, phase)

    built = register(monkeypatch, Plain)
    config = TrainConfig(steps=2, seed=3, max_gradient_norm=0.5, learning_rate=0.02)
    train("forgetful", tensors, tmp_path / "run", config)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        again = Plain(TINY)
    weights = list(again.parameters())
    first, second = [torch.zeros_like(weight) for weight in weights], [torch.zeros_like(weight) for weight in weights]
    for step in (1, 2):
        history, future = built[0].histories[step - 1], built[0].seen[step - 1][2]
        known = torch.ones(future.shape[:2], dtype=torch.bool)
        known[:, 1:] = (future[:, 1:] != future[:, :-1]).any(dim=-1)  # repeated where masked: all of these move
        squares = ((again(history) - future) ** 2).sum(dim=-1)
        gradients = torch.autograd.grad(squares[known].mean(), weights)
        norm = torch.sqrt(sum((gradient**2).sum() for gradient in gradients))
        assert norm > 0.5, "or nothing is clipped"
        with torch.no_grad():
            for number, gradient in enumerate(gradients):
                clipped = gradient * 0.5 / norm
                first[number] = 0.9 * first[number] + 0.1 * clipped
                second[number] = 0.999 * second[number] + 0.001 * clipped**2
                moment, size = first[number] / (1 - 0.9**step), second[number] / (1 - 0.999**step)
                weights[number] -= 0.02 * moment / (torch.sqrt(size) + 1e-8)
    for weight, wanted in zip(built[0].parameters(), weights, strict=True):
        torch.testing.assert_close(weight, wanted, rtol=1e-4, atol=1e-5)


# The seed


def weights_of(run):
    return torch.load(run / "weights.pt", weights_only=True)


def test_the_seed_decides_the_weights_bit_for_bit_and_the_callers_random_numbers_stay(tensors, tmp_path, monkeypatch):
    register(monkeypatch)
    torch.manual_seed(11)
    wanted = torch.rand(4)
    torch.manual_seed(11)
    drawn = []
    np.random.seed(5)  # noqa: NPY002  the legacy state is what might be disturbed
    state = np.random.get_state()[1].copy()  # noqa: NPY002  the same
    for name, seed in (("one", 1), ("two", 1), ("three", 2)):
        train("forgetful", tensors, tmp_path / name, replace(FEW, seed=seed))
        drawn.append(torch.rand(1))
    assert torch.cat(drawn).tolist() == wanted[:3].tolist()
    assert (np.random.get_state()[1] == state).all()  # noqa: NPY002  the same
    one, two, three = (weights_of(tmp_path / name) for name in ("one", "two", "three"))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not any(torch.equal(one[name], three[name]) for name in one)


def test_threads_are_as_before(tensors, tmp_path, monkeypatch):
    built, before = register(monkeypatch), torch.get_num_threads()
    inside = []
    train(
        "forgetful",
        tensors,
        tmp_path / "run",
        replace(FEW, threads=before + 1),
        lambda *_: inside.append(torch.get_num_threads()),
    )
    assert inside[0] == before + 1
    assert torch.get_num_threads() == before
    assert len(built) == 1


# Stopping


def test_the_time_budget_ends_the_training_and_is_shared_by_the_phases(tensors, tmp_path, monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr(tracklake.training.train.time, "monotonic", lambda: float(next(clock)))
    built = register(monkeypatch)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(seconds=60.0))
    losses = [loss for loss, *_ in built[0].seen]
    assert 59 < metrics["seconds"] < 64
    assert losses.count("mse") == pytest.approx(2 * losses.count("distance"), abs=2)


def test_no_time_for_one_step(tensors, tmp_path):
    with pytest.raises(TracklakeError, match="not one step was done"):
        train("lstm", tensors, tmp_path / "run", TrainConfig(seconds=1e-9))
    assert list(tmp_path.iterdir()) == []


class Scripted(Forgetful):
    """Its validation losses are as written; training goes on as ever."""

    script = ()

    def loss(self, observed, truth, phase):
        loss = super().loss(observed, truth, phase)
        return (
            loss if self.training else torch.tensor(self.script[sum(not training for _, training, _ in self.seen) - 1])
        )


def test_patience_ends_the_last_phase_and_keeps_the_best_weights(tensors, tmp_path, monkeypatch):
    """Two epochs of `mse`, which never end it; then the third of `distance` is best, and two come after it."""
    Scripted.script = (1.0, 9.0, 5.0, 4.0, 3.0, 3.0, 3.5, 1.0)
    recipe = replace(RECIPE, phases=(Phase("mse", 2), Phase("distance", 10)))
    register(monkeypatch, Scripted, recipe)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(patience=2))
    rows = read_log(tmp_path / "run" / "epochs.csv")
    assert [(row["phase"], float(row["validation_loss"]), row["best"]) for row in rows] == [
        ("mse", 1.0, "1"), ("mse", 9.0, "0"),
        ("distance", 5.0, "1"), ("distance", 4.0, "1"), ("distance", 3.0, "1"), ("distance", 3.0, "0"),
        ("distance", 3.5, "0"),
    ]  # fmt: skip
    assert metrics["best"] == {"epoch": 4, "validation_loss": 3.0}
    assert metrics["steps"] == 7 * 4
    # The weights after the fifth epoch; five are the whole of a training of that length and these phases.
    register(monkeypatch, Forgetful, replace(recipe, phases=(Phase("mse", 2), Phase("distance", 3))))
    train("forgetful", tensors, tmp_path / "five")
    five, kept = weights_of(tmp_path / "five"), weights_of(tmp_path / "run")
    assert all(torch.equal(five[name], kept[name]) for name in five)


def test_validation_is_the_loss_over_val_without_dropout(tensors, tmp_path, monkeypatch):
    built = register(monkeypatch, recipe=replace(RECIPE, phases=(Phase("mse", 1),)))
    monkeypatch.setattr("tracklake.training.loop.VALIDATION_BATCH", 50)
    metrics = train("forgetful", tensors, tmp_path / "run", TrainConfig(patience=1))
    shown = sorted(
        tuple(row.flatten().tolist()) for _, training, future in built[0].seen if not training for row in future
    )
    assert shown == futures_of(tensors, "val")
    folder = TensorFolder.open(tensors)
    batch = folder.gather(folder.samples_of("val"))
    predicted = built[0](torch.from_numpy(batch.history)).detach().numpy()  # as trained, in evaluation mode
    losses = []
    for part in np.split(np.arange(len(predicted)), [50, 100]):
        squares = ((predicted[part] - batch.future[part]) ** 2).sum(axis=-1)
        losses += [squares[batch.future_mask[part]].mean()] * len(part)
    assert metrics["best"]["validation_loss"] == pytest.approx(np.mean(losses), rel=1e-5)
