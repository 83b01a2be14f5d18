"""Checkpoints: everything that decides how a training goes on, so that one that is resumed ends as if never stopped."""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tracklake.schemas.errors import UsageError
from tracklake.training.runs.config import TrainConfig
from tracklake.training.runs.state import TrainingState
from tracklake.training.runs.torch_files import DamagedFileError, load_weights, read_torch_file, write_torch_file
from tracklake.training.runs.unfinished import ANEW, UnfinishedError

if TYPE_CHECKING:
    import torch
    from torch import nn

CHECKPOINT_VERSION = 2
"""Counts changes of the file, and of how a training goes on, that older checkpoints do not fit."""

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
    """Write where a training stands; only between two steps does it stand anywhere.

    Args:
        path: of the file; replaced at once where it exists.
        run: what is being trained on what, see `training.runs.run_folder.describe_run`.
        network: with its weights.
        optimizer: with its moments.
        state: the rest.
        device: whose random numbers the network draws.
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
    write_torch_file(path, content)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint holds, by name; whether it is this run's is for `restore` to say.

    Raises:
        DamagedFileError: it cannot be read, see `training.runs.torch_files.read_torch_file`, or is of another
            version.
    """
    content = read_torch_file(path, ANEW)
    if content.get("version") != CHECKPOINT_VERSION:
        raise DamagedFileError(
            f"{path}: expected version {CHECKPOINT_VERSION} of checkpoints, got {content.get('version')}; {ANEW}"
        )
    state = content.get("state")
    if content.keys() != _KEYS or not isinstance(state, dict) or state.keys() != _FIELDS:
        raise DamagedFileError(f"{path}: expected a checkpoint, got a file of {', '.join(sorted(content))}; {ANEW}")
    return content


def find_config(path: Path, content: dict[str, Any]) -> TrainConfig:
    """How the training of a checkpoint was begun.

    Args:
        path: of the file, for messages.
        content: as read.

    Raises:
        DamagedFileError: it does not say, or with settings that this version does not know.
    """
    run = content["run"]
    settings = run.get("training") if isinstance(run, dict) else None
    if not isinstance(settings, dict):
        raise DamagedFileError(f"{path}: expected the settings of a training in it, got {settings!r}; {ANEW}")
    unknown = sorted(map(str, settings.keys() - {own.name for own in fields(TrainConfig)}))
    if unknown:
        raise DamagedFileError(
            f"{path}: this training was begun with settings that this version does not know: {', '.join(unknown)}; go "
            f"on with the version that began it, or {ANEW}"
        )
    try:
        return TrainConfig(**settings)
    except (TypeError, UsageError) as wrong:
        raise DamagedFileError(f"{path}: expected the settings of a training, got others ({wrong}); {ANEW}") from None


def refuse_other_run(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuse to go on with other settings or other data than a training began with.

    Args:
        path: of the checkpoint.
        then: the run it is of.
        now: the run that is asked for.

    Raises:
        UnfinishedError: naming what differs.
    """
    differing = _find_differences(then, now)
    if differing:
        raise UnfinishedError(
            f"{path}: this training began otherwise: {'; '.join(differing)}. Go on with what it began with (`--resume` "
            f"alone takes the settings from the checkpoint), or {ANEW}"
        )


def _find_differences(then: object, now: object, name: str = "") -> list[str]:
    """What differs between two runs, by name."""
    if then == now:
        return []
    if isinstance(then, dict) and isinstance(now, dict):
        keys = sorted(then.keys() | now.keys())
        return [
            text
            for key in keys
            for text in _find_differences(then.get(key), now.get(key), f"{name}.{key}" if name else str(key))
        ]
    if isinstance(then, list) and any(isinstance(own, dict) for own in then):
        return [f"other {name}"]
    return [f"{name} {then} then, {now} now"]


def restore(
    path: Path,
    content: dict[str, Any],
    network: "nn.Module",
    optimizer: "torch.optim.Optimizer",
    device: "torch.device",
) -> TrainingState:
    """Put a training back to where its checkpoint was written, random numbers included.

    Args:
        path: of the file, for messages.
        content: as read.
        network: is given its weights.
        optimizer: is given its moments.
        device: see `save_checkpoint`.

    Raises:
        DamagedFileError: the weights, moments or random state do not fit.
    """
    import torch

    load_weights(network, content["network"], str(path), ANEW)
    try:
        optimizer.load_state_dict(content["optimizer"])
        torch.set_rng_state(content["random"])
        if device.type == "cuda":
            torch.cuda.set_rng_state(content["device_random"], device)
        plain = content["state"]
        return TrainingState(**(plain | {"losses": plain["losses"].tolist()}))
    except (ValueError, LookupError, TypeError, AttributeError, RuntimeError) as wrong:
        raise DamagedFileError(f"{path}: not a checkpoint of this training ({wrong}); {ANEW}") from None
