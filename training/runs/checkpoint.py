"""Checkpoints of a training, from which it resumes to the same weights bit for bit, in a hidden folder of its run."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from tracklake.schemas.documents import parse_json
from tracklake.schemas.errors import UNREADABLE, TracklakeError, UsageError
from tracklake.schemas.files import remove_unfinished, write_file
from tracklake.schemas.hashing import hash_chunks
from tracklake.training.runs.config import TrainConfig
from tracklake.training.runs.progress import TrainingState

if TYPE_CHECKING:
    import torch
    from torch import nn
    from torch.optim import Optimizer

CHECKPOINT_FILE = "checkpoint.pt"
CHECKPOINT_VERSION = 5
"""Number of the checkpoint's layout; it grows when older checkpoints cannot be resumed exactly."""
RESTART = "start over with `--anew`"


class UnfinishedError(TracklakeError):
    """A training cannot start or resume because of what an interrupted one left, or another process is training."""


def unfinished_folder(run: Path) -> Path:
    """Return the folder where a run's training keeps checkpoint and logs; hidden, so that it is not taken for a run."""
    return run.parent / f".{run.name}.unfinished"


def is_unfinished(run: Path) -> bool:
    """Return whether there is a checkpoint to resume from."""
    return (unfinished_folder(run) / CHECKPOINT_FILE).is_file()


@contextmanager
def claim_folder(run: Path, *, resume: bool | None = False) -> Iterator[Path]:
    """Lock the folder of a run's checkpoint and logs; where it holds no checkpoint in the end, it is removed.

    To resume (True) there must be a checkpoint; where that is not decided (None), there must be none to lose.
    """
    folder, of_run = unfinished_folder(run), f"training of the run `{run.name}`"
    if resume is None and is_unfinished(run):
        raise UnfinishedError(f"{folder}: a {of_run} was interrupted; resume it (`--resume`), or {RESTART}")
    if resume and not is_unfinished(run):
        raise UnfinishedError(f"{folder}: no interrupted {of_run} to resume; train without `--resume`")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(folder / "lock", thread_local=False).acquire(blocking=False)
    except Timeout:
        other = f"another process is training the run `{run.name}`"
        raise UnfinishedError(f"{folder}: {other}; wait for it to end, or choose another name (`--name`)") from None
    with held:
        remove_unfinished(folder)
        try:
            yield folder
        finally:
            if not is_unfinished(run):
                shutil.rmtree(folder, ignore_errors=True)  # Windows keeps the lock's file while it is held


def save_checkpoint(
    path: Path,
    run: dict[str, Any],
    network: "nn.Module",
    optimizer: "Optimizer",
    state: TrainingState,
    device: "torch.device",
) -> None:
    """Write everything that decides how a training goes on.

    The file is two lines, the checksum of all that follows and `run` (see `run_folder.describe_run`) as JSON, and then
    torch's own format.
    """
    import torch

    content = {
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "random": torch.get_rng_state(),
        "device_random": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
        "state": vars(state) | {"losses": torch.tensor(state.losses, dtype=torch.float64)},
    }
    stream = BytesIO()
    torch.save(content, stream)
    body = json.dumps({"version": CHECKPOINT_VERSION, "run": run}).encode() + b"\n" + stream.getvalue()
    write_file(path, hash_chunks([body]).encode() + b"\n" + body)


def read_checkpoint(path: Path) -> tuple[dict[str, Any], TrainConfig]:
    """Read a checkpoint, with `run`, and the settings that its training was started with; no code of it is run."""
    import torch

    checksum, _, body = path.read_bytes().partition(b"\n")
    if checksum != hash_chunks([body]).encode():
        raise UnfinishedError(f"{path}: damaged, or no checkpoint of this version; {RESTART}")
    header, _, content = body.partition(b"\n")
    try:
        started = parse_json(header.decode())
        if started["version"] != CHECKPOINT_VERSION:
            raise ValueError(f"expected version {CHECKPOINT_VERSION}, got {started['version']}")
        config = TrainConfig(**started["run"]["training"])
        return torch.load(BytesIO(content), weights_only=True, map_location="cpu") | started, config
    except (*UNREADABLE, UnpicklingError, UsageError) as wrong:
        raise UnfinishedError(
            f"{path}: no checkpoint that this version of tracklake can resume ({describe_damage(wrong)}); resume with "
            f"the one that started the training, or {RESTART}"
        ) from None


def restore(
    path: Path, stored: dict[str, Any], network: "nn.Module", optimizer: "Optimizer", device: "torch.device"
) -> TrainingState:
    """Restore weights, moments and random state from a checkpoint's content, and return the progress."""
    import torch

    try:
        network.load_state_dict(stored["network"])
        optimizer.load_state_dict(stored["optimizer"])
        torch.set_rng_state(stored["random"])
        if device.type == "cuda":
            torch.cuda.set_rng_state(stored["device_random"], device)
        return TrainingState(**stored["state"] | {"losses": stored["state"]["losses"].tolist()})
    except UNREADABLE as wrong:
        raise UnfinishedError(f"{path}: not the weights of this model ({describe_damage(wrong)}); {RESTART}") from None


def describe_damage(error: Exception) -> str:
    """Return on one line why torch could not read or load the content of a file."""
    if isinstance(error, UnpicklingError):
        return "it holds objects that could run code, and was not read"
    return " ".join(str(error).split())
