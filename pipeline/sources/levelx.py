"""Reader of levelXdata's format: three CSV files per recording (recordingMeta, tracksMeta, tracks).

highD, inD, rounD and exiD share it. A dataset states its columns in a `LevelxFormat`; what its rows mean is its own.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import CONFLICT, DUPLICATE, FILE, split_duplicates
from tracklake.pipeline.sources.csv import BOM, LINE, Chunk, Layout, read_chunks, read_head
from tracklake.pipeline.sources.source import ColumnsOfFile, Grouping, Part, RawFile, SourceError, Unit
from tracklake.schemas import Table
from tracklake.schemas.columns import Dataset

RECORDING, VEHICLES, TRACKS = "recordingMeta", "tracksMeta", "tracks"
KINDS = (RECORDING, VEHICLES, TRACKS)
"""The three files of a recording, in the order in which they are read."""
UNKNOWN_VEHICLE = "vehicle without a row in tracksMeta"

MAX_UNKNOWN_SHARE = 0.01
"""Highest share of rows of unknown vehicles (damaged ids); above it the files do not belong together."""
FileSet = tuple[tuple[str, str], dict[str, RawFile]]
"""(folder, number in the files' names) and the files by kind."""


@dataclass(frozen=True)
class LevelxRecording:
    """The metadata of one recording and the accounting of its rows.

    The row of recordingMeta; rows of tracksMeta, one per vehicle; the three files with the lines that could not be
    parsed; the number of parsed rows of each; sets of parsed rows that were dropped, each with its reason.
    """

    meta: dict[str, Any]
    vehicles: pl.DataFrame
    parts: tuple[Part, ...]
    rows_parsed: tuple[int, ...]
    dropped: tuple[tuple[pl.DataFrame, str], ...]


@dataclass(frozen=True)
class LevelxFormat:
    """The three files of one dataset.

    Args:
        choices: allowed values of text columns, in lower case, by kind.
        recording_id: recordingMeta's column of the recording's number.
        vehicle_id: the column of the vehicle's id in tracksMeta and tracks.
        any_header: whether columns may stand in any order and case, among others; nullable ones may be missing.
    """

    dataset: Dataset
    title: str
    fields: Mapping[str, tuple[str, ...]]
    raw: Mapping[str, Table]
    choices: Mapping[str, Mapping[str, tuple[str, ...]]] = field(default_factory=dict)
    recording_id: str = "id"
    vehicle_id: str = "id"
    any_header: bool = False

    def name_dialect(self, kind: str) -> str:
        """Return the dialect of a kind of file."""
        return f"{self.dataset}-{kind}"

    def find_kind(self, file: RawFile) -> str:
        """Return which of the three files one is."""
        return file.dialect.rpartition("-")[2]

    def detect(self, head: bytes, _name: str) -> str | None:
        """Recognise one of the three files by its header."""
        header = read_header(head)
        return next((self.name_dialect(kind) for kind, fields in self.fields.items() if header == fields), None)

    def group(self, files: Sequence[RawFile]) -> Grouping:
        """Gather each recording's three files by folder and number (`NN_tracks.csv`); incomplete ones are refused.

        An archive is a folder. Files of incomplete sets are gathered again by the folder that holds their archive, so
        three archives of one file each are a recording too. Of two files of one kind, the one named as shipped is
        used and the other refused.
        """
        sets, refusals = self.gather_recordings(files)
        grouping = self.group_recordings(sets)
        return Grouping(grouping.units, (*refusals, *grouping.refusals))

    def gather_recordings(self, files: Sequence[RawFile]) -> tuple[list[FileSet], list[str]]:
        """Gather the files of recordings; also return messages about files that fit nowhere."""
        sets, refusals = self._gather_sets(files, lambda file: file.folder)
        scattered = [file for _, found in sets if len(found) < len(KINDS) for file in found.values()]
        beside, more_refusals = self._gather_sets(scattered, lambda file: str(file.path.parent))
        return [*(each for each in sets if len(each[1]) == len(KINDS)), *beside], [*refusals, *more_refusals]

    def group_recordings(self, sets: Sequence[FileSet]) -> Grouping:
        """Make a unit of each recording's files; incomplete sets and second ones are refused."""
        return self._group_sets(sets, KINDS, f"A {self.title} recording needs its three files in one folder")

    def group_metadata(self, files: Sequence[RawFile]) -> Grouping:
        """Gather each recording's recordingMeta and tracksMeta, to plan with; other files are left out."""
        wanted = [file for file in files if self.find_kind(file) in KINDS[:2]]
        sets, refusals = self._gather_sets(wanted, lambda file: file.folder)
        grouping = self._group_sets(sets, KINDS[:2], "A plan needs both files in one folder")
        return Grouping(grouping.units, (*refusals, *grouping.refusals))

    def _group_sets(self, sets: Sequence[FileSet], kinds: Sequence[str], need: str) -> Grouping:
        """Make a unit of each recording's set of files; incomplete and second ones are refused."""
        units: dict[str, Unit] = {}
        refusals = []
        for (_, digits), found in sorted(sets, key=lambda each: each[0][::-1]):
            recording = f"{int(digits):02d}"
            missing = [f"{digits}_{kind}.csv" for kind in kinds if kind not in found]
            present = ", ".join(file.name for file in found.values())
            if missing:
                refusals.append(
                    f"recording {recording}: {' and '.join(missing)} missing beside {present}. {need}; put the missing "
                    "one there and run again."
                )
            elif recording in units:
                refusals.append(
                    f"recording {recording}: a second set of files ({present}); the first was used. Remove one of them."
                )
            else:
                units[recording] = Unit(tuple(found[kind] for kind in kinds), recording)
        return Grouping(tuple(units.values()), tuple(refusals))

    def _gather_sets(
        self, files: Sequence[RawFile], folder_of: Callable[[RawFile], str]
    ) -> tuple[list[FileSet], list[str]]:
        """Gather files by folder and number, then by kind; also return messages about files that fit nowhere."""
        gathered: dict[tuple[str, str], dict[str, RawFile]] = {}
        refusals = []

        def sort_key(file: RawFile) -> tuple[bool, str]:
            as_shipped = PurePosixPath(file.filename).stem.endswith(self.find_kind(file))
            return not as_shipped, file.name

        for file in sorted(files, key=sort_key):
            kind = self.find_kind(file)
            number = re.match(r"(\d+)_", file.filename)
            if number is None:
                refusals.append(
                    f"{file.name}: has the columns of a {self.title} {kind} file, but its name does not begin with the "
                    f"recording's number. Expected `NN_{kind}.csv`, as shipped; rename it."
                )
                continue
            found = gathered.setdefault((folder_of(file), number.group(1)), {})
            if kind in found:
                refusals.append(
                    f"{file.name}: a second {kind} file of recording {number.group(1)} beside {found[kind].name}, "
                    "which was used. Expected one; remove one of the two."
                )
                continue
            found[kind] = file
        return list(gathered.items()), refusals

    def read_recording(self, parts: Sequence[Part], recording: str) -> tuple[LevelxRecording, pl.DataFrame]:
        """Read a recording's three files, in the order of KINDS, and drop the rows of tracks that cannot be true.

        Returns the recording, and the rows of tracks with FILE and LINE, sorted by vehicle and frame.

        Raises:
            SourceError: a file cannot be read or belongs to another recording.
        """
        meta_file, vehicles_file, tracks_file = (part.file for part in parts)
        meta_rows, vehicles, tracks = (self._read(part.file) for part in parts)
        meta = self._check_meta(meta_rows, meta_file, recording)
        if tracks.frame.is_empty():
            raise SourceError(
                f"{tracks_file.name}: no readable row. Expected {','.join(self.fields[TRACKS][:4])}, ... in each."
                f"{_describe_first_reject(tracks.rejects)} Restore the original file."
            )
        chunks = (meta_rows, vehicles, tracks)
        rejected = tuple(Part(part.file, rejects=chunk.rejects) for part, chunk in zip(parts, chunks, strict=True))
        rows_parsed = tuple(chunk.frame.height for chunk in chunks)
        key = [self.vehicle_id, "frame"]
        entries, again = split_duplicates(tracks.frame.with_columns(pl.lit(2, pl.Int64).alias(FILE)), key)
        del chunks, tracks  # the largest recordings have two million rows: no frame is kept longer than it is used
        entries, conflicts = split_conflicts(entries, key)
        known, known_again = self._split_vehicles(vehicles.frame, vehicles_file)
        entries, unknown = self._split_unknown(entries, known, tracks_file, vehicles_file)
        dropped = ((known_again, DUPLICATE), (again, DUPLICATE), (conflicts, CONFLICT), (unknown, UNKNOWN_VEHICLE))
        return LevelxRecording(meta, known, rejected, rows_parsed, dropped), entries

    def read_metadata(self, files: Sequence[RawFile], recording: str) -> tuple[dict[str, Any], pl.DataFrame]:
        """Read the row of recordingMeta, and the rows of tracksMeta, one per vehicle: a recording's first two files."""
        meta = self._check_meta(self._read(files[0]), files[0], recording)
        vehicles, _ = self._split_vehicles(self._read(files[1]).frame, files[1])
        return meta, vehicles

    def build_layout(self, kind: str, names: tuple[str, ...] | None = None) -> Layout:
        """Build the layout of a kind of file from its raw schema, and from its header where that may be another."""
        raw, names = self.raw[kind], names or self.fields[kind]
        wanted = [name for name in raw.dtypes if name in names]
        return Layout(
            names=names,
            dtypes={name: raw.dtypes[name] for name in wanted},
            required=raw.required & set(wanted),
            bounds={name: limits for name, limits in raw.bounds.items() if name in wanted},
            choices=self.choices.get(kind, {}),
        )

    def describe_columns(self, file: RawFile) -> ColumnsOfFile:
        """Return the columns of a file."""
        kind = self.find_kind(file)
        names = match_names(read_header(read_head(file)), self.raw[kind]) if self.any_header else None
        return ColumnsOfFile(self.build_layout(kind, names), self.raw[kind])

    def _read(self, file: RawFile) -> Chunk:
        columns = self.describe_columns(file)
        layout, raw = columns.layout, columns.raw
        chunks = list(read_chunks(file, layout))
        if not chunks:
            raise SourceError(
                f"{file.name}: empty. Expected the header {','.join(layout.names[:4])}, ... and rows under it."
            )
        frame = pl.concat([chunk.frame for chunk in chunks])
        absent = [pl.lit(None, dtype).alias(name) for name, dtype in raw.dtypes.items() if name not in frame.columns]
        frame = frame.with_columns(absent).select(*raw.dtypes)
        rejects = pl.concat([chunk.rejects for chunk in chunks])
        return Chunk(raw.validate(frame, where=file.name), rejects, sum(chunk.rows_read for chunk in chunks))

    def _check_meta(self, meta: Chunk, file: RawFile, recording: str) -> dict[str, Any]:
        """Return recordingMeta's only row, whose number is the file name's."""
        if meta.frame.height != 1:
            raise SourceError(
                f"{file.name}: expected one readable row under the header, got {meta.frame.height}."
                f"{_describe_first_reject(meta.rejects)} Restore the original file."
            )
        row = meta.frame.row(0, named=True)
        number = row[self.recording_id]
        if f"{number:02d}" != recording:
            raise SourceError(
                f"{file.name}, line 2: expected id {int(recording)}, as the file's name says, got {number}. "
                "Two recordings' files are mixed; restore the originals."
            )
        return row

    def _split_vehicles(self, vehicles: pl.DataFrame, file: RawFile) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Split one row per vehicle from exact repetitions of these rows."""
        unique, again = split_duplicates(vehicles.with_columns(pl.lit(1, pl.Int64).alias(FILE)), [self.vehicle_id])
        twice = unique.filter(~pl.col(self.vehicle_id).is_first_distinct())
        if not twice.is_empty():
            first = twice.row(0, named=True)
            raise SourceError(
                f"{file.name}, line {first[LINE]}: a second, different row of vehicle {first[self.vehicle_id]}. "
                "Expected one row per vehicle; restore the original file."
            )
        return unique, again

    def _split_unknown(
        self, entries: pl.DataFrame, vehicles: pl.DataFrame, tracks_file: RawFile, vehicles_file: RawFile
    ) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Split rows of vehicles in tracksMeta from rows of other vehicles, which may only be few."""
        unknown = entries.join(vehicles, on=self.vehicle_id, how="anti")
        if unknown.is_empty():
            return entries, unknown
        if unknown.height > MAX_UNKNOWN_SHARE * entries.height:
            first = unknown.row(0, named=True)
            raise SourceError(
                f"{tracks_file.name}, line {first[LINE]}: vehicle {first[self.vehicle_id]} has no row in "
                f"{vehicles_file.name} ({unknown[self.vehicle_id].n_unique()} such vehicles). The files do not belong "
                "together or one is cut short; restore the originals."
            )
        return entries.join(vehicles, on=self.vehicle_id, how="semi", maintain_order="left"), unknown


def read_header(head: bytes) -> tuple[str, ...]:
    """Read the names of a CSV file's columns from its first bytes."""
    line = head.removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    return tuple(name.strip().strip('"') for name in line.split(","))


def match_names(header: Sequence[str], raw: Table) -> tuple[str, ...] | None:
    """Write a header's names as a raw schema spells them; None where one that may not be null is missing or twice."""
    spelled = {name.lower(): name for name in raw.dtypes if name != LINE}
    names = tuple(spelled.get(name.lower(), name) for name in header)
    missing = raw.required - set(names) - {LINE}
    return None if missing or len(set(names)) < len(names) else names


def split_conflicts(entries: pl.DataFrame, key: Sequence[str]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split the first row (by LINE) of each vehicle and frame, the sorted key, from later ones, which contradict it."""
    conflicting = entries.select(
        pl.all_horizontal(pl.col(name) == pl.col(name).shift(1) for name in key).fill_null(value=False)
    ).to_series()
    if not conflicting.any():
        return entries, entries.clear()
    entries = entries.sort(*key, LINE)
    return entries.filter(~conflicting), entries.filter(conflicting)


def _describe_first_reject(rejects: pl.DataFrame) -> str:
    return "".join(f" Line {line} cannot be read: {reason}." for line, reason, _ in rejects.head(1).rows())
