"""Files that appear whole under their name or not at all."""

import os
import re
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from tracklake.schemas.errors import FileAccessError, explain_file_errors

_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{32}\.tmp(\.wal)?")
"""Names of files that are not whole yet; DuckDB writes its log beside a database."""


def name_unfinished(target: Path) -> Path:
    """Return the hidden path beside a target under which it is written until it is whole."""
    return target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")


def write_file(target: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Write a file beside its target, sync it and rename it; on an error what stood there before stays.

    Args:
        target: path of the file; its folder exists.
        content: bytes, or a function that writes them to an open binary stream.

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
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
        sync(target.parent)


def write_output(target: Path, content: bytes | Callable[[BinaryIO], object]) -> None:
    """Write a file that a user named: whole or not at all, into what a link leads to, or into a pipe or device.

    Raises:
        FileAccessError: it is a folder, or cannot be written.
    """
    if target.is_dir():
        raise FileAccessError(f"{target}: is a folder; name a file")
    if not _is_stream(target):
        write_file(target.resolve(), content)
        return
    with explain_file_errors(target), target.open("ab") as stream:
        if isinstance(content, bytes):
            stream.write(content)
        else:
            content(stream)


def _is_stream(target: Path) -> bool:
    """Return whether a path is a pipe, a device or an open descriptor (/dev/stdout), which nothing may replace."""
    leads_to = target.readlink() if target.is_symlink() else target
    places = (target.parent.resolve(), target.parent / leads_to)
    return any(Path("/proc") in place.parents for place in places) or (target.exists() and not target.is_file())


def remove_unfinished(folder: Path) -> None:
    """Delete the unfinished files that killed processes left in a folder."""
    for file in list_unfinished(folder):
        file.unlink()


def list_unfinished(folder: Path) -> list[Path]:
    """Return the unfinished files that killed processes left in a folder."""
    return [file for file in folder.glob(".*.tmp*") if _UNFINISHED.fullmatch(file.name) and file.is_file()]


def sync(path: Path) -> None:
    """Make the bytes of a file, or the renames in a folder, survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
