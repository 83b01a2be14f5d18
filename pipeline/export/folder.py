"""Files of an export: all of them in their place, or none."""

import os
import shutil
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

from tracklake.schemas.errors import TracklakeError, explain_file_errors
from tracklake.schemas.files import sync


class ExportError(TracklakeError):
    """An export cannot be made as asked; the message says why and what to do."""


def refuse_taken(out: Path, names: Sequence[str], *, force: bool, lake: Path) -> None:
    """Refuse a place where the export would spoil something, before any work is done for it.

    Args:
        out: the folder; it may hold other things.
        names: of the files.
        force: whether files of these names may be replaced.
        lake: in which nothing but the lake's own files stands.

    Raises:
        ExportError: a file, the lake, or a folder that holds one of the names.
    """
    if out.exists() and not out.is_dir():
        raise ExportError(f"{out}: is a file; the export needs a folder. Name another with --out.")
    place = out.resolve()
    nearest = next(folder for folder in (place, *place.parents) if folder.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise ExportError(f"{out}: nothing can be put there, for {nearest} is no folder to write in. Name another.")
    if place.is_relative_to(lake.resolve()):
        raise ExportError(f"{out}: lies in the lake, which sweeps what is not its own. Name another folder with --out.")
    folders = [name for name in names if (out / name).is_dir()]
    if folders:
        raise ExportError(f"{out}: holds folders named {', '.join(folders)}. Name another folder with --out.")
    taken = [name for name in names if (out / name).exists()]
    if taken and not force:
        raise ExportError(f"{out}: holds {', '.join(taken)}. Name another folder with --out, or replace them: --force.")


def write_files(out: Path, names: Sequence[str], write: Callable[[Path], None]) -> None:
    """Write files aside and move them into a folder when all are complete.

    A new folder appears with all of them in one step. In one that is there, which may hold other things or be a disk of
    its own, they are renamed one after the other; if that fails, what stood there is put back.

    Args:
        out: the folder, made where it is missing.
        names: of the files that `write` makes.
        write: fills the folder it is given.

    Raises:
        FileAccessError: the disk is full, or rights are missing.
    """
    with explain_file_errors(out, "Free space there, or name another folder with --out."):
        _write_files(out, names, write)


def _write_files(out: Path, names: Sequence[str], write: Callable[[Path], None]) -> None:
    out = out.resolve()
    there = out.is_dir()
    if not there:
        out.parent.mkdir(parents=True, exist_ok=True)
    aside = (out if there else out.parent) / f".{out.name}.{uuid.uuid4().hex}.tmp"
    aside.mkdir()
    try:
        write(aside)
        for name in names:
            sync(aside / name)
        if there:
            _move_in(aside, out, names)
        else:
            aside.replace(out)
        sync(out)
        sync(out.parent)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _move_in(aside: Path, out: Path, names: Sequence[str]) -> None:
    before = aside / "before"
    before.mkdir()
    try:
        for name in names:
            if (out / name).exists():
                (out / name).replace(before / name)
            (aside / name).replace(out / name)
    except BaseException:
        # How far it came is seen from where the files are.
        for name in names:
            if (before / name).exists():
                (before / name).replace(out / name)
            elif not (aside / name).exists():
                (out / name).unlink(missing_ok=True)
        raise
