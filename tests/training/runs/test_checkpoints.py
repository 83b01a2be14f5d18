"""A training that is interrupted anywhere ends as one that is not; checkpoints and runs that do not fit are refused."""

import csv
import io
import json
import pickle
import signal
from dataclasses import replace

import pytest
import torch
from file_damages import Code
from scored_runs import evaluate
from tensor_tables import TINY
from tiny_network import PARTS, RECIPE, Forgetful, register, write_tiny

from tracklake.schemas.hashing import hash_chunks
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.runs.checkpoint import (
    CHECKPOINT_FILE,
    UnfinishedError,
    claim_folder,
    is_unfinished,
    locate_unfinished,
)
from tracklake.training.train import TrainConfig, TrainingInterruptedError, train

# 4 steps an epoch; `mse` for 2 of 3 epochs. Other than one step after the other: dropout, Adam's moments, a cosine,
# validation and its best weights.
CONFIG = TrainConfig(epochs=3, log_steps=3, patience=5, schedule="cosine", optimizer="adamw", seed=4)
TIMES = ("seconds", "samples_per_s", "data_share")


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    return register(monkeypatch)


@pytest.fixture(autouse=True)
def _ctrl_c():
    """This process behaves as one at a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def stop_after(steps, error=KeyboardInterrupt):
    """Progress that raises at the end of a step."""
    reported = []

    def progress(_spent, _loss):
        reported.append(1)
        if len(reported) == steps:
            raise error

    return progress


def read_run(run):
    """All of a run but its times."""
    metrics = json.loads((run / "metrics.json").read_text())
    logs = []
    for name in ("course.csv", "epochs.csv"):
        with (run / name).open(newline="") as stream:
            logs.append([{key: own for key, own in row.items() if key not in TIMES} for row in csv.DictReader(stream)])
    weights = torch.load(run / "weights.pt", weights_only=True)
    exact = {name: weight.numpy().tobytes() for name, weight in weights.items()}
    return {key: own for key, own in metrics.items() if key not in TIMES}, logs, exact


def press(*_given, **_named):
    raise KeyboardInterrupt


def without_name(run):
    metrics, logs, weights = run
    return {**metrics, "evaluation": {**metrics["evaluation"], "model": ""}}, logs, weights


@pytest.fixture(scope="module")
def undisturbed(tensors, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        folder = tmp_path_factory.mktemp("undisturbed")
        train("forgetful", tensors, folder / "run", CONFIG)
        yield read_run(folder / "run")


def test_it_is_worth_comparing(undisturbed):
    metrics, (course, epochs), _ = undisturbed
    assert metrics["steps"] == 12
    assert [row["step"] for row in course] == ["3", "6", "8", "9", "12"]
    assert [row["best"] for row in epochs].count("1") >= 2


@pytest.mark.parametrize("steps", range(1, 13))
def test_interrupted_after_any_step_it_ends_the_same(steps, tensors, tmp_path, undisturbed):
    run = tmp_path / "run"
    with pytest.raises(TrainingInterruptedError, match=r"interrupted; the checkpoint is .*checkpoint.pt"):
        train("forgetful", tensors, run, CONFIG, stop_after(steps))
    assert not run.exists(), "no run yet"
    train("forgetful", tensors, run, resume=True)
    assert read_run(run) == undisturbed
    assert [path.name for path in tmp_path.iterdir()] == ["run"], "checkpoint and lock are gone"


def test_interrupted_again_and_again_it_ends_the_same(tensors, tmp_path, undisturbed):
    run = tmp_path / "run"
    for number, steps in enumerate((2, 1, 3, 4)):
        with pytest.raises(TrainingInterruptedError):
            train("forgetful", tensors, run, CONFIG, stop_after(steps), resume=number > 0)
    train("forgetful", tensors, run, CONFIG, resume=True)
    assert read_run(run) == undisturbed


def test_killed_between_checkpoints_it_goes_on_from_the_last_one(tensors, tmp_path, undisturbed):
    """Saved after every step but the last two: what was logged of those is cut, and they are done again."""
    run = tmp_path / "run"
    with pytest.raises(RuntimeError):
        train("forgetful", tensors, run, replace(CONFIG, checkpoint_s=1e-9), stop_after(4, RuntimeError))
    unfinished = locate_unfinished(run)
    old = (unfinished / CHECKPOINT_FILE).read_bytes()
    with pytest.raises(RuntimeError):
        train("forgetful", tensors, run, None, stop_after(2, RuntimeError), resume=True)
    assert (unfinished / "course.csv").read_text().count("\n") == 1 + 2, "rows for steps 3 and 6"
    (unfinished / CHECKPOINT_FILE).write_bytes(old)
    (unfinished / f".checkpoint.pt.{0:032x}.tmp").write_bytes(old[:100])
    train("forgetful", tensors, run, None, resume=True)
    assert read_run(run) == undisturbed


@pytest.mark.parametrize("model", ["attention-h2", "cs-lstm"])
@pytest.mark.parametrize("steps", [1, 3])
def test_models_of_the_registry_end_the_same(model, steps, tensors, tmp_path):
    """One drops at random what it attends to; one leaves out empty cells. Stopped within an epoch of four."""
    config = TrainConfig(steps=5, log_steps=2, patience=2, seed=2, batch_size=8, samples_per_epoch=32)
    train(model, tensors, tmp_path / "whole", config)
    with pytest.raises(TrainingInterruptedError):
        train(model, tensors, tmp_path / "run", config, stop_after(steps))
    train(model, tensors, tmp_path / "run", resume=True)
    assert without_name(read_run(tmp_path / "run")) == without_name(read_run(tmp_path / "whole"))


class PressesKeys(Forgetful):
    """Presses Ctrl-C while a step is under way, as often as the list says for the step."""

    presses = ()

    def loss(self, observed, truth, phase):
        loss = super().loss(observed, truth, phase)
        number = sum(training for _, training, _ in self.seen)
        for _ in range(self.presses[number - 1] if self.training and number <= len(self.presses) else 0):
            signal.raise_signal(signal.SIGINT)
        return loss


def test_ctrl_c_waits_for_the_step_and_the_training_goes_on(tensors, tmp_path, undisturbed, monkeypatch):
    register(monkeypatch, PressesKeys)
    PressesKeys.presses = (0, 0, 1)
    with pytest.raises(TrainingInterruptedError):
        train("forgetful", tensors, tmp_path / "run", CONFIG)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    PressesKeys.presses = ()
    reported = []
    train("forgetful", tensors, tmp_path / "run", None, lambda spent, _: reported.append(spent), resume=True)
    assert reported[0] == pytest.approx(4 / 12), "three steps were done before"
    assert read_run(tmp_path / "run") == undisturbed


def test_ctrl_c_twice_does_not_wait(tensors, tmp_path, monkeypatch):
    register(monkeypatch, PressesKeys)
    PressesKeys.presses = (0, 2)
    with pytest.raises(KeyboardInterrupt) as stopped:
        train("forgetful", tensors, tmp_path / "run", CONFIG)
    assert not isinstance(stopped.value, TrainingInterruptedError), "there was no checkpoint yet"
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_during_the_evaluation_loses_nothing(tensors, tmp_path, undisturbed, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("tracklake.training.train.measure_errors", press)
        with pytest.raises(TrainingInterruptedError):
            train("forgetful", tensors, tmp_path / "run", CONFIG)
    train("forgetful", tensors, tmp_path / "run", resume=True)
    assert read_run(tmp_path / "run") == undisturbed


@pytest.mark.parametrize("steps", [9, 10, None])
def test_a_last_epoch_that_is_cut_short_is_judged_once(steps, tensors, tmp_path, monkeypatch):
    """Ten steps of four an epoch; stopped before the last, after it, and when the third epoch was judged already."""
    config = replace(CONFIG, epochs=None, steps=10)
    train("forgetful", tensors, tmp_path / "whole", config)
    whole = read_run(tmp_path / "whole")
    assert [row["step"] for row in whole[1][1]] == ["4", "8", "10"]
    with monkeypatch.context() as patch:
        if steps is None:
            patch.setattr("tracklake.training.train.measure_errors", press)
        with pytest.raises(TrainingInterruptedError):
            train("forgetful", tensors, tmp_path / "run", config, None if steps is None else stop_after(steps))
    train("forgetful", tensors, tmp_path / "run", resume=True)
    assert without_name(read_run(tmp_path / "run")) == without_name(whole)


# Beginning, going on, and what stands in the way


@pytest.fixture
def interrupted(tensors, tmp_path):
    """A run's folder, and the checkpoint of its training after five steps."""
    with pytest.raises(TrainingInterruptedError):
        train("forgetful", tensors, tmp_path / "models" / "run", CONFIG, stop_after(5))
    run = tmp_path / "models" / "run"
    return run, locate_unfinished(run) / CHECKPOINT_FILE


