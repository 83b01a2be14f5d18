"""docs/own-models.md as printed: the loop on a lake's tensors, and a model of the user's own; and what is refused."""

import contextlib
import io
import json
import re
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from scored_runs import evaluate
from tiny_network import write_tiny

import tracklake
from tracklake.schemas.errors import UsageError
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.data.batches import Batch
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import find_model
from tracklake.training.runs.checkpoint import UnfinishedError
from tracklake.training.train import TrainConfig, TrainingInterruptedError, train

PAGE = (Path(__file__).parents[1] / "docs" / "own-models.md").read_text()
LOOP, MODULE = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A folder to run tracklake in, with the page's module; what is imported from there is forgotten afterwards."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a module that is changed within a second is read again
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mymodule.py").write_text(MODULE)
    known = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - known:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_the_loop_of_the_page_learns(lake, monkeypatch):
    monkeypatch.chdir(lake.root.parent)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(LOOP, {})
    rmse_m = float(re.fullmatch(r"RMSE over the whole horizon: (.*) m\n", printed.getvalue())[1])
    batch = tracklake.open("lake").tensors().read_part("eval")
    standing_m = ((batch["future"][batch["future_mask"]] ** 2).sum(axis=-1).mean()) ** 0.5
    assert rmse_m < 0.3 * standing_m


def test_the_page_lists_every_key_with_shape_and_dtype(tmp_path):
    """Read from a batch: letters of the page's shapes stand for one size each."""
    batch = TensorFolder.open(str(write_tiny(tmp_path / "tensors"))).read_part("train")
    rows = re.findall(r"^\| `(\w+)` \| \(([^)]*)\) \| (\w+) \|", PAGE, flags=re.MULTILINE)
    assert [name for name, *_ in rows] == batch.keys() == [own.name for own in fields(Batch) if own.name != "absolute"]
    sizes: dict[str, int] = {}
    for name, shape, dtype in rows:
        assert batch[name].dtype.name == dtype, name
        letters = shape.split(", ")
        assert len(letters) == batch[name].ndim, name
        for letter, size in zip(letters, batch[name].shape, strict=True):
            assert sizes.setdefault(letter, int(letter) if letter.isdigit() else size) == size, name
    assert sizes["B"] == len(batch)


def test_a_model_of_ones_own_is_trained_evaluated_and_drawn(command, lake, workplace):
    here = replace(command, folder=workplace).here
    run = lake.root / "models" / "MyModel"
    options = ("--lake", lake.root, "--quiet")
    try:
        done = here(
            "train", "mymodule:MyModel", "--set", "hidden=8", "--set", "batch_size=32", "--steps", "2", *options
        )
        assert done.code == 0, done.err
        config = json.loads((run / "config.json").read_text())
        assert (config["model"], config["parameters"]) == ("mymodule:MyModel", {"hidden": 8})
        assert (config["recipe"]["batch_size"], config["recipe"]["learning_rate"]) == (32, 2e-3)
        assert here("evaluate", "MyModel", "--out", "scores.csv", *options).code == 0
        assert here("predict", "MyModel", "--out", "drawn.svg", *options).code == 0
        (workplace / "mymodule.py").write_text(MODULE + "\n# changed\n")
        changed = here("evaluate", "MyModel", *options)
        assert (changed.code, "the file of `mymodule:MyModel` has changed since" in changed.err) == (1, True)
        del sys.modules["mymodule"]
        (workplace / "mymodule.py").unlink()
        gone = here("evaluate", "MyModel", *options)
        assert gone.code == 1
        assert "MyModel: model `mymodule:MyModel`: the module `mymodule` cannot be imported" in gone.err
        assert str(workplace) in gone.err
        assert "run the command where the module is found" in gone.err
    finally:
        for file in run.iterdir():
            file.unlink()
        run.rmdir()


def stop_after_two(steps=2):
    left = [steps]

    def progress(_spent, _loss):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    return progress


