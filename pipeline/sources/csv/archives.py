"""Zip archives as folders: which of their members may be raw files, and a member's bytes without unpacking to disk."""

import errno
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import cast
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from tracklake.pipeline.sources.source import RawFile, SourceError

MAGICS = (b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08")
"""Of an archive, an empty one, one in several volumes."""

ENDING = ".zip"
MACOS_FOLDER = "__MACOSX"
"""What a Mac adds to the archives it makes; as little the user's as a hidden file."""

ENCRYPTED = 1
"""The bit in a member's flags."""


@dataclass(frozen=True)
class Contents:
    """An archive's members that are files, hidden ones apart.

    Args:
        files: those whose ending says that they may be raw files, by name.
        others: names of those whose ending says that they are not.
        refusals: messages about those that may be raw files and cannot be read.
    """

    files: tuple[RawFile, ...]
    others: tuple[str, ...]
    refusals: tuple[str, ...]


def is_archive(path: Path) -> bool:
    """Whether a file begins as zip archives do, whatever it is called."""
    with path.open("rb") as handle:
        return handle.read(4) in MAGICS


def list_members(archive: RawFile, suffixes: Sequence[str]) -> Contents:
    """What an archive holds.

    Args:
        archive: the archive itself.
        suffixes: endings of raw files, in lower case.

    Raises:
        SourceError: the archive is damaged.
    """
    with _directory(archive) as directory:
        infos = [info for info in directory.infolist() if _is_visible_file(info.filename)]
    times = Counter(_inner_path(info.filename) for info in infos)
    files, others, unreadable = [], [], dict[str, list[str]]()
    for info in infos:
        inner = _inner_path(info.filename)
        name = f"{archive.name}/{inner}"
        if inner.suffix.lower() not in suffixes:
            others.append(name)
        elif complaint := _complaint(info, inner, times[inner], archive.name):
            unreadable.setdefault(complaint, []).append(name)
        else:
            files.append(replace(archive, name=name, member=info.filename))
    refusals = [
        f"{names[0]}{f' and {len(names) - 1} more' if names[1:] else ''}: {complaint}"
        for complaint, names in unreadable.items()
    ]
    return Contents(tuple(sorted(files, key=lambda file: file.name)), tuple(sorted(others)), tuple(refusals))


def open_member(file: RawFile) -> BufferedReader:
    """Open a member for reading its bytes from the first to the last.

    Reading raises zipfile.BadZipFile, EOFError or zlib.error where the archive is damaged.

    Raises:
        SourceError: the archive is damaged, or the member is not in it any more.
    """
    assert file.member is not None
    with _directory(file) as directory:
        try:
            # The open member keeps the archive's file open for itself. It reads as a buffered file, though it is not
            # declared as one.
            return cast("BufferedReader", directory.open(file.member))
        except KeyError:
            raise SourceError(
                f"{file.name}: not in the archive any more, which has changed since it was looked into. Run again."
            ) from None


def member_bytes(file: RawFile) -> int:
    """How long a member is, unpacked.

    Raises:
        SourceError: the archive is damaged.
    """
    with _directory(file) as directory:
        return directory.getinfo(file.member or "").file_size


@contextmanager
def _directory(file: RawFile) -> Iterator[ZipFile]:
    """The archive of a file, with whatever damage does to reading it said as a SourceError."""
    try:
        with ZipFile(file.path) as directory:
            yield directory
    except (BadZipFile, EOFError, RuntimeError, ValueError, OverflowError, struct.error, OSError) as damage:
        # A damaged position is an invalid argument to the system; its other errors are what they are.
        if isinstance(damage, OSError) and damage.errno != errno.EINVAL:
            raise
        raise SourceError(
            f"{file.name}: the archive is damaged or cut short ({str(damage)[:80]}). Expected a whole zip archive. "
            "Download it again."
        ) from None


def _inner_path(member: str) -> PurePosixPath:
    """Some programs write the folders of an archive with backslashes, some begin with the root."""
    return PurePosixPath(member.replace("\\", "/").lstrip("/"))


def _is_visible_file(member: str) -> bool:
    if member.endswith(("/", "\\")):
        return False
    parts = _inner_path(member).parts
    return not any(part == MACOS_FOLDER or (part.startswith(".") and part != "..") for part in parts)


def _complaint(info: ZipInfo, inner: PurePosixPath, times: int, archive: str) -> str | None:
    """Why a member that may be a raw file cannot be read, and what to do."""
    unpack = f"Unpack {archive} and give the folder."
    if info.flag_bits & ENCRYPTED:
        return f"encrypted. Expected an archive without a password. {unpack}"
    if info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        return f"compressed by method {info.compress_type}. Expected 0 (stored) or 8 (deflated). {unpack}"
    if times > 1:
        return f"{times} members of this name, of which no more than one can be meant. Expected one. {unpack}"
    if inner.suffix.lower() == ENDING:
        return f"an archive inside an archive, which is not looked into. Expected the raw files. {unpack}"
    return None
