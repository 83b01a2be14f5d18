"""Finished runs: what does not fit, or is not what was written, is refused."""

import hashlib
import json
import shutil
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import polars as pl
import pytest
import torch
from file_damages import DAMAGES
from scored_runs import evaluate
from tensor_tables import TINY, split_row
from tiny_network import PARTS, Forgetful, register, write_tiny

from tracklake.schemas.run_config import RUN_VERSION, StaleRunError
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.runs.run_folder import digest_tensors, find_versions, load_run
from tracklake.training.train import TrainConfig, train

CONFIG = TrainConfig(epochs=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        train("forgetful", write_tiny(folder / "tensors"), folder / "run", CONFIG)
    return folder


@pytest.fixture
def finished(trained, tmp_path, monkeypatch):
    """A copy of a run, to be damaged."""
    register(monkeypatch)
    return shutil.copytree(trained / "run", tmp_path / "run")


@pytest.mark.parametrize(("damage", "reported"), DAMAGES.items(), ids=lambda own: getattr(own, "__name__", None))
def test_damaged_weights_are_refused_and_run_nothing(damage, reported, finished):
    damage(finished / "weights.pt")
    with pytest.raises(StaleRunError, match=f"weights.pt: {reported}.*train it again"):
        load_run(finished, TINY)
    assert not (finished / "was run").exists()


def test_another_models_weights_are_refused_by_name_and_shape(finished):
    file = finished / "weights.pt"
    weights = torch.load(file, weights_only=True)
    others = Forgetful(TINY, hidden=5).state_dict()
    torch.save(others, file)
    with pytest.raises(StaleRunError, match=r"mismatch for first.bias: .*\(\[5\]\) from .* is torch.Size\(\[8\]\)"):
        load_run(finished, TINY)
    torch.save({"out.weight": weights["last.weight"], **weights}, file)
    with pytest.raises(StaleRunError, match=r'Unexpected key\(s\) in state_dict: "out.weight"'):
        load_run(finished, TINY)
    file.unlink()
    with pytest.raises(StaleRunError, match=r"weights.pt: .*No such file.*; train it again"):
        load_run(finished, TINY)


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"version": 1}, "expected version 2, got 1; train it again"),
        ({"version": None}, "expected version 2, got None; train it again"),
        (None, "not readable as JSON"),
        ([], "expected version 2, got a list"),
        ({"protocol": {}}, "expected the name and digest of a protocol in it; train it again"),
        ({"protocol": 3}, "expected protocol in it"),
        ({"parameters": None}, "expected parameters in it"),
        ({"train_subsets": 3, "blocks": {}}, "expected blocks, train_subsets in it"),
    ],
)
def test_runs_of_other_versions_and_broken_ones_are_refused(change, reported, finished):
    assert RUN_VERSION == 2
    file = finished / "config.json"
    config = json.loads(file.read_text())
    file.write_text("{" if change is None else json.dumps({**config, **change} if change else change))
    with pytest.raises(StaleRunError, match=f"config.json: {reported}"):
        load_run(finished, TINY)


def test_a_run_of_another_protocol_is_refused(finished, tmp_path):
    other = write_tiny(tmp_path / "other", protocol=replace(TINY, horizon_s=1.0))
    with pytest.raises(StaleRunError, match=r"trained for the protocol tiny \(.*train it again"):
        evaluate("run", other, finished.parent)


def test_a_run_is_not_evaluated_on_what_it_was_trained_on(finished, tmp_path):
    swapped = PARTS.with_columns(part=PARTS["part"].replace({"train": "eval", "eval": "train"}))
    with pytest.raises(StaleRunError, match=r"1 subset\(s\) of `eval` \(highd/a\) were in its training part"):
        evaluate("run", write_tiny(tmp_path / "swapped", swapped), finished.parent)
    shutil.rmtree(finished)
    train("constant-velocity", write_tiny(tmp_path / "tensors"), tmp_path / "cv")
    assert evaluate("cv", tmp_path / "swapped", tmp_path).samples > 0, "what never learned cannot have seen anything"


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"model": "crystal-ball"}, "unknown model `crystal-ball`"),
        ({"parameters": {"hidden": "wide"}}, "run: .*train it again"),
        ({"parameters": {"depth": 3}}, "model `forgetful` has no parameter depth"),
    ],
)
def test_runs_that_cannot_be_built_are_refused(change, reported, finished):
    file = finished / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(StaleRunError, match=reported):
        load_run(finished, TINY)


