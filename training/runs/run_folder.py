"""Trained runs on disk: `config.json` (what was trained on what), `weights.pt`, `metrics.json`, and two logs."""

import hashlib
import json
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Predictor, find_model, require_torch
from tracklake.training.runs.unfinished import is_unfinished

if TYPE_CHECKING:
    from torch import nn

RUN_VERSION = 2
"""Counts changes of `config.json` or of the models that older runs cannot be read with."""

AGAIN = "train it again"
TRAINED_BY = ("tracklake", "torch")
"""Distributions whose versions a run names."""
KINDS = {"model": str, "parameters": dict, "protocol": dict, "train_subsets": list, "blocks": list}
"""Of what a run's config must hold."""
HASHED_BYTES = 1 << 22
"""At a time: Ctrl-C does not wait for a whole array."""


class StaleRunError(TracklakeError):
    """A run cannot be judged on these tensors: it was made for others, is unfinished, or is damaged."""


@dataclass(frozen=True)
class Run:
    """A run, loaded.

    Args:
        config: what `config.json` holds.
        predictor: the model, with the trained weights, ready to predict.
    """

    config: dict[str, Any]
    predictor: Predictor


def describe_run(
    model: str,
    parameters: dict[str, Any],
    config: dict[str, Any],
    folder: TensorFolder,
    recipe: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """What `config.json` holds (but for the versions, see `save_run`), as plain values.

    Args:
        model: its name in the registry.
        parameters: keywords of its `build`.
        config: how it was trained, as the caller said.
        folder: what it was trained on.
        recipe: and as the model's recipe then said; None where it does not learn.
    """
    run = {
        "version": RUN_VERSION,
        "model": model,
        "parameters": parameters,
        "training": config,
        "recipe": recipe,
        "protocol": folder.index["protocol"],
        "split": folder.split,
        "train_subsets": sorted(folder.subsets_of("train")),
        "val_subsets": sorted(folder.subsets_of("val")) if config.get("patience") else [],
        "blocks": folder.index["blocks"],
        "tensors": digest_tensors(folder),
    }
    plain: dict[str, Any] = json.loads(json.dumps(run, allow_nan=False))
    return plain


def digest_tensors(folder: TensorFolder) -> str:
    """First 12 hex digits of the sha256 of the index and of every array: all that a training can depend on.

    A training is gone on with on tensors of the same digest only; finished runs are judged without it.
    """
    digest = hashlib.sha256(json.dumps(folder.index, sort_keys=True).encode())  # says each array's dtype and shape
    for array in ARRAYS:
        data = getattr(folder, array.name).reshape(-1).view(np.uint8)
        for first in range(0, len(data), HASHED_BYTES):
            digest.update(data[first : first + HASHED_BYTES])
    return digest.hexdigest()[:12]


def find_versions() -> dict[str, str | None]:
    """Versions that are installed of what trains; None of what is not."""
    found: dict[str, str | None] = {}
    for name in TRAINED_BY:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def save_run(
    out: Path,
    config: dict[str, Any],
    metrics: dict[str, Any],
    network: "nn.Module | None",
    logs: Iterable[Path] = (),
) -> None:
    """Write a run's folder aside and put it in place at once; a run of that name is replaced.

    Args:
        out: the run's folder.
        config: see `describe_run`. `config.json` also says, for whoever wonders why two runs differ, the `versions` of
            `find_versions` that ended the training; nothing compares them.
        metrics: plain values.
        network: the trained module; None where the model does not learn.
        logs: files to copy into it.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    aside = out.parent / f".{out.name}.{uuid4().hex}.partial"
    aside.mkdir()
    try:
        if network is not None:
            from tracklake.training.runs.torch_files import write_torch_file

            write_torch_file(aside / "weights.pt", network.state_dict())
        for log in logs:
            shutil.copyfile(log, aside / log.name)
        (aside / "metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False), encoding="utf-8")
        said = config | {"versions": find_versions()}
        (aside / "config.json").write_text(json.dumps(said, indent=1, allow_nan=False), encoding="utf-8")
        if out.exists():
            # A folder cannot be renamed over a full one: the old one steps aside first.
            old = aside.with_suffix(".old")
            out.rename(old)
            aside.rename(out)
            shutil.rmtree(old)
        else:
            aside.rename(out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def load_run(path: Path, protocol: Protocol) -> Run:
    """Load a run for tensors of a protocol.

    Raises:
        StaleRunError: the run is of another version, was trained for another protocol, is of a model or has parameters
            that this version does not know, or is damaged.
        ImportError: torch is needed and missing.
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
    except (UsageError, ValueError, TypeError) as wrong:
        raise StaleRunError(f"{path}: {wrong}; {AGAIN}") from None
    if model.learns:
        require_torch(model.name)
        from tracklake.training.runs.torch_files import DamagedFileError, load_weights, read_torch_file

        weights = path / "weights.pt"
        try:
            load_weights(predictor, read_torch_file(weights, AGAIN), str(weights), AGAIN)
        except DamagedFileError as damaged:
            raise StaleRunError(str(damaged)) from None
        predictor.eval()
    return Run(config=config, predictor=predictor)


def read_config(path: Path) -> dict[str, Any]:
    """What a run's `config.json` holds.

    Raises:
        StaleRunError: it is of another version, or damaged.
    """
    file = path / "config.json"
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as broken:
        raise StaleRunError(f"{file}: not readable as JSON ({broken}); {AGAIN}") from None
    version = config.get("version") if isinstance(config, dict) else f"a {type(config).__name__}"
    if version != RUN_VERSION:
        raise StaleRunError(f"{file}: expected version {RUN_VERSION}, got {version}; {AGAIN}")
    lacking = sorted(name for name, kind in KINDS.items() if not isinstance(config.get(name), kind))
    if not lacking and not {"name", "digest"} <= config["protocol"].keys():
        lacking = ["the name and digest of a protocol"]
    if lacking:
        raise StaleRunError(f"{file}: expected {', '.join(lacking)} in it; {AGAIN}")
    return dict(config)


def refuse_unfinished(path: Path) -> None:
    """Refuse a run of which there is nothing but a training that was interrupted.

    Args:
        path: the run's folder.

    Raises:
        StaleRunError: saying how to go on.
    """
    if not (path / "config.json").is_file() and is_unfinished(path):
        raise StaleRunError(
            f"{path}: the training of this run was interrupted; finish it first: `tracklake train MODEL --name "
            f"{path.name} --resume`"
        )


def refuse_leak(config: dict[str, Any], folder: TensorFolder, part: str) -> None:
    """Refuse to evaluate a run on what it was trained on.

    The split may have been drawn anew since the run was trained. Where it has, no subset of the part may be one that
    the run was trained on, or that its weights were chosen by (`patience`); where it has not, the split itself keeps
    the parts apart.

    Args:
        config: the run's.
        folder: the tensors to evaluate on.
        part: the part to evaluate.

    Raises:
        ValueError: naming the subsets.
    """
    if config["blocks"] == folder.index["blocks"]:
        return
    seen = sorted({*config["train_subsets"], *config.get("val_subsets", ())} & folder.subsets_of(part))
    if seen:
        raise StaleRunError(
            f"{folder.path}: the run was trained on another allocation of the split, and {len(seen)} subset(s) of "
            f"`{part}` ({', '.join(seen[:5])}) were in its training part, or chose its weights; train it again "
            "on these tensors"
        )