def test_an_interrupted_training_is_not_lost_unasked(interrupted, tensors):
    run, checkpoint = interrupted
    before = checkpoint.read_bytes()
    with pytest.raises(UnfinishedError, match=r"`run` was interrupted; resume it \(`--resume`\), or start .*`--anew`"):
        train("forgetful", tensors, run, CONFIG)
    assert checkpoint.read_bytes() == before
    metrics = train("forgetful", tensors, run, replace(CONFIG, epochs=1), resume=False)
    assert metrics["steps"] == 4
    assert not is_unfinished(run)


def test_there_must_be_something_to_resume(tensors, tmp_path):
    with pytest.raises(UnfinishedError, match="no interrupted training of the run `run` to resume"):
        train("forgetful", tensors, tmp_path / "run", CONFIG, resume=True)
    assert list(tmp_path.iterdir()) == []


def test_a_finished_run_stays_until_the_next_is_done(tensors, tmp_path):
    train("forgetful", tensors, tmp_path / "run", replace(CONFIG, epochs=1))
    with pytest.raises(TrainingInterruptedError):
        train("forgetful", tensors, tmp_path / "run", CONFIG, stop_after(5), resume=False)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 4
    assert evaluate("run", tensors, tmp_path).samples > 0
    train("forgetful", tensors, tmp_path / "run", resume=True)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 12


