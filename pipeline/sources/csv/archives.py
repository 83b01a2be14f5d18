"""Zip archives read like folders: their members that may be raw files, and a member's bytes without unpacking."""

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
from tracklake.schemas.text import make_visible

ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06", b"PK\x07\x08")
"""First bytes of a zip archive, of an empty one, and of one in several volumes."""
ARCHIVE_SUFFIX = ".zip"
"""Ending of a zip archive's name."""
MACOS_FOLDER = "__MACOSX"
"""Folder that macOS adds to archives; it is ignored like a hidden file."""
ENCRYPTED = 1
"""Bit in a member's flags that says it is encrypted."""


@dataclass(frozen=True)
class ArchiveContents:
    """The files of an archive with a raw file's ending, names of the others, and messages about unreadable ones."""

    files: tuple[RawFile, ...]
    others: tuple[str, ...]
    refusals: tuple[str, ...]


def is_archive(path: Path) -> bool:
    """Recognise a zip archive by its first bytes, whatever its name."""
    with path.open("rb") as handle:
        return handle.read(4) in ZIP_MAGICS


def list_members(archive: RawFile, suffixes: Sequence[str]) -> ArchiveContents:
    """List the files of an archive; `suffixes` are endings of raw files, in lower case."""
    with _directory(archive) as directory:
        infos = [info for info in directory.infolist() if _is_visible_file(info.filename)]
    times = Counter(_inner_path(info.filename) for info in infos)
    files, others, unreadable = [], [], dict[str, list[str]]()
    for info in infos:
        inner = _inner_path(info.filename)
        name = f"{archive.name}/{make_visible(str(inner))}"
        if inner.suffix.lower() not in suffixes:
            others.append(name)
        elif obstacle := _find_obstacle(info, inner, times[inner], archive.name):
            unreadable.setdefault(obstacle, []).append(name)
        else:
            files.append(replace(archive, name=name, member=info.filename))
    refusals = [
        f"{names[0]}{f' and {len(names) - 1} more' if names[1:] else ''}: {obstacle}"
        for obstacle, names in unreadable.items()
    ]
    return ArchiveContents(tuple(sorted(files, key=lambda file: file.name)), tuple(sorted(others)), tuple(refusals))


def open_member(file: RawFile) -> BufferedReader:
    """Open a member for reading its bytes from the first to the last.

    Reading raises zipfile.BadZipFile, EOFError or zlib.error where the archive is damaged.

    Raises:
        SourceError: the archive is damaged, or the member is not in it any more.
    """
    assert file.member is not None
    with _directory(file) as directory:
        try:
            # The open member keeps the archive's file open. It reads like a buffered file but is not declared as one.
            return cast("BufferedReader", directory.open(file.member))
        except KeyError:
            raise SourceError(
                f"{file.name}: no longer in the archive, which has changed since it was listed. Run again."
            ) from None


def measure_member(file: RawFile, *, packed: bool = False) -> int:
    """Return a member's size in bytes, unpacked or as it is in the archive."""
    with _directory(file) as directory:
        member = directory.getinfo(file.member or "")
        return member.compress_size if packed else member.file_size


@contextmanager
def _directory(file: RawFile) -> Iterator[ZipFile]:
    """Open the archive of a file; damage to it is raised as a SourceError."""
    try:
        with ZipFile(file.path) as directory:
            yield directory
    except (BadZipFile, EOFError, RuntimeError, ValueError, OverflowError, struct.error, OSError) as damage:
        # A damaged offset is an invalid argument to the system; other OS errors are passed on.
        if isinstance(damage, OSError) and damage.errno != errno.EINVAL:
            raise
        raise SourceError(
            f"{file.name}: the archive is damaged or cut short ({str(damage)[:80]}). Expected a whole zip archive. "
            "Download it again."
        ) from None


def _inner_path(member: str) -> PurePosixPath:
    """Normalise a member's path: some programs write backslashes, some begin with a slash."""
    return PurePosixPath(member.replace("\\", "/").lstrip("/"))


def _is_visible_file(member: str) -> bool:
    if member.endswith(("/", "\\")):
        return False
    parts = _inner_path(member).parts
    return not any(part == MACOS_FOLDER or (part.startswith(".") and part != "..") for part in parts)


def _find_obstacle(info: ZipInfo, inner: PurePosixPath, times: int, archive: str) -> str | None:
    """Explain why a member with a raw file's ending cannot be read, or return None."""
    unpack = f"Unpack {archive} and give the folder."
    if info.flag_bits & ENCRYPTED:
        return f"encrypted. Expected an archive without a password. {unpack}"
    if info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
        return f"compressed by method {info.compress_type}. Expected 0 (stored) or 8 (deflated). {unpack}"
    if times > 1:
        return f"{times} members have this name. Expected one. {unpack}"
    if inner.suffix.lower() == ARCHIVE_SUFFIX:
        return f"an archive inside an archive, which is not read. Expected the raw files. {unpack}"
    return None
