"""Files that appear whole under their name or not at all."""

import os
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from tracklake.schemas.errors import FileAccessError, explain_file_errors

SETTINGS_FILE = "tracklake.toml"
"""Name of a file of settings, in a working folder or in a lake."""
_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}\.tmp(\.wal)?")
"""Names of files that are not whole yet; DuckDB writes its log beside a database."""
MAX_LINKS = 40
"""Most links that lead from one to the next, as in Linux."""


def name_unfinished(target: Path) -> Path:
    """Return the hidden path beside a target under which it is written until it is whole."""
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")


def write_file(target: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Write bytes, or what a function writes to a stream, beside a target and rename it; on an error nothing changes.

    Raises:
        FileAccessError: the folder is missing or full, or may not be written to.
    """
    unfinished = name_unfinished(target)
    with explain_file_errors(target):
        try:
            with unfinished.open("wb") as stream:
                if isinstance(content, bytes):
                    stream.write(content)
                else:
                    content(stream)
                stream.flush()
                os.fsync(stream.fileno())
            unfinished.replace(target)
        except BaseException as error:
            with suppress(OSError):
                unfinished.unlink()
            if isinstance(error, OSError) and error.filename is not None:
                error.filename = str(target)  # the hidden name says nothing to a user
            raise
        sync(target.parent)


def write_output(target: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Write a file that a user named: whole or not at all, into what a link leads to, or into a pipe or device.

    What names a descriptor of this process (/dev/stdout, /dev/fd/3) is written where that stands.

    Raises:
        FileAccessError: it is a folder, or cannot be written.
    """
    if target.is_dir():
        raise FileAccessError(f"{target}: is a folder; name a file")
    descriptor = _find_descriptor(target)
    if descriptor is None and (target.is_file() or not target.exists()):
        write_file(Path(os.path.realpath(target)), content)
        return
    sys.stdout.flush()  # what was printed before stands before
    # Opened by its name, a file would be written from its start, under what others write through the descriptor.
    with (
        explain_file_errors(target),
        target.open("wb") if descriptor is None else os.fdopen(os.dup(descriptor), "wb") as stream,
    ):
        if isinstance(content, bytes):
            stream.write(content)
        else:
            content(stream)


def _find_descriptor(target: Path) -> int | None:
    """Return the descriptor of this process that a path names; None: it names none."""
    folders = (f"/proc/{os.getpid()}/fd", "/dev/fd")
    for _ in range(MAX_LINKS):
        if os.path.realpath(target.parent) in folders and target.name.isdecimal():
            return int(target.name)
        if not target.is_symlink():
            break
        target = target.parent / target.readlink()
    return None


@contextmanager
def replace_folder(target: Path) -> Iterator[Path]:
    """Yield a new, hidden folder to write into, and put it in the target's place; on an error nothing changes.

    A folder that was there is deleted. Missing parents are made.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    aside, old = name_unfinished(target), name_unfinished(target)
    aside.mkdir()
    try:
        yield aside
        if target.exists():
            target.rename(old)  # a folder cannot be renamed over a full one
        try:
            aside.rename(target)
        except BaseException:
            if old.exists():
                old.rename(target)
            raise
    finally:
        for leftover in (aside, old):
            shutil.rmtree(leftover, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Delete the unfinished files that killed processes left in a folder."""
    for file in list_unfinished(folder):
        file.unlink()


def list_unfinished(folder: Path) -> list[Path]:
    """Return the unfinished files that killed processes left in a folder."""
    return [file for file in folder.glob(".*.tmp*") if is_unfinished(file.name) and file.is_file()]


def is_unfinished(name: str) -> bool:
    """Return whether a file's name is that of one that is not whole yet."""
    return _UNFINISHED.fullmatch(name) is not None


def sync(path: Path) -> None:
    """Make the bytes of a file, or the renames in a folder, survive a power cut; Windows opens no folders."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)  # Windows syncs what it may write
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