def test_evaluating_an_interrupted_training_says_how_to_finish_it(interrupted, tensors):
    run, _ = interrupted
    with pytest.raises(
        StaleRunError, match="was interrupted; finish it first: `tracklake train MODEL --name run --resume`"
    ):
        evaluate("run", tensors, run.parent)


def test_two_processes_do_not_train_one_run(tensors, tmp_path):
    with (
        claim_folder(tmp_path / "run") as folder,
        pytest.raises(UnfinishedError, match="another process is training the run `run`"),
    ):
        train("forgetful", tensors, tmp_path / "run", CONFIG)
    assert not folder.exists()


@pytest.mark.parametrize(
    ("config", "reported"),
    [
        (replace(CONFIG, seed=5), "training.seed 4 then, 5 now"),
        (
            replace(CONFIG, epochs=4, patience=None),
            "training.epochs 3 then, 4 now; training.patience 5 then, not set now",
        ),
        (
            replace(CONFIG, parameters={"hidden": 9}),
            "parameters.hidden 8 then, 9 now; training.parameters.hidden not set",
        ),
    ],
)
def test_a_training_does_not_go_on_otherwise_than_it_began(config, reported, interrupted, tensors, undisturbed):
    run, _ = interrupted
    with pytest.raises(UnfinishedError, match=f"started with other settings or data: {reported}.*`--resume` alone"):
        train("forgetful", tensors, run, config, resume=True)
    train("forgetful", tensors, run, resume=True)
    assert read_run(run) == undisturbed, "and nothing was lost"


def test_a_training_does_not_go_on_as_another_model_or_recipe(interrupted, tensors, monkeypatch):
    run, _ = interrupted
    with pytest.raises(UnfinishedError, match="model forgetful then, lstm now"):
        train("lstm", tensors, run, resume=True)
    register(monkeypatch, recipe=replace(RECIPE, max_gradient_norm=3.0))
    with pytest.raises(UnfinishedError, match=r"other settings or data: recipe.max_gradient_norm 10.0 then, 3.0 now"):
        train("forgetful", tensors, run, resume=True)


