"""Progress of a training: its state, logs, and checkpoints that it resumes from to the same weights bit for bit."""

import csv
import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
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

if TYPE_CHECKING:
    import torch
    from torch import nn
    from torch.optim import Optimizer

CHECKPOINT_FILE = "checkpoint.pt"
CHECKPOINT_VERSION = 5
"""Number of the checkpoint's layout; it grows when older checkpoints cannot be resumed exactly."""
RESTART = "start over with `--anew`"
Row = dict[str, float | int | str | None]

COLUMNS = {
    "course.csv": ("step", "epoch", "phase", "seconds", "loss", "learning_rate", "samples_per_s", "data_share"),
    "epochs.csv": ("epoch", "step", "phase", "seconds", "loss", "validation_loss", "best"),
}
"""Columns of each log; docs/training.md has their meanings."""


class UnfinishedError(TracklakeError):
    """A training cannot start or resume because of what an interrupted one left, or another process is training."""


@dataclass
class TrainingState:
    """Progress of a training between two steps, apart from weights and optimiser."""

    step: int = 0  # optimiser steps done; gives the epoch and the place in it, too
    samples: int = 0  # in these steps
    supervised: int = 0  # true positions that the loss covered in these steps
    elapsed_s: float = 0.0  # since the start, without interruptions
    stepping_s: float = 0.0  # time in steps, reading included
    reading_s: float = 0.0  # time for reading batches
    smooth_loss: float = math.nan  # running mean of the loss
    losses: list[float] = field(default_factory=list)  # of every step
    phases: list[tuple[str, int]] = field(default_factory=list)  # loss of each phase so far, and its first step
    course: list[Row] = field(default_factory=list)  # rows of course.csv
    epochs: list[Row] = field(default_factory=list)  # rows of epochs.csv
    logged: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)  # step, samples, stepping_s, reading_s at its last row
    best_loss: float | None = None  # smallest validation loss of the present phase
    best_epoch: int | None = None  # epoch of that loss
    best_weights: dict[str, Any] | None = None  # at its end
    stale_epochs: int = 0  # of the last phase since then

    @property
    def phase(self) -> str:
        """Loss of the present phase."""
        return self.phases[-1][0]

    def begin_phase(self, loss: str) -> None:
        """Begin a phase with another loss, which is not compared with the one before."""
        self.phases.append((loss, self.step))
        self.smooth_loss = math.nan
        self.best_loss = self.best_epoch = self.best_weights = None

    def count_step(self, loss: float, samples: int, supervised: int) -> None:
        """Count one more step with its loss and its numbers of samples and of supervised positions."""
        self.step += 1
        self.samples += samples
        self.supervised += supervised
        self.losses.append(loss)
        self.smooth_loss = loss if math.isnan(self.smooth_loss) else 0.98 * self.smooth_loss + 0.02 * loss

    def describe_phases(self) -> list[dict[str, Any]]:
        """Describe each phase: loss, steps, and the loss's mean over their first and last twentieth."""
        ends = [*(first for _, first in self.phases[1:]), self.step]
        phases = []
        for (loss, first), end in zip(self.phases, ends, strict=True):
            losses = self.losses[first:end]
            some = max(1, len(losses) // 20)
            means = {"loss_first": sum(losses[:some]) / some, "loss_last": sum(losses[-some:]) / some}
            phases.append({"loss": loss, "steps": len(losses), **means})
        return phases


@contextmanager
def open_log(path: Path, rows: list[Row]) -> Iterator[Callable[[Row], None]]:
    """Write known rows to a log and yield a function that adds one to the file, at once, and to `rows`."""
    with path.open("w", encoding="utf-8", newline="", buffering=1) as stream:
        writer = csv.DictWriter(stream, COLUMNS[path.name], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

        def write_row(row: Row) -> None:
            rows.append(row)
            writer.writerow(row)

        yield write_row


def locate_unfinished(run: Path) -> Path:
    """Return the folder where a run's training keeps checkpoint and logs; hidden, so that it is not taken for a run."""
    return run.parent / f".{run.name}.unfinished"


def is_unfinished(run: Path) -> bool:
    """Return whether there is a checkpoint to resume from."""
    return (locate_unfinished(run) / CHECKPOINT_FILE).is_file()


@contextmanager
def claim_folder(run: Path, *, resume: bool | None = False) -> Iterator[Path]:
    """Lock the folder of a run's checkpoint and logs; where it holds no checkpoint in the end, it is removed.

    To resume (True) there must be a checkpoint; where that is not decided (None), there must be none to lose.
    """
    folder, of_run = locate_unfinished(run), f"training of the run `{run.name}`"
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
