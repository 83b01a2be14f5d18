"""Checkpoints of a training, from which it resumes to the same weights bit for bit."""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tracklake.schemas.errors import UsageError
from tracklake.schemas.files import write_file
from tracklake.training.runs.config import TrainConfig
from tracklake.training.runs.state import TrainingState
from tracklake.training.runs.torch_files import DamagedFileError, load_weights, read_torch_file
from tracklake.training.runs.unfinished import RESTART, UnfinishedError

if TYPE_CHECKING:
    import torch
    from torch import nn

CHECKPOINT_VERSION = 3
"""Number of the checkpoint's layout; it grows when older checkpoints cannot be resumed exactly."""

_FIELDS = {own.name for own in fields(TrainingState)}
_KEYS = {"version", "run", "network", "optimizer", "random", "device_random", "state"}


def save_checkpoint(
    path: Path,
    run: dict[str, Any],
    network: "nn.Module",
    optimizer: "torch.optim.Optimizer",
    state: TrainingState,
    device: "torch.device",
) -> None:
    """Write everything that decides how a training goes on after a step.

    Args:
        path: file of the checkpoint, replaced where it exists.
        run: model, settings and data, see `training.runs.run_folder.describe_run`.
        network: weights to save.
        optimizer: moments to save.
        state: progress of the training.
        device: device whose random state the network draws from.
    """
    import torch

    plain = {name: getattr(state, name) for name in _FIELDS}
    content = {
        "version": CHECKPOINT_VERSION,
        "run": run,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "random": torch.get_rng_state(),
        "device_random": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
        "state": plain | {"losses": torch.tensor(state.losses, dtype=torch.float64)},
    }
    write_file(path, lambda stream: torch.save(content, stream))


def read_checkpoint(path: Path) -> tuple[dict[str, Any], TrainConfig]:
    """Read a checkpoint, and the settings that its training was started with.

    Raises:
        DamagedFileError: it is damaged, of another version, or holds other content.
    """
    content = read_torch_file(path, RESTART)
    if content.get("version") != CHECKPOINT_VERSION:
        raise DamagedFileError(
            f"{path}: expected version {CHECKPOINT_VERSION} of checkpoints, got {content.get('version')}; {RESTART}"
        )
    state, run = content.get("state"), content.get("run")
    settings = run.get("training") if isinstance(run, dict) else None
    if content.keys() != _KEYS or not isinstance(state, dict) or state.keys() != _FIELDS:
        raise DamagedFileError(f"{path}: expected a checkpoint, got a file of {', '.join(sorted(content))}; {RESTART}")
    try:
        return content, TrainConfig(**settings)  # type: ignore[arg-type]  # checked by the call itself
    except (TypeError, UsageError) as wrong:
        raise DamagedFileError(
            f"{path}: expected settings of a training that this version knows ({wrong}); resume with the version that "
            f"started it, or {RESTART}"
        ) from None


def restore(
    path: Path,
    content: dict[str, Any],
    network: "nn.Module",
    optimizer: "torch.optim.Optimizer",
    device: "torch.device",
) -> TrainingState:
    """Restore weights, moments and random state from a checkpoint, and return the progress.

    Raises:
        DamagedFileError: the weights, moments or random state do not fit.
    """
    import torch

    load_weights(network, content["network"], path, RESTART)
    try:
        optimizer.load_state_dict(content["optimizer"])
        torch.set_rng_state(content["random"])
        if device.type == "cuda":
            torch.cuda.set_rng_state(content["device_random"], device)
        plain = content["state"]
        return TrainingState(**(plain | {"losses": plain["losses"].tolist()}))
    except (ValueError, LookupError, TypeError, AttributeError, RuntimeError) as wrong:
        raise DamagedFileError(f"{path}: not a checkpoint of this training ({wrong}); {RESTART}") from None


def refuse_other_run(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to resume with other settings or data than the training was started with.

    Raises:
        UnfinishedError: names the differences.
    """
    old, new = _flatten(then), _flatten(now)
    differing = [
        f"other {name}" if isinstance(old.get(name), list) else f"{name} {old.get(name)} then, {new.get(name)} now"
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    ]
    if differing:
        raise UnfinishedError(
            f"{path}: this training was started with other settings or data: {'; '.join(differing)}. Resume with the "
            f"same (`--resume` alone takes the settings from the checkpoint), or {RESTART}"
        )


def _flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat
