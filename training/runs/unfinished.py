"""The hidden folder of a run whose training is not done, with its checkpoint and logs."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.files import remove_unfinished

CHECKPOINT_FILE = "checkpoint.pt"
LOCK_FILE = "lock"
RESTART = "start over with `--anew`"


class UnfinishedError(TracklakeError):
    """A training cannot start or resume because of what an interrupted one left."""


def unfinished_folder(run: Path) -> Path:
    """Return the folder where a run's training keeps checkpoint and logs; hidden, so that it is not taken for a run."""
    return run.parent / f".{run.name}.unfinished"


def is_unfinished(run: Path) -> bool:
    """Return whether there is a checkpoint to resume from."""
    return (unfinished_folder(run) / CHECKPOINT_FILE).is_file()


def refuse_wrong_start(run: Path, *, resume: bool | None) -> None:
    """Refuse to discard a checkpoint without being told to, or to resume without one.

    Args:
        run: the run's folder.
        resume: True: resume; False: start over; None: start unless there is a checkpoint.

    Raises:
        UnfinishedError: says what to do.
    """
    folder = unfinished_folder(run)
    if resume is None and is_unfinished(run):
        raise UnfinishedError(
            f"{folder}: a training of the run `{run.name}` was interrupted; resume it (`--resume`), or {RESTART}"
        )
    if resume and not is_unfinished(run):
        raise UnfinishedError(
            f"{folder}: no interrupted training of the run `{run.name}` to resume; train without `--resume`"
        )


@contextmanager
def claim_folder(run: Path) -> Iterator[Path]:
    """Lock the folder of a run's checkpoint and logs; where it holds no checkpoint in the end, it is removed.

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
                f"{folder}: another process is training the run `{run.name}`; wait for it to end, or choose another "
                "name (`--name`)"
            ) from None
        remove_unfinished(folder)
        try:
            yield folder
        finally:
            if not (folder / CHECKPOINT_FILE).is_file():
                shutil.rmtree(folder)
    finally:
        os.close(descriptor)