def test_its_training_is_resumed_exactly_and_with_the_same_file_only(workplace):
    """All paths are strings."""
    tensors, config = str(write_tiny(workplace / "tensors")), TrainConfig(steps=5, batch_size=8)
    train("mymodule:MyModel", tensors, "whole", config)
    with pytest.raises(TrainingInterruptedError):
        train("mymodule:MyModel", tensors, "run", config, stop_after_two())
    (workplace / "mymodule.py").write_text(MODULE + "\n# changed\n")
    with pytest.raises(UnfinishedError, match=r"code \w{12} then, \w{12} now"):
        train("mymodule:MyModel", tensors, "run", resume=True)
    (workplace / "mymodule.py").write_text(MODULE.replace("hidden: int = 32", "hidden: int = 16"))
    assert find_model("mymodule:MyModel").parameters == {"hidden": 16}, "an edited file is read again"
    (workplace / "mymodule.py").write_text(MODULE)
    train("mymodule:MyModel", tensors, "run", resume=True)
    one, other = (torch.load(f"{run}/weights.pt", weights_only=True) for run in ("whole", "run"))
    assert {name: own.numpy().tobytes() for name, own in one.items()} == {
        name: own.numpy().tobytes() for name, own in other.items()
    }
    assert evaluate("run", tensors, ".").samples > 0
    config_file = workplace / "run" / "config.json"
    config_file.write_text(config_file.read_text().replace("mymodule:MyModel", "mymodule:Another"))
    with pytest.raises(
        StaleRunError, match=r"run: model `mymodule:Another`: .* got no such name; run the command where"
    ):
        evaluate("run", tensors, ".")


@pytest.mark.parametrize(
    ("name", "code", "reported"),
    [
        ("nowhere:MyModel", "", "module `nowhere` cannot be imported .ModuleNotFoundError: No module named 'nowhere'"),
        (":MyModel", "", "the module `` cannot be imported"),
        ("broken:MyModel", "def", "module `broken` cannot be imported .SyntaxError"),
        ("sys:path", "", "module `sys` cannot be imported .AttributeError"),
        ("broken:MyModel", "raise SystemExit(0)", "module `broken` cannot be imported .SystemExit: 0"),
        ("broken:MyModel", "1 / 0", "module `broken` cannot be imported .ZeroDivisionError: division by zero"),
        ("broken:MyModel", "x = 1", "derived from PlaceNetwork or Network in .*broken.py, got no such name"),
        ("broken:os", "import os", "derived from PlaceNetwork or Network in .*broken.py, got <module 'os'"),
        ("broken:system", "from os import system", "derived from .* got <built-in function system>"),
        ("broken:Own", "class Own(PlaceNetwork): pass", "lacks the method `forward`, an argument for the protocol"),
        (
            "broken:Own",
            "class Own(Network): pass",
            "lacks the method `loss`, the method `predict_tensors`, an argument",
        ),
        (
            "broken:Own",
            "class Own(PlaceNetwork):\n def __init__(self, p, hidden): pass\n def forward(self, h): pass",
            "lacks a default of the argument `hidden`",
        ),
        (
            "broken:Own",
            "class Own(PlaceNetwork):\n reads='all'\n def __init__(self, p): pass\n def forward(self, h): pass",
            "lacks a Recipe as `recipe`, or `grid` or `scene` as `reads`",
        ),
    ],
)
def test_what_is_no_model_is_refused(name, code, reported, workplace):
    (workplace / "broken.py").write_text(
        f"from tracklake.training.models.network import Network, PlaceNetwork\n{code}\n"
    )
    with pytest.raises(UsageError, match=f"model `{name}`: .*{reported}"):
        find_model(name)


def test_a_wrong_shape_and_an_error_of_the_model_are_told(command, lake, workplace):
    flat = MODULE.replace(".unflatten(1, (-1, 2))", "")
    (workplace / "flat.py").write_text(flat)
    (workplace / "raising.py").write_text(MODULE.replace("return self.last", "return self.lst"))
    here = replace(command, folder=workplace).here
    options = ("--lake", lake.root, "--steps", "2", "--name", "never")
    shape = here("train", "flat:MyModel", *options)
    assert shape.code == 2
    assert re.search(r"expected predicted positions of shape \(64, 25, 2\), got \(64, 50\)", shape.err)
    raising = here("train", "raising:MyModel", *options)
    assert raising.code == 1
    assert re.search(r"raising.py, line \d+: AttributeError: .*'lst'.* This is your own model's code", raising.err)
    assert "bug in tracklake" not in raising.err
    assert not list((lake.root / "models").glob("*never*"))
