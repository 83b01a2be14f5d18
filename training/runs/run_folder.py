"""Trained runs on disk: `config.json` (model, settings and data), `weights.pt`, `metrics.json`, and two logs."""

import json
import shutil
import zlib
from collections.abc import Iterable
from dataclasses import asdict
from importlib.metadata import distributions, version
from itertools import chain
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from tracklake.schemas.errors import UNREADABLE, UsageError
from tracklake.schemas.files import replace_folder
from tracklake.schemas.hashing import hash_chunks
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.run_config import AGAIN, RUN_VERSION, StaleRunError, read_config
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Predictor, Recipe, find_model
from tracklake.training.models.own import OWN_FILES
from tracklake.training.runs.checkpoint import RESTART, UnfinishedError, describe_damage, is_unfinished

if TYPE_CHECKING:
    from torch import nn

TRAINED_BY = ("tracklake", "torch")
"""Distributions whose versions a run records."""
UNCHANGING = frozenset({"threads", "device", "log_steps", "checkpoint_s"})
"""Settings of a training that say how it is run and logged, not what is learned."""
HASHED_BYTES = 1 << 22
"""Size of the pieces that are hashed, in bytes, so that Ctrl-C does not wait for a whole array."""


def describe_run(
    model: str, parameters: dict[str, Any], config: dict[str, Any], folder: TensorFolder, recipe: Recipe | None = None
) -> dict[str, Any]:
    """Return the content of `config.json` without the versions; a model without recipe does not learn.

    `code` is the digest of the file of a user's own model, so that no run is used with other code.
    """
    run = {
        "version": RUN_VERSION,
        "model": model,
        "parameters": parameters,
        "training": config,
        "recipe": recipe and asdict(recipe),
        "protocol": folder.index["protocol"],
        "split": folder.split,
        "train_subsets": sorted(folder.subsets_of("train")),
        "val_subsets": sorted(folder.subsets_of("val")) if config.get("patience") else [],
        "blocks": folder.index["blocks"],
        "tensors": digest_tensors(folder),
    }
    if ":" in model:  # a user's own
        run["code"] = OWN_FILES[model.partition(":")[0]][1]
    return dict(json.loads(json.dumps(run, allow_nan=False)))


def digest_tensors(folder: TensorFolder) -> str:
    """Return the digest of the index and of every array: a training resumes on tensors of the same digest only."""
    flat = (folder.arrays[array.name].reshape(-1).view(np.uint8) for array in ARRAYS)
    pieces = (data[first : first + HASHED_BYTES] for data in flat for first in range(0, len(data), HASHED_BYTES))
    index = json.dumps(folder.index, sort_keys=True).encode()  # states each array's dtype and shape
    return hash_chunks(chain([index], pieces), 12)


def find_versions() -> dict[str, str | None]:
    """Return the installed versions of the packages that train; None where one is not installed."""
    return {name: version(name) if any(distributions(name=name)) else None for name in TRAINED_BY}


