"""A dataset's source: data and a few functions, listed in an explicit registry."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import polars as pl

from tracklake.pipeline.sources.layout import Layout
from tracklake.schemas.columns import Dataset, Table
from tracklake.schemas.errors import TracklakeError

RowOrder = Literal["vehicle", "frame", "other"]


class SourceError(TracklakeError):
    """Raw input that cannot be used; the message says where, what was expected, what was found and what to do."""


@dataclass(frozen=True)
class RawFile:
    """A raw file: one in a folder, or a member of a zip archive.

    Args:
        path: path of the file, or of the archive that holds it.
        name: name in tables and messages, relative to SOURCE; a member's name begins with its archive's.
        dialect: format of its lines; empty until recognised.
        sha256: hash of its bytes (a member's own, unpacked); empty until recognised.
        member: name of the member in its archive; None for a file of its own.
        columns: the user's description of its columns, as JSON; empty without one.
        recording: the user's name for the recording of a file that does not tell it; empty without one.
        is_source: whether the user named this file, and no folder that holds it.
    """

    path: Path
    name: str
    dialect: str = ""
    sha256: str = ""
    member: str | None = None
    columns: str = ""
    recording: str = ""
    is_source: bool = False

    @property
    def folder(self) -> str:
        """Path of its folder; an archive is a folder with folders in it."""
        return str(self._full_path.parent)

    @property
    def filename(self) -> str:
        """Name within its folder, without the path."""
        return self._full_path.name

    @property
    def _full_path(self) -> PurePosixPath:
        # Some programs write the folders of an archive with backslashes.
        inside = "" if self.member is None else self.member.replace("\\", "/")
        return PurePosixPath(self.path.as_posix(), inside.lstrip("/"))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for a job's inputs or a task's arguments."""
        return {**asdict(self), "path": str(self.path)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RawFile":
        """Rebuild the file that `to_dict` described."""
        return cls(**{**values, "path": Path(values["path"])})


@dataclass(frozen=True)
class Spilled:
    """The rows of one file that holds several recordings, left in the staging folder.

    `recordings` counts rows by recording, which are in `<folder>/<recording>/*.arrow`; `rows_read` counts data lines;
    `rejects` are `line`, `reason`, `text` of lines that belong to no recording; `notes` are for the user; `totals` are
    counts of the whole file that each of its recordings needs, in columns of the source's own.
    """

    recordings: Mapping[str, int]
    rows_read: int
    rejects: pl.DataFrame
    notes: tuple[str, ...] = ()
    totals: pl.DataFrame | None = None


@dataclass(frozen=True)
class Part:
    """One file's share of a recording.

    `rows` are spilled rows, None if the source reads the raw file itself; `rejects` are `line`, `reason`, `text` of
    rejected lines that can only belong to this recording; `totals` are those of `Spilled`; `folder` is that of the
    spilled rows, and `slice_entries` the number of entries that may be held at once where a source can do with that.
    """

    file: RawFile
    rows: pl.LazyFrame | None = None
    rejects: pl.DataFrame | None = None
    totals: pl.DataFrame | None = None
    folder: Path | None = None
    slice_entries: int = 2_000_000


@dataclass(frozen=True)
class Subset:
    """One subset in canonical form: rows of schemas.TRACKS, of schemas.VEHICLES, and its row of schemas.SUBSETS."""

    name: str
    tracks: pl.DataFrame
    vehicles: pl.DataFrame
    facts: pl.DataFrame


@dataclass(frozen=True)
class DividedSubset:
    """One long subset in canonical form, slice by slice: its vehicles and facts are known after the last slice.

    Args:
        slices: name of each slice and its rows of schemas.TRACKS, in order of time; to be used once.
        conclude: function that returns the rows of schemas.VEHICLES and the row of schemas.SUBSETS.
    """

    name: str
    slices: Iterator[tuple[str, pl.DataFrame]]
    conclude: Callable[[], tuple[pl.DataFrame, pl.DataFrame]]

    @cached_property
    def vehicles(self) -> pl.DataFrame:
        """All rows of schemas.VEHICLES."""
        return self._concluded[0]

    @cached_property
    def facts(self) -> pl.DataFrame:
        """The row of schemas.SUBSETS."""
        return self._concluded[1]

    @cached_property
    def _concluded(self) -> tuple[pl.DataFrame, pl.DataFrame]:
        return self.conclude()


@dataclass(frozen=True)
class Drive:
    """One drive of an instrumented vehicle in canonical form: its name, and its rows by table.

    Rows that do not fit into the memory are batches in the order of their key; what there is to say about them is known
    after the last one.
    """

    name: str
    tables: Mapping[Table, pl.DataFrame | Iterable[pl.DataFrame]]
    describe_batches: Callable[[], tuple[str, ...]] = tuple


@dataclass(frozen=True)
class Canonical:
    """One recording in canonical form, with every row of its files accounted for.

    Its carriageways with entries, the rows of schemas.INGEST_LOG (one per file), REJECTS and COMPLETENESS, messages for
    the user, and what the rows of its files are sorted by: vehicle and frame, frame and vehicle, or neither. Recordings
    of an instrumented vehicle have drives instead of carriageways.
    """

    subsets: tuple[Subset | DividedSubset, ...]
    log: pl.DataFrame
    rejects: pl.DataFrame
    completeness: pl.DataFrame
    notes: tuple[str, ...] = ()
    row_order: RowOrder = "vehicle"
    drives: tuple[Drive, ...] = ()


@dataclass(frozen=True)
class Unit:
    """Raw files to be read together, in the order of their source: a highD recording's three, or one NGSIM file.

    `recording` is None if only the rows tell it; `dataset` is that of the files where several datasets share formats,
    and else that of the source that grouped them.
    """

    files: tuple[RawFile, ...]
    recording: str | None = None
    dataset: Dataset | None = None


@dataclass(frozen=True)
class ColumnsOfFile:
    """Layout of a text file's lines, the raw table that they fill, and units by column that are not the table's."""

    layout: Layout
    raw: Table
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Grouping:
    """Recognised files in groups, and messages about files that cannot be used."""

    units: tuple[Unit, ...]
    refusals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """A dataset: its description, and the functions that recognise, read and convert its files.

    Args:
        signature: description of its files, for messages about unknown files.
        version: number that changes with what the functions below make of the same bytes.
        detect: function of the first bytes and the file name; returns a dialect or None.
        group: function that gathers recognised files into units.
        to_canonical: function of the parts of one recording and its name; returns its tables.
        spill: function that reads a file of several recordings into a staging folder, a folder per recording.
        lacking: words for a recording of which no row can be used.
        beside: dialects of files that hold no recordings and describe those of the first file of their unit.
        describe_columns: function of a recognised file; returns its columns, None for a file without lines of columns.
    """

    name: Dataset
    title: str
    licence: str
    citation: str
    signature: str
    version: int
    detect: Callable[[bytes, str], str | None]
    group: Callable[[Sequence[RawFile]], Grouping]
    to_canonical: Callable[[Sequence[Part], str], Canonical]
    spill: Callable[[RawFile, Path], Spilled] | None = None
    lacking: str = "no carriageway has entries"
    beside: tuple[str, ...] = ()
    describe_columns: Callable[[RawFile], ColumnsOfFile | None] | None = None