def test_a_run_without_its_config_is_refused(finished, trained):
    (finished / "config.json").unlink()
    with pytest.raises(StaleRunError, match=r"a run without its config.json; train it again"):
        evaluate("run", trained / "tensors", finished.parent)


def test_a_run_is_not_evaluated_on_what_chose_its_weights(tmp_path, monkeypatch):
    """Trained on a, stopped by b, which is later what is evaluated on; without patience, b was never looked at."""
    register(monkeypatch)
    splits = pl.concat([split_row("a", "train"), split_row("b", "val"), split_row("c", "eval")])
    other = pl.concat([split_row("a", "val"), split_row("b", "eval"), split_row("c", "train")])
    tensors, later = write_tiny(tmp_path / "tensors", splits), write_tiny(tmp_path / "later", other)
    train("forgetful", tensors, tmp_path / "patient", TrainConfig(epochs=2, patience=2))
    with pytest.raises(StaleRunError, match=r"1 subset\(s\) of `eval` \(highd/b\) were .* or chose its weights"):
        evaluate("patient", later, tmp_path)
    train("forgetful", tensors, tmp_path / "plain", CONFIG)
    assert evaluate("plain", later, tmp_path).samples > 0


def test_a_run_meets_new_recordings(finished, tmp_path):
    splits = pl.concat([PARTS, split_row("d", "eval")])
    with_another = write_tiny(tmp_path / "more", splits, subsets="abcd")
    assert evaluate("run", with_another, finished.parent).samples > 116


def test_a_run_says_what_trained_it_and_is_not_judged_by_it(finished, trained):
    """Older runs lack the versions, and their digests cover fewer arrays."""
    file = finished / "config.json"
    config = json.loads(file.read_text())
    assert config["versions"] == {"tracklake": version("tracklake"), "torch": version("torch")}
    wanted = evaluate("run", trained / "tensors", finished.parent).to_dict()
    for versions in ({"versions": {"tracklake": "0.0.1", "torch": None}}, {}):
        rest = {name: value for name, value in config.items() if name != "versions"}
        file.write_text(json.dumps(rest | versions | {"tensors": "0123456789ab"}))
        assert evaluate("run", trained / "tensors", finished.parent).to_dict() == wanted


def test_versions_of_what_is_not_installed_are_none(monkeypatch):
    monkeypatch.setattr("tracklake.training.runs.run_folder.TRAINED_BY", ("tracklake", "no-such-distribution"))
    assert find_versions() == {"tracklake": version("tracklake"), "no-such-distribution": None}


# What tells tensors apart


def test_the_digest_is_of_the_index_and_of_every_array(trained, monkeypatch):
    folder = TensorFolder.open(trained / "tensors")
    content = json.dumps(folder.index, sort_keys=True).encode()
    content += b"".join(folder.arrays[array.name].tobytes() for array in ARRAYS)
    wanted = hashlib.sha256(content).hexdigest()[:12]
    assert digest_tensors(folder) == wanted
    monkeypatch.setattr("tracklake.training.runs.run_folder.HASHED_BYTES", 1000)
    assert digest_tensors(folder) == wanted, "in pieces as in one"


@pytest.mark.parametrize("array", [array.name for array in ARRAYS])
def test_one_number_of_any_array_is_told(array, trained):
    folder = TensorFolder.open(trained / "tensors")
    other = folder.arrays[array].copy()
    other.view(np.uint8).reshape(-1)[-1] ^= 1
    assert digest_tensors(replace(folder, arrays={**folder.arrays, array: other})) != digest_tensors(folder)


def test_arrays_without_rows_have_a_digest(tmp_path):
    folder = TensorFolder.open(write_tiny(tmp_path, PARTS[:0], subsets=""))
    assert len(folder.position_m) == 0
    assert len(digest_tensors(folder)) == 12
