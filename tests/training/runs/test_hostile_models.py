"""Stored models with a value changed, or crafted: they work, or are refused with a message that names the file."""

import ast
import json
import random
import shutil

import pytest
import torch
from mutations import JUNK, mutate, nest
from scored_runs import evaluate
from tensor_tables import TINY
from tiny_network import register, write_tiny

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.run_config import StaleRunError
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MAX_PARAMETER, MODELS
from tracklake.training.runs.run_folder import load_run
from tracklake.training.train import TrainConfig, train

CONFIG = TrainConfig(epochs=3, patience=5, seed=4)
META, SPARSE = torch.empty(8, device="meta"), torch.zeros(8).to_sparse()
TENSORS = (META, SPARSE, torch.zeros(3), torch.ones(()), torch.zeros(8, dtype=torch.complex64))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Tensors, and a run of them."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        tensors = write_tiny(folder / "tensors")
        train("forgetful", tensors, folder / "run", CONFIG)
    return folder


@pytest.fixture
def copy(made, tmp_path, monkeypatch):
    """A copy to be damaged."""
    register(monkeypatch)
    return shutil.copytree(made, tmp_path / "made")


def change_config(run, **changes):
    file = run / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


@pytest.mark.parametrize("hidden", [10**9, MAX_PARAMETER + 1, -1, 8.5, True, "8", None, [8]])
def test_sizes_are_bounded_before_anything_is_built(copy, monkeypatch, hidden):
    built = register(monkeypatch)
    change_config(copy / "run", parameters={"hidden": hidden})
    with pytest.raises(StaleRunError, match="run: model `forgetful`: parameter `hidden`: expected int from 0 to 2,048"):
        load_run(copy / "run", TINY)
    assert built == []
    with pytest.raises(TracklakeError, match="hidden"):
        MODELS["lstm"].build(TINY, hidden=hidden)


@pytest.mark.parametrize("name", ["config.json", "index.json"])
def test_deeply_nested_json_is_refused(copy, name):
    file = copy / {"config.json": "run", "index.json": "tensors"}[name] / name
    for text in ("[" * 100_000, json.dumps(json.loads(file.read_text()) | {"blocks": nest(60)})):
        file.write_text(text)
        with pytest.raises(TracklakeError, match=f"{name}: not readable as JSON .nested in more than 50 levels"):
            evaluate("run", copy / "tensors", copy)


@pytest.mark.parametrize(("weight", "kind"), [(META, "meta"), (SPARSE, "sparse"), ([1.0] * 8, "list")])
def test_weights_that_hold_no_numbers_are_refused(copy, weight, kind):
    file = copy / "run" / "weights.pt"
    torch.save(torch.load(file, weights_only=True) | {"first.bias": weight}, file)
    with pytest.raises(StaleRunError, match=rf"weights.pt: .*first.bias.*{kind}"):
        load_run(copy / "run", TINY)


@pytest.mark.filterwarnings("ignore:Initializing zero-element tensors")
def test_a_changed_config_is_refused_or_works(copy):
    draw, file = random.Random(0), copy / "run" / "config.json"
    config, outcomes = json.loads(file.read_text()), []
    for _ in range(80):
        file.write_text(json.dumps(mutate(mutate(config, draw), draw)))
        try:
            evaluate("run", copy / "tensors", copy)
        except TracklakeError as refused:
            outcomes.append(str(copy) in str(refused))
    assert len(outcomes) > 5
    assert all(outcomes), "the message names the file"


def test_a_changed_index_is_refused_or_works(copy):
    draw, file = random.Random(1), copy / "tensors" / "index.json"
    index, outcomes = json.loads(file.read_text()), []
    for _ in range(150):
        file.write_text(json.dumps(mutate(index, draw)))
        try:
            TensorFolder.open(copy / "tensors")
        except TracklakeError as refused:
            outcomes.append(str(copy) in str(refused))
    assert len(outcomes) > 50
    assert all(outcomes)


HEADERS = ("(" * 150, "-" * 9000 + "1", "{[]: 1}", "{'descr': '<f4'}", "", "\0", "[" * 9000)


def test_a_changed_header_of_an_array_is_refused_or_works(copy):
    draw, outcomes = random.Random(2), []
    for array in ARRAYS[:5]:
        file = copy / "tensors" / array.file
        content = file.read_bytes()
        length = int.from_bytes(content[8:10], "little")
        header = ast.literal_eval(content[10 : 10 + length].decode("latin1"))
        shapes = [{**header, "shape": shape} for shape in ((10**30,), (-1,), (2**62, 4), ("x",), (True,))]
        for text in (*HEADERS, *map(repr, shapes), *(repr(mutate(header, draw)) for _ in range(5))):
            changed = text.encode("latin1") + b"\n"
            file.write_bytes(content[:8] + len(changed).to_bytes(2, "little") + changed + content[10 + length :])
            try:
                TensorFolder.open(copy / "tensors")
            except TracklakeError as refused:
                outcomes.append(str(file) in str(refused))
        file.write_bytes(content)
    assert len(outcomes) > 50
    assert all(outcomes)
    assert len(TensorFolder.open(copy / "tensors").sample_row) > 0


def test_changed_weights_are_refused_or_work(copy):
    draw, file = random.Random(3), copy / "run" / "weights.pt"
    weights, outcomes = dict(torch.load(file, weights_only=True)), []
    for _ in range(60):
        torch.save(mutate(weights, draw, (*JUNK, *TENSORS)), file)
        try:
            load_run(copy / "run", TINY)
        except StaleRunError as refused:
            outcomes.append(str(file) in str(refused))
    assert len(outcomes) > 50
    assert all(outcomes)
