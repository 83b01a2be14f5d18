"""Which raw files a folder holds, recognised by content."""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.lake import write_aside
from pipeline.lake.manifest import MANIFEST
from pipeline.sources import SOURCES, RawFile, Source, SourceError
from pipeline.sources.base import Unit
from pipeline.sources.raw_files import read_head

SUFFIXES = (".csv", ".txt", ".dat", ".gz", "")
"""Endings under which trajectory files circulate; others (pictures, Parquet, documents) are passed by."""

PROSE = (".txt", ".dat", "")
"""Of these, endings that documents share: unrecognised, they are passed by and named, not refused."""

HASHES = ".hashes.json"


@dataclass(frozen=True)
class Discovery:
    """What a SOURCE holds.

    Args:
        units: files to be read together, by source.
        refusals: messages about files that look like raw data but cannot be used.
        passed_by: names of files that are no raw data.
    """

    units: tuple[tuple[Source, Unit], ...]
    refusals: tuple[str, ...]
    passed_by: tuple[str, ...]


def discover(source: Path, *, dataset: str | None = None, digest: Callable[[Path], str]) -> Discovery:
    """Find and group the raw files of a file or folder.

    Args:
        source: a file, or a folder searched at any depth (hidden folders apart).
        dataset: take files for this dataset only.
        digest: sha256 of a file.

    Raises:
        SourceError: nothing there, or nothing recognised in it.
    """
    candidates = _candidates(source)
    sources = [item for item in SOURCES if dataset in (None, item.name)]
    recognised: dict[str, list[RawFile]] = {item.name: [] for item in sources}
    refusals: list[str] = []
    passed_by: list[str] = []
    seen: dict[str, str] = {}
    for path in candidates:
        name = path.name if source.is_file() else path.relative_to(source).as_posix()
        if path.suffix.lower() not in SUFFIXES:
            passed_by.append(name)
            continue
        try:
            head = read_head(path)
        except SourceError as damage:
            refusals.append(str(damage).replace(path.name, name, 1))
            continue
        except OSError as refused:
            refusals.append(f"{name}: cannot be read ({refused.strerror}). Give yourself the right to read it.")
            continue
        match = next(((item, d) for item in sources if (d := item.detect(head, path.name)) is not None), None)
        if match is None:
            if path.suffix.lower() in PROSE and not source.is_file():
                passed_by.append(name)
            else:
                refusals.append(_unknown(name, head, sources))
            continue
        sha256 = digest(path)
        if sha256 in seen and match[0].spill is not None:
            refusals.append(f"{name}: the same bytes as {seen[sha256]}, which was read; remove one of the two.")
            continue
        seen[sha256] = name
        recognised[match[0].name].append(RawFile(path, name, match[1], sha256))
    units: list[tuple[Source, Unit]] = []
    for item in sources:
        grouping = item.group(recognised[item.name])
        units += [(item, unit) for unit in grouping.units]
        refusals += grouping.refusals
    if not units and not refusals:
        raise SourceError(_nothing(source, candidates, sources))
    return Discovery(tuple(units), tuple(refusals), tuple(passed_by))


def _candidates(source: Path) -> list[Path]:
    if not source.exists():
        raise SourceError(
            f"{source}: no such file or folder. Give the folder with the raw files as downloaded, or one file; "
            "`tracklake sample --out sample` generates some to try with."
        )
    if source.is_file():
        return [source]
    found: list[Path] = []
    visited: set[str] = set()
    for folder, below, names in os.walk(source, followlinks=True):
        real = os.path.realpath(folder)
        below[:] = [] if real in visited else [name for name in below if not name.startswith(".")]
        if real not in visited:
            found += [Path(folder, name) for name in names if not name.startswith(".")]
        visited.add(real)
    return sorted(path for path in found if path.is_file())


def _expected(sources: list[Source]) -> str:
    return "; ".join(item.looks_like for item in sources)


def _unknown(name: str, head: bytes, sources: list[Source]) -> str:
    if not head.strip():
        return f"{name}: empty file. Expected {_expected(sources)}. Download it again."
    line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    shown = line if len(line) <= 100 else f"{line[:100]}..."
    return (
        f"{name}, line 1: not a known trajectory file. Expected {_expected(sources)}. Got {shown!r}. "
        "Move the file out of the folder, or restore its header."
    )


def _nothing(source: Path, candidates: list[Path], sources: list[Source]) -> str:
    got = ", ".join(path.name for path in candidates[:5]) + (", ..." if len(candidates) > 5 else "")
    return (
        f"{source}: no raw recordings in it. Expected {_expected(sources)}. "
        f"Got {got or 'an empty folder'}. Give the folder into which the downloads were unpacked."
    )


_HASHED: dict[str, list[object]] = {}
"""Of this process: a lake that is still to be made has no place to keep hashes, and no file is read twice for them."""


class Digests:
    """sha256 of files, remembered by path, size and modification time so that idle reruns read nothing."""

    def __init__(self, root: Path) -> None:
        self._path = root / HASHES
        self._known: dict[str, list[object]] = {}
        try:
            remembered = json.loads(self._path.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError, ValueError):
            remembered = None  # nothing remembered, or not as it was written: everything is hashed again
        if isinstance(remembered, dict):
            self._known = {path: known for path, known in remembered.items() if isinstance(known, list)}
        self._changed = False

    def __call__(self, path: Path) -> str:
        """The sha256 of a file's bytes."""
        key, stat = str(path.resolve()), path.stat()
        state = [stat.st_size, stat.st_mtime_ns]
        if self._known.get(key, [])[:2] == state:
            return str(self._known[key][2])
        if _HASHED.get(key, [])[:2] != state:
            with path.open("rb") as handle:
                _HASHED[key] = [*state, hashlib.file_digest(handle, "sha256").hexdigest()]
        self._known[key] = _HASHED[key]
        self._changed = True
        return str(self._known[key][2])

    def save(self) -> None:
        """Keep what was computed beside the lake's manifest, where there is a lake."""
        if self._changed and self._path.with_name(MANIFEST).exists():
            write_aside(self._path, json.dumps(self._known).encode())
