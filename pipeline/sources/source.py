"""What a dataset's source is: data and a few functions, listed in an explicit registry."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import polars as pl

from tracklake.schemas.columns import Dataset
from tracklake.schemas.errors import TracklakeError


class SourceError(TracklakeError):
    """Raw input that cannot be used; the message says where, what was expected, what was found and what to do."""


@dataclass(frozen=True)
class RawFile:
    """A raw file: one in a folder, or a member of a zip archive.

    Args:
        path: where it is, or the archive that holds it.
        name: as tables and messages call it: relative to the folder given; a member's begins with its archive's.
        dialect: how its source reads it; empty until it is recognised.
        sha256: of its bytes (a member's own, whatever the archive's are); empty until it is recognised.
        member: of the archive, as the archive calls it; None where the file stands by itself.
    """

    path: Path
    name: str
    dialect: str = ""
    sha256: str = ""
    member: str | None = None

    @property
    def folder(self) -> str:
        """The folder it lies in; an archive is a folder with folders in it."""
        return str(self._place.parent)

    @property
    def filename(self) -> str:
        """Its name in its folder."""
        return self._place.name

    @property
    def _place(self) -> PurePosixPath:
        # Some programs write the folders of an archive with backslashes.
        inside = "" if self.member is None else self.member.replace("\\", "/")
        return PurePosixPath(self.path.as_posix(), inside.lstrip("/"))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for a job's inputs or a task's arguments."""
        return {**asdict(self), "path": str(self.path)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RawFile":
        """The file that `to_dict` described."""
        return cls(**{**values, "path": Path(values["path"])})


@dataclass(frozen=True)
class Spilled:
    """What reading one file that holds several recordings left in the staging folder.

    Args:
        recordings: rows by recording; each stands in `<folder>/<recording>/*.arrow`.
        rows_read: data lines of the file.
        rejects: `line`, `reason`, `text` of those that belong to no recording.
    """

    recordings: Mapping[str, int]
    rows_read: int
    rejects: pl.DataFrame


@dataclass(frozen=True)
class Part:
    """One file's share of a recording.

    Args:
        file: the raw file.
        rows: spilled rows, lazily; None where the source reads the raw file itself.
        rejects: `line`, `reason`, `text` of rejected lines that can only belong to this recording.
    """

    file: RawFile
    rows: pl.LazyFrame | None = None
    rejects: pl.DataFrame | None = None


@dataclass(frozen=True)
class Subset:
    """One subset in canonical form.

    Args:
        name: of the subset.
        tracks: frame of schemas.TRACKS, unconformed (dataset and subset come from here).
        vehicles: frame of schemas.VEHICLES.
        facts: the row of schemas.SUBSETS, less what follows from the tables themselves.
    """

    name: str
    tracks: pl.DataFrame
    vehicles: pl.DataFrame
    facts: pl.DataFrame


@dataclass(frozen=True)
class Canonical:
    """One recording in canonical form, with every row of its files accounted for.

    Args:
        subsets: the carriageways that have entries.
        log: one row per file of schemas.INGEST_LOG.
        rejects: schemas.REJECTS.
        completeness: schemas.COMPLETENESS.
        notes: what the reader of the run's output should know.
    """

    subsets: tuple[Subset, ...]
    log: pl.DataFrame
    rejects: pl.DataFrame
    completeness: pl.DataFrame
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Unit:
    """Raw files to be read together: a highD recording's three, or one NGSIM file.

    Args:
        files: in the order their source wants them.
        recording: where the source knows it without reading, else None.
    """

    files: tuple[RawFile, ...]
    recording: str | None = None


@dataclass(frozen=True)
class Grouping:
    """Recognised files, grouped; and those that cannot be used, each with its message."""

    units: tuple[Unit, ...]
    refusals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """A dataset: what it is, how its files are recognised, read and made canonical.

    Args:
        name: of the dataset.
        title: for people.
        licence: of the data.
        citation: to give when using it.
        looks_like: what its files look like, for messages about unknown files.
        version: counts changes of what the functions below make of the same bytes.
        detect: (first bytes, file name) to a dialect, or None.
        group: recognised files to units.
        to_canonical: the parts of one recording, and its name, to tables.
        spill: for files that hold several recordings: read one into a staging folder, a folder per recording.
    """

    name: Dataset
    title: str
    licence: str
    citation: str
    looks_like: str
    version: int
    detect: Callable[[bytes, str], str | None]
    group: Callable[[Sequence[RawFile]], Grouping]
    to_canonical: Callable[[Sequence[Part], str], Canonical]
    spill: Callable[[RawFile, Path], Spilled] | None = None
