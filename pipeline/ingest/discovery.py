"""Discovery: the raw files of a folder, recognised by their content."""

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path, PurePosixPath

from tracklake.pipeline.lake.manifest import MANIFEST
from tracklake.pipeline.sources import SOURCES, RawFile, Source, SourceError
from tracklake.pipeline.sources.column_mapping import ColumnMapping
from tracklake.pipeline.sources.csv import (
    ARCHIVE_SUFFIX,
    ArchiveContents,
    NoTableError,
    hash_raw,
    is_archive,
    list_members,
    read_head,
)
from tracklake.pipeline.sources.ngsim_heading import MAPPED, read_heading
from tracklake.pipeline.sources.source import Unit
from tracklake.schemas.documents import read_json
from tracklake.schemas.files import write_file
from tracklake.schemas.text import make_visible

TABLES = (".parquet", ".feather", ".arrow", ".mat")
"""Endings of binary tables."""
LOGS = (".json", ".jsonl", ".ndjson", ".log", ".hex", ".db3", ".zstd", ".yaml")
"""Endings of an instrumented vehicle's logs that other files have, too."""
MAPS = (".osm",)
"""Endings of maps, which lie beside recordings and are none."""
SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".gz", ".bag", ".mcap", *TABLES, *LOGS, *MAPS, ARCHIVE_SUFFIX, "")
"""Endings under which trajectory files circulate; files with others (pictures, documents) are skipped."""
PROSE = (".txt", ".dat", *TABLES, *LOGS, *MAPS, ARCHIVE_SUFFIX, "")
"""Endings that other files share: an unrecognised file with one is skipped and named, not refused."""
HASHES = ".hashes.json"
"""Name of the file in the lake that remembers raw files' hashes."""


@dataclass(frozen=True)
class Discovery:
    """The raw files of a SOURCE: units to be read together, by source; refusals; names of files that are no raw data.

    `recognised` are all files of a known format, whether or not they could be grouped with their others.
    """

    units: tuple[tuple[Source, Unit], ...]
    refusals: tuple[str, ...]
    skipped: tuple[str, ...]
    recognised: tuple[RawFile, ...] = ()


def discover(
    source: Path,
    *,
    dataset: str | None = None,
    digest: Callable[[RawFile], str],
    mapping: ColumnMapping | None = None,
    recording: str = "",
) -> Discovery:
    """Find and group the raw files of a file or folder.

    A folder is searched at any depth, but for hidden folders; an archive is a folder. `digest` returns the sha256 of a
    file's bytes; files that have the columns of `mapping` are read by it; `recording` names one that its file does not.

    Raises:
        SourceError: nothing there, or nothing recognised in it.
    """
    candidates, unreadable = _list_candidates(source)
    search = _Search([item for item in SOURCES if dataset in (None, item.name)], source, digest, mapping, recording)
    search.refusals += unreadable
    for path in candidates:
        search.sort_file(_open_raw(path, source))
    recognised = search.hash_files()
    units: list[tuple[Source, Unit]] = []
    refusals = search.refusals
    by_name = {item.name: item for item in search.sources}
    for item in search.sources:
        grouping = item.group(recognised[item.name])
        for unit in grouping.units:
            owner = item if unit.dataset is None else by_name.get(unit.dataset)
            if owner is not None:
                units.append((owner, unit))
            else:
                refusals.append(
                    f"recording {unit.recording}: its files are of {unit.dataset}, and --dataset asks for {dataset}. "
                    "Leave --dataset out, or name the other one."
                )
        refusals += grouping.refusals
    if not units and not refusals:
        raise SourceError(_explain_nothing(source, candidates, search.sources))
    return Discovery(tuple(units), tuple(refusals), tuple(search.skipped), tuple(chain(*recognised.values())))


def recognise(source: Path, dataset: str) -> list[RawFile]:
    """Find a dataset's raw files by their first lines alone; none is read to its end or hashed.

    Raises:
        SourceError: no such file or folder.
    """
    search = _Search([item for item in SOURCES if item.name == dataset], source, digest=lambda _file: "")
    for path in _list_candidates(source)[0]:
        search.sort_file(_open_raw(path, source))
    return [file for _, file in search.found]


def find_raw_files(source: Path) -> list[tuple[Source | None, RawFile]]:
    """Find the raw files of a file, folder or archive by their first lines, with the source that recognises each.

    Files of no known format are among them, with None, where their endings promise data, or the user named them.

    Raises:
        SourceError: no such file or folder.
    """
    search = _Search([*SOURCES], source, digest=lambda _file: "")
    files: list[tuple[Source | None, RawFile]] = []
    for path in _list_candidates(source)[0]:
        file, known, skipped = _open_raw(path, source), len(search.found), len(search.skipped)
        search.sort_file(file)
        files += search.found[known:]
        if len(search.found) == known and (len(search.skipped) == skipped or path == source):
            files.append((None, file))
    return files


