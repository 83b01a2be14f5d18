"""Checkpoints: everything that decides how a training goes on, so that one that is resumed ends as if never stopped."""

import fcntl
import math
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from training.running.config import TrainConfig
from training.running.logs import Row
from training.running.torch_files import PARTIAL, DamagedFileError, load_weights, read_torch_file, write_torch_file

if TYPE_CHECKING:
    import torch
    from torch import nn

CHECKPOINT_VERSION = 2
"""Counts changes of the file, and of how a training goes on, that older checkpoints do not fit."""
CHECKPOINT_FILE = "checkpoint.pt"
LOCK_FILE = "lock"
ANEW = "begin anew (`--anew`)"


class UnfinishedError(ValueError):
    """A training cannot begin, or go on, as it stands on disk."""


@dataclass
class TrainingState:
    """Where a training stands, weights and optimiser apart.

    Args:
        step: optimiser steps done; says the epoch and the place in it, too.
        samples: in these steps.
        elapsed_s: since it began, interruptions left out.
        stepping_s: of these, in steps, batches read included.
        reading_s: of these, for batches.
        smooth_loss: running mean of the loss.
        losses: of every step.
        phases: loss of each phase so far, and its first step.
        course: rows of course.csv.
        epochs: rows of epochs.csv.
        marked: step, samples, stepping_s and reading_s at the last row of course.csv.
        best_loss: least validation loss of the present phase.
        best_epoch: where it was.
        best_weights: and with which weights.
        stale_epochs: of the last phase, since then.
    """

    step: int = 0
    samples: int = 0
    elapsed_s: float = 0.0
    stepping_s: float = 0.0
    reading_s: float = 0.0
    smooth_loss: float = math.nan
    losses: list[float] = field(default_factory=list)
    phases: list[tuple[str, int]] = field(default_factory=list)
    course: list[Row] = field(default_factory=list)
    epochs: list[Row] = field(default_factory=list)
    marked: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
    best_loss: float | None = None
    best_epoch: int | None = None
    best_weights: dict[str, Any] | None = None
    stale_epochs: int = 0

    def begin_phase(self, loss: str) -> None:
        """Another loss from here on; losses of two kinds are not compared."""
        self.phases.append((loss, self.step))
        self.smooth_loss = math.nan
        self.best_loss = self.best_epoch = self.best_weights = None

    def take_step(self, loss: float, samples: int) -> None:
        """One more step is done."""
        self.step += 1
        self.samples += samples
        self.losses.append(loss)
        self.smooth_loss = loss if math.isnan(self.smooth_loss) else 0.98 * self.smooth_loss + 0.02 * loss


_FIELDS = {own.name for own in fields(TrainingState)}
_KEYS = {"version", "run", "network", "optimizer", "random", "device_random", "state"}


def unfinished_folder(run: Path) -> Path:
    """Where a run's training keeps checkpoint and logs until it is done: hidden, so that no one takes it for a run."""
    return run.parent / f".{run.name}.unfinished"


def is_unfinished(run: Path) -> bool:
    """Whether there is a checkpoint to go on from."""
    return (unfinished_folder(run) / CHECKPOINT_FILE).is_file()


def refuse_wrong_start(run: Path, *, resume: bool | None) -> None:
    """Refuse to lose a checkpoint unasked, or to go on from one that is not there.

    Args:
        run: the run's folder.
        resume: True: to go on; False: to begin anew; None: the caller did not say.

    Raises:
        UnfinishedError: saying what to do.
    """
    folder = unfinished_folder(run)
    if resume is None and is_unfinished(run):
        raise UnfinishedError(
            f"{folder}: a training of the run `{run.name}` was interrupted; go on with it (`--resume`), or lose it and "
            f"{ANEW}"
        )
    if resume and not is_unfinished(run):
        raise UnfinishedError(f"{folder}: no interrupted training of the run `{run.name}` to resume; train it anew")


@contextmanager
def claim_folder(run: Path) -> Iterator[Path]:
    """The folder for a run's checkpoint and logs, to oneself; where no checkpoint came of it, it is removed.

    Raises:
        UnfinishedError: another process is training this run.
    """
    folder = unfinished_folder(run)
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UnfinishedError(
                f"{folder}: another process is training the run `{run.name}`; wait for it to end, or name this run "
                "otherwise (`--name`)"
            ) from None
        try:
            for left in folder.glob(f"*{PARTIAL}"):
                left.unlink()  # by a process that was killed while it wrote
            yield folder
        finally:
            if not (folder / CHECKPOINT_FILE).is_file():
                shutil.rmtree(folder)
    finally:
        os.close(descriptor)


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
        run: what is being trained on what, see `training.running.runs.describe_run`.
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
        DamagedFileError: it cannot be read, see `training.running.torch_files.read_torch_file`, or is of another
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
    except (TypeError, ValueError) as wrong:
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


@contextmanager
def holding_interrupts() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C wait until a step is done; half a step could not be saved. A second Ctrl-C does not wait.

    Where somebody else listens for it (or this is not the main thread, to which signals come), it is left to them.

    Returns:
        Says whether it was pressed.
    """
    pressed = False

    def note(_signal: int, _frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: False
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if pressed:  # after the last step
        raise KeyboardInterrupt
