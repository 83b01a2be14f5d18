"""Trained runs on disk: `config.json` (what was trained on what), `weights.pt`, `metrics.json`."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from schemas.protocols import Protocol
from training.models import Predictor, find_model, require_torch
from training.tensors import TensorFolder

if TYPE_CHECKING:
    from torch import nn

RUN_VERSION = 1
"""Counts changes of `config.json` that older runs cannot be read with."""


class StaleRunError(ValueError):
    """A run cannot be judged on these tensors: it was made for others."""


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
    model: str, parameters: dict[str, Any], config: dict[str, Any], folder: TensorFolder
) -> dict[str, Any]:
    """What `config.json` holds.

    Args:
        model: its name in the registry.
        parameters: keywords of its `build`.
        config: how it was trained.
        folder: what it was trained on.
    """
    return {
        "version": RUN_VERSION,
        "model": model,
        "parameters": parameters,
        "training": config,
        "protocol": folder.index["protocol"],
        "split": folder.split,
        "train_subsets": sorted(folder.subsets_of("train")),
        "blocks": folder.index["blocks"],
    }


def save_run(out: Path, config: dict[str, Any], metrics: dict[str, Any], network: "nn.Module | None") -> None:
    """Write a run's folder aside and put it in place at once; a run of that name is replaced.

    Args:
        out: the run's folder.
        config: see `describe_run`.
        metrics: plain values.
        network: the trained module; None where the model does not learn.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    aside = out.parent / f".{out.name}.{uuid4().hex}.partial"
    aside.mkdir()
    try:
        if network is not None:
            import torch

            torch.save(network.state_dict(), aside / "weights.pt")
        (aside / "metrics.json").write_text(json.dumps(metrics, indent=1, allow_nan=False), encoding="utf-8")
        (aside / "config.json").write_text(json.dumps(config, indent=1, allow_nan=False), encoding="utf-8")
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
        ValueError: the run is of another version, or was trained for another protocol.
        ImportError: torch is needed and missing.
    """
    config = json.loads((path / "config.json").read_text(encoding="utf-8"))
    if config.get("version") != RUN_VERSION:
        raise StaleRunError(
            f"{path / 'config.json'}: expected version {RUN_VERSION}, got {config.get('version')}; train it again"
        )
    if config["protocol"]["digest"] != protocol.digest:
        raise StaleRunError(
            f"{path}: trained for the protocol {config['protocol']['name']} ({config['protocol']['digest']}), the "
            f"tensors are of {protocol.name} ({protocol.digest}); train it again on these tensors"
        )
    model = find_model(config["model"])
    predictor = model.build(protocol, **config["parameters"])
    if model.learns:
        require_torch(model.name)
        import torch

        predictor.load_state_dict(torch.load(path / "weights.pt", weights_only=True, map_location="cpu"))
        predictor.eval()
    return Run(config=config, predictor=predictor)


def refuse_leak(config: dict[str, Any], folder: TensorFolder, part: str) -> None:
    """Refuse to evaluate a run on what it was trained on.

    The split may have been drawn anew since the run was trained. Where it has, no subset of the part may be one that
    the run has seen; where it has not, the split itself keeps the parts apart.

    Args:
        config: the run's.
        folder: the tensors to evaluate on.
        part: the part to evaluate.

    Raises:
        ValueError: naming the subsets.
    """
    if config["blocks"] == folder.index["blocks"]:
        return
    seen = sorted(set(config["train_subsets"]) & folder.subsets_of(part))
    if seen:
        raise StaleRunError(
            f"{folder.path}: the run was trained on another allocation of the split, and {len(seen)} subset(s) of "
            f"`{part}` ({', '.join(seen[:5])}) were in its training part; train it again on these tensors"
        )
