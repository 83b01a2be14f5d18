"""Files of an export, which appear in their folder together or not at all."""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from tracklake.pipeline.lake import refuse_lake
from tracklake.schemas.errors import TracklakeError, explain_file_errors
from tracklake.schemas.files import name_unfinished, sync


class ExportError(TracklakeError):
    """An export cannot be made as asked; the message says why and what to do."""


def refuse_taken(out: Path, names: Sequence[str], *, force: bool) -> None:
    """Refuse a folder where the export would overwrite something, before any work is done.

    Raises:
        ExportError: the folder is a file, cannot be written to, or holds one of the names.
        LakeError: the folder lies in a lake.
    """
    refuse_lake(out)
    if out.exists() and not out.is_dir():
        raise ExportError(f"{out}: is a file; the export needs a folder. Name another with --out.")
    target = out.resolve()
    nearest = next(folder for folder in (target, *target.parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise ExportError(f"{out}: {nearest} is not a folder that can be written to. Name another with --out.")
    folders = [name for name in names if (out / name).is_dir()]
    if folders:
        raise ExportError(f"{out}: holds folders named {', '.join(folders)}. Name another folder with --out.")
    taken = [name for name in names if (out / name).exists()]
    if taken and not force:
        raise ExportError(f"{out}: holds {', '.join(taken)}. Name another folder with --out, or replace them: --force.")


def write_files(out: Path, names: Sequence[str], write: Callable[[Path], None]) -> None:
    """Write files into a hidden folder and move them into `out` when all are complete.

    A new folder appears with all files at once. In an existing folder, which may hold other files or be a disk of its
    own, the files are renamed one after the other; if that fails, the previous files are restored.

    Raises:
        FileAccessError: the disk is full, or rights are missing.
    """
    with explain_file_errors(out, "Free space there, or name another folder with --out."):
        _write_files(out, names, write)


def _write_files(out: Path, names: Sequence[str], write: Callable[[Path], None]) -> None:
    out = out.resolve()
    exists = out.is_dir()
    if not exists:
        out.parent.mkdir(parents=True, exist_ok=True)
    aside = name_unfinished(out / out.name if exists else out)
    aside.mkdir()
    try:
        write(aside)
        for name in names:
            sync(aside / name)
        if exists:
            _move_files(aside, out, names)
        else:
            aside.replace(out)
        sync(out)
        sync(out.parent)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _move_files(aside: Path, out: Path, names: Sequence[str]) -> None:
    before = aside / "before"
    before.mkdir()
    try:
        for name in names:
            if (out / name).exists():
                (out / name).replace(before / name)
            (aside / name).replace(out / name)
    except BaseException:
        # A file's location tells whether it had been moved.
        for name in names:
            if (before / name).exists():
                (before / name).replace(out / name)
            elif not (aside / name).exists():
                (out / name).unlink(missing_ok=True)
        raise