def save_run(
    out: Path, config: dict[str, Any], metrics: dict[str, Any], network: "nn.Module | None", logs: Iterable[Path] = ()
) -> None:
    """Write a run's folder, with copies of its logs, under a hidden name, and rename it when it is whole.

    A run of that name is replaced. `config.json` (see `describe_run`) also records the versions of `find_versions`.
    """
    with replace_folder(out) as aside:
        if network is not None:
            import torch

            torch.save(network.state_dict(), aside / "weights.pt")
        for log in logs:
            shutil.copyfile(log, aside / log.name)
        (aside / "metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False), encoding="utf-8")
        recorded = config | {"versions": find_versions()}
        (aside / "config.json").write_text(json.dumps(recorded, indent=1, allow_nan=False), encoding="utf-8")


def load_run(path: Path, protocol: Protocol) -> tuple[dict[str, Any], Predictor]:
    """Load a trained run for tensors of a protocol: its config, and the model with the trained weights.

    StaleRunError where it is damaged or of another version, protocol or model; MissingExtraError without torch.
    """
    config = read_config(path)
    if config["protocol"]["digest"] != protocol.digest:
        raise StaleRunError(
            f"{path}: trained for the protocol {config['protocol']['name']} ({config['protocol']['digest']}), the "
            f"tensors are of {protocol.name} ({protocol.digest}); train it again on these tensors"
        )
    try:
        model = find_model(config["model"])
        predictor = model.build(protocol, **config["parameters"])
    except (UsageError, *UNREADABLE) as wrong:
        advice = "run the command where the module is found" if ":" in config["model"] else AGAIN
        raise StaleRunError(f"{path}: {wrong}; {advice}") from None
    if ":" in model.name and config.get("code") != OWN_FILES[model.module][1]:
        raise StaleRunError(f"{path}: the file of `{model.name}` has changed since; restore it, or {AGAIN}")
    if model.learns:
        load_weights(predictor, path / "weights.pt")
        predictor.eval()
    return config, predictor


def load_weights(network: "nn.Module", file: Path) -> None:
    """Load a network's weights without running any code of the file."""
    import torch

    try:
        with ZipFile(file) as archive:
            changed = archive.testzip()  # torch itself does not compare the checksums that it writes
        if changed is not None:
            raise BadZipFile(f"`{changed}` has another checksum")
        network.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"))
    except (*UNREADABLE, BadZipFile, EOFError, UnpicklingError, zlib.error) as wrong:
        reason = f"damaged, or not the weights of this model ({describe_damage(wrong)})"
        raise StaleRunError(f"{file}: {reason}; {AGAIN}") from None


def refuse_unfinished(path: Path) -> None:
    """Raise StaleRunError for a run whose training was interrupted and has not been resumed."""
    if not (path / "config.json").is_file() and is_unfinished(path):
        command = f"`tracklake train MODEL --name {path.name} --resume`"
        raise StaleRunError(f"{path}: the training of this run was interrupted; finish it first: {command}")


def refuse_replacement(out: Path, run: dict[str, Any]) -> None:
    """Raise UsageError where there is a run of that name of another model, protocol, or of other settings.

    One of other tensors, or one that cannot be read, may be replaced: it is of no more use.
    """
    try:
        there, asked = select_settings(read_config(out)), select_settings(run)
    except (StaleRunError, OSError):
        return
    names = there.keys() & asked.keys() if there["model"] == asked["model"] else {"model"}
    there, asked = ({name: own[name] for name in names} for own in (there, asked))
    differing = list_differences(there, asked, "there", "asked for")
    if differing:
        raise UsageError(
            f"{out}: there is a run of this name, and another one was asked for: {differing}. Give the new one another "
            "name (`--name`), or replace the old one (`--anew`)"
        )


def select_settings(run: dict[str, Any]) -> dict[str, Any]:
    """Select from a run's config what decides its weights besides the data, by name; without what ran it alone."""
    training = dict(run["training"])
    given, recipe = training.pop("parameters", None), run["recipe"] or {}
    settings = {name: value for name, value in training.items() if name not in {*UNCHANGING, *recipe}}
    if recipe:
        settings |= {**recipe, **run["parameters"]}
    elif given is not None:  # of a fitted model; what was fitted follows from the data
        settings["--set"] = given
    return {**settings, "model": run["model"], "protocol": run["protocol"]["name"]}


def list_differences(one: dict[str, Any], other: dict[str, Any], here: str, there: str) -> str:
    """List settings of two runs that differ, with the words that tell which value is whose."""
    return "; ".join(
        f"other {name}"
        if isinstance(one.get(name), list)
        else f"{name} {show_setting(one.get(name))} {here}, {show_setting(other.get(name))} {there}"
        for name in sorted(one.keys() | other.keys())
        if one.get(name) != other.get(name)
    )


def show_setting(value: object) -> str:
    """Show a setting in a message."""
    if isinstance(value, dict):
        return " ".join(f"{name}={own}" for name, own in value.items()) or "nothing"
    return "not set" if value is None else str(value)


def refuse_other_run(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise UnfinishedError where settings or data differ from those that a checkpoint's training was started with."""
    differing = list_differences(_flatten(then), _flatten(now), "then", "now")
    if differing:
        raise UnfinishedError(
            f"{path}: this training was started with other settings or data: {differing}. Resume with the same "
            f"(`--resume` alone takes the settings from the checkpoint), or {RESTART}"
        )


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def refuse_leak(config: dict[str, Any], folder: TensorFolder, part: str) -> None:
    """Raise StaleRunError where a part to evaluate holds data that the run was trained on.

    Where the split has changed since, no subset of the part may be one that the run was trained on, or that its weights
    were chosen by (`patience`); otherwise the split itself keeps the parts apart.
    """
    if config["blocks"] == folder.index["blocks"]:
        return
    seen = sorted({*config["train_subsets"], *config.get("val_subsets", ())} & folder.subsets_of(part))
    if seen:
        raise StaleRunError(
            f"{folder.path}: the run was trained on another allocation of the split, and {len(seen)} subset(s) of "
            f"`{part}` ({', '.join(seen[:5])}) were in its training part, or chose its weights; {AGAIN} on "
            "these tensors"
        )