@pytest.mark.parametrize(
    ("made", "reported"),
    [
        ({"seed": 1}, r"data: tensors \w{12} then, \w{12} now\."),
        ({"protocol": replace(TINY, horizon_s=1.0)}, r"data: protocol.digest \w{12} then, \w{12} now; "),
        ({"splits": PARTS[:2], "subsets": "ab"}, "data: other blocks; tensors"),
    ],
)
def test_a_training_does_not_go_on_with_other_data(made, reported, interrupted, tmp_path):
    run, _ = interrupted
    tensors = write_tiny(tmp_path / "others", **made)
    config = replace(CONFIG, patience=5 if made.get("subsets") is None else None)
    with pytest.raises(UnfinishedError, match=reported):
        train("forgetful", tensors, run, config, resume=True)


# Files that are not what was written


def test_damaged_checkpoints_are_refused_and_run_nothing(interrupted, tensors):
    run, checkpoint = interrupted
    whole = checkpoint.read_bytes()
    code = pickle.dumps({"network": Code(checkpoint.parent / "was run")})
    damaged = [b"", b"\n", whole[:-200], whole[: len(whole) // 2], whole + b"x", whole[1:], code]
    for place in range(3, len(whole), len(whole) // 30):
        flipped = bytearray(whole)
        flipped[place] ^= 1
        damaged.append(bytes(flipped))
    for content in damaged:
        checkpoint.write_bytes(content)
        with pytest.raises(UnfinishedError, match=r"checkpoint.pt: damaged, or no checkpoint .*start over with `--an"):
            train("forgetful", tensors, run, resume=True)
        assert checkpoint.read_bytes() == content, "left as it is"
    assert not (checkpoint.parent / "was run").exists()


def seal(header, content):
    """A checkpoint of any content, with its checksum."""
    stream = io.BytesIO()
    torch.save(content, stream)
    body = json.dumps(header).encode() + b"\n" + stream.getvalue()
    return hash_chunks([body]).encode() + b"\n" + body


@pytest.mark.parametrize(
    ("header", "content", "reported"),
    [
        ({"version": 4}, {}, "no checkpoint .*expected version 5, got 4"),
        ({"version": torch.ones(3).tolist()}, {}, "no checkpoint .*expected version 5, got"),
        ({"run": 3}, {}, "no checkpoint that this version of tracklake can resume"),
        ({"run": {"training": [1]}}, {}, "no checkpoint that this version of tracklake can resume"),
        (
            {"run": {"training": {"steps": 3, "pace": 2, "gait": 1}}},
            {},
            "no checkpoint .*`pace`: unknown setting, got 2; .*resume with the one that started the training",
        ),
        ({"run": {"training": {"seed": "x"}}}, {}, "no checkpoint .*`seed`: expected a whole number, got 'x'"),
        ({"run": {"training": {"steps": 0}}}, {}, "no checkpoint .*`steps`: expected more than 0"),
        ({}, {"network": {}}, 'not the weights of this model .*Missing key.* "first.weight"'),
        ({}, {"optimizer": {}}, "not the weights of this model"),
        ({}, {"random": torch.zeros(3)}, "not the weights of this model"),
        ({}, {"state": {"losses": torch.zeros(3), "paces": 3}}, "not the weights of this model"),
        ({}, {"network": Code("was run")}, "no checkpoint that this version .*objects that could run code"),
    ],
)
def test_checkpoints_of_other_contents_are_refused(header, content, reported, interrupted, tensors):
    run, checkpoint = interrupted
    _, started, stored = checkpoint.read_bytes().split(b"\n", maxsplit=2)
    stored = torch.load(io.BytesIO(stored), weights_only=True)
    checkpoint.write_bytes(seal(json.loads(started) | header, stored | content))
    for config in (None, CONFIG):
        with pytest.raises(UnfinishedError, match=f"checkpoint.pt: {reported}.*start over with `--anew`"):
            train("forgetful", tensors, run, config, resume=True)
    assert checkpoint.is_file(), "left as it is"