@dataclass
class _Search:
    """The results of a search of a source that is going on; files are hashed when all are found."""

    sources: list[Source]
    source: Path
    digest: Callable[[RawFile], str]
    mapping: ColumnMapping | None = None
    recording: str = ""
    found: list[tuple[Source, RawFile]] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def sort_file(self, file: RawFile) -> None:
        """Sort a file of the source, or the members of an archive, into recognised, refused and skipped."""
        if file.path.suffix.lower() not in SUFFIXES:
            self.skipped.append(file.name)
            return
        with self._refusing(file):
            if is_archive(file.path):
                self._sort_members(file)
            else:
                self._detect_source(file)

    def _sort_members(self, archive: RawFile) -> None:
        contents = list_members(archive, SUFFIXES)
        before = self._count_results()
        self.refusals += contents.refusals
        for member in contents.files:
            with self._refusing(member):
                self._detect_source(member)
        self.skipped += contents.others
        if self._count_results() == before:
            self._skip_or_refuse(archive, _explain_archive(archive, contents, self.sources))

    def _count_results(self) -> tuple[int, int]:
        return len(self.found), len(self.refusals)

    def _detect_source(self, file: RawFile) -> None:
        try:
            head = read_head(file)
        except NoTableError as unknown:
            self._skip_or_refuse(file, str(unknown))
            return
        file = replace(file, recording=self.recording)
        if self.mapping is not None and read_heading(head, file.name, self.mapping) is not None:
            mapped = replace(file, dialect=MAPPED, columns=self.mapping.model_dump_json(exclude_defaults=True))
            self.found += [(item, mapped) for item in self.sources if item.name == self.mapping.dataset]
            return
        found = ((item, dialect) for item in self.sources if (dialect := item.detect(head, file.name)) is not None)
        source, dialect = next(found, (None, ""))
        if source is None:
            self._skip_or_refuse(file, _explain_unknown(file.name, head, self.sources, self.mapping))
            return
        self.found.append((source, replace(file, dialect=dialect)))

    def hash_files(self) -> dict[str, list[RawFile]]:
        """Hash the files that were found, by source; the second of two with the same bytes is refused."""
        recognised: dict[str, list[RawFile]] = {item.name: [] for item in self.sources}
        seen: dict[str, str] = {}
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as threads:
            hashes = [threads.submit(self.digest, file) for _, file in self.found]
        for (source, file), hashed in zip(self.found, hashes, strict=True):
            with self._refusing(file):
                sha256 = hashed.result()
                if sha256 in seen and source.spill is not None:
                    raise SourceError(
                        f"{file.name}: the same bytes as {seen[sha256]}, which was read; remove one of the two."
                    )
                seen[sha256] = file.name
                recognised[source.name].append(replace(file, sha256=sha256))
        return recognised

    @contextmanager
    def _refusing(self, file: RawFile) -> Iterator[None]:
        """Refuse a file that cannot be used and go on with the others."""
        try:
            yield
        except SourceError as damage:
            self.refusals.append(str(damage))
        except OSError as refused:
            self.refusals.append(
                f"{file.name}: cannot be read ({refused.strerror}). Give yourself the right to read it."
            )

    def _skip_or_refuse(self, file: RawFile, refusal: str) -> None:
        """Skip an unrecognised file where its ending promises no data and the user did not name it; else refuse it."""
        named_by_user = file.member is None and file.path == self.source
        if PurePosixPath(file.filename).suffix.lower() in PROSE and not named_by_user:
            self.skipped.append(file.name)
        else:
            self.refusals.append(refusal)


def _list_candidates(source: Path) -> tuple[list[Path], list[str]]:
    """Return the files below a source, and messages about folders and files that cannot be looked at."""
    if not source.exists():
        raise SourceError(
            f"{source}: no such file or folder. Give the folder with the raw files as downloaded, or one file; "
            "`tracklake sample --out sample` generates some to try with."
        )
    if source.is_file():
        return [source], []
    found: list[Path] = []
    refusals: list[str] = []
    visited: set[str] = set()

    def refuse(error: OSError) -> None:
        path = Path(os.fsdecode(error.filename))
        name = path.relative_to(source).as_posix() if path != source else str(source)
        refusals.append(
            f"{name}: cannot be read ({error.strerror}). Give yourself the right to read it, or move it away."
        )

    for folder, below, names in os.walk(source, followlinks=True, onerror=refuse):
        real = os.path.realpath(folder)
        below[:] = [] if real in visited else [name for name in below if not name.startswith(".")]
        if real not in visited:
            found += [Path(folder, name) for name in names if not name.startswith(".")]
        visited.add(real)
    files = []
    for path in sorted(found):
        try:
            if path.is_file():
                files.append(path)
        except OSError as error:
            refuse(error)
    return files, sorted(refusals)


