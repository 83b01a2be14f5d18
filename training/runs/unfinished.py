"""The folder of a run whose training is not done: where it is, whose it is, and who may begin or go on in it."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tracklake.schemas.errors import TracklakeError
from tracklake.training.runs.torch_files import PARTIAL

CHECKPOINT_FILE = "checkpoint.pt"
LOCK_FILE = "lock"
ANEW = "begin anew (`--anew`)"


class UnfinishedError(TracklakeError):
    """A training cannot begin, or go on, as it stands on disk."""


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