def _open_raw(path: Path, source: Path) -> RawFile:
    """Name a file relative to SOURCE; control characters and bytes that are no UTF-8 are escaped in the name."""
    if source.is_file():
        return RawFile(path, make_visible(path.name), is_source=True)
    return RawFile(path, make_visible(path.relative_to(source).as_posix()))


def _describe_formats(sources: list[Source]) -> str:
    return "; ".join(dict.fromkeys(item.signature for item in sources))


def _explain_unknown(name: str, head: bytes, sources: list[Source], mapping: ColumnMapping | None) -> str:
    if not head.strip():
        return f"{name}: empty file. Expected {_describe_formats(sources)}. Download it again."
    line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    shown = line if len(line) <= 100 else f"{line[:100]}..."
    advice = "Name its columns with --columns (docs/data.md). Move the file out of the folder, or restore its header."
    if mapping is not None:
        advice = f"Nor has it the columns of the mapping: {', '.join(map(str, mapping.columns.values()))}. Correct it."
    return (
        f"{name}, line 1: not a known trajectory file. Expected {_describe_formats(sources)}. Got {shown!r}. {advice}"
    )


def _explain_archive(archive: RawFile, contents: ArchiveContents, sources: list[Source]) -> str:
    held = [*contents.others, *(file.name for file in contents.files)]
    got = ", ".join(name.removeprefix(f"{archive.name}/") for name in held[:5]) + (", ..." if len(held) > 5 else "")
    return (
        f"{archive.name}: an archive with no raw recordings in it. Expected {_describe_formats(sources)}. "
        f"Got {got or 'an empty archive'}. Give the archive as downloaded."
    )


def _explain_nothing(source: Path, candidates: list[Path], sources: list[Source]) -> str:
    got = ", ".join(path.name for path in candidates[:5]) + (", ..." if len(candidates) > 5 else "")
    return (
        f"{source}: no raw recordings in it. Expected {_describe_formats(sources)}. "
        f"Got {got or 'an empty folder'}. Give the folder with the downloads, unpacked or not."
    )


def _is_digest(known: object) -> bool:
    """Return whether a value is the size, the modification time and the hash of a file."""
    return isinstance(known, list) and [type(value) for value in known] == [int, int, str]


_HASHES_OF_PROCESS: dict[str, list[object]] = {}
"""Hashes computed in this process: a lake that does not exist yet cannot keep them, and no file is read twice."""


class Digests:
    """The sha256 of files, remembered by path, size and modification time so that idle reruns read nothing.

    Those of an archive's members are remembered by the archive's size and time, and the member's name.
    """

    def __init__(self, root: Path) -> None:
        self._path = root / HASHES
        self._known: dict[str, list[object]] = {}
        try:
            remembered = read_json(self._path)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            remembered = None  # nothing remembered, or not as it was written: everything is hashed again
        if isinstance(remembered, dict):
            self._known = {path: known for path, known in remembered.items() if _is_digest(known)}
        self._changed = False

    def __call__(self, file: RawFile) -> str:
        """Return the sha256 of a file's bytes."""
        stat = file.path.stat()
        key = "/".join([str(file.path.resolve()), *([] if file.member is None else [file.member])])
        state = [stat.st_size, stat.st_mtime_ns]
        if self._known.get(key, [])[:2] == state:
            return str(self._known[key][2])
        if _HASHES_OF_PROCESS.get(key, [])[:2] != state:
            _HASHES_OF_PROCESS[key] = [*state, hash_raw(file)]
        self._known[key] = _HASHES_OF_PROCESS[key]
        self._changed = True
        return str(self._known[key][2])

    def has_changed(self, path: Path) -> bool:
        """Return whether a file has another size or time of change than when it, or a member of it, was hashed."""
        stat, name = path.stat(), str(path.resolve())
        known = [state for key, state in self._known.items() if key == name or key.startswith(f"{name}/")]
        return bool(known) and all(state[:2] != [stat.st_size, stat.st_mtime_ns] for state in known)

    def save(self) -> None:
        """Store new hashes beside the lake's manifest, where there is a lake."""
        if self._changed and self._path.with_name(MANIFEST).exists():
            write_file(self._path, json.dumps(self._known).encode())
