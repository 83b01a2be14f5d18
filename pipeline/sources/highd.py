"""highD: drone recordings of German motorways, 25 Hz, three CSV files per recording."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import CONFLICT, DUPLICATE, FILE, account, split_duplicates
from tracklake.pipeline.sources.assemble import assemble_subset
from tracklake.pipeline.sources.completeness import Announced, compare
from tracklake.pipeline.sources.csv.lines import Chunk, Layout, read_chunks
from tracklake.pipeline.sources.csv.raw_files import LINE
from tracklake.pipeline.sources.highd_rows import (
    DIRECTION,
    STRANGER,
    add_directions,
    split_conflicts,
    split_impossible,
    split_strangers,
)
from tracklake.pipeline.sources.source import Canonical, Grouping, Part, RawFile, Source, SourceError, Subset, Unit
from tracklake.pipeline.transforms.tracks.orientation import LOWER, UPPER, orient_highd
from tracklake.schemas import Table
from tracklake.schemas.completeness import RECORDING_META, TRACKS_META
from tracklake.schemas.raw_highd import (
    RAW_HIGHD_RECORDING,
    RAW_HIGHD_TRACKS,
    RAW_HIGHD_VEHICLES,
    RAW_RECORDING_FIELDS,
    RAW_TRACKS_FIELDS,
    RAW_VEHICLES_FIELDS,
)

RECORDING, VEHICLES, TRACKS = "highd-recordingMeta", "highd-tracksMeta", "highd-tracks"
FIELDS = {RECORDING: RAW_RECORDING_FIELDS, VEHICLES: RAW_VEHICLES_FIELDS, TRACKS: RAW_TRACKS_FIELDS}
RAW = {RECORDING: RAW_HIGHD_RECORDING, VEHICLES: RAW_HIGHD_VEHICLES, TRACKS: RAW_HIGHD_TRACKS}
FIRST_FRAME = 1
"""Frames count from 1, so time_s = 0 there even where the first vehicle comes later."""

CARRIAGEWAYS = {UPPER: "upper", LOWER: "lower"}

_Set = tuple[tuple[str, str], dict[str, RawFile]]
"""Folder and number; files by dialect."""


def detect(head: bytes, _name: str) -> str | None:
    """Recognise one of the three files by its header."""
    line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    header = tuple(field.strip().strip('"') for field in line.split(","))
    return next((dialect for dialect, fields in FIELDS.items() if header == fields), None)


def group(files: Sequence[RawFile]) -> Grouping:
    """Gather each recording's three files by folder and number (`NN_tracks.csv`); incomplete ones are refused.

    An archive is a folder. What is incomplete there is gathered once more by the folder that the archive lies in, so
    that three archives of one file each are a recording too. Of two files of one kind the one that is named as shipped
    is taken and the other refused.
    """
    together, refusals = gather_sets(files, lambda file: file.folder)
    scattered = [file for _, found in together if len(found) < len(FIELDS) for file in found.values()]
    beside, more_refusals = gather_sets(scattered, lambda file: str(file.path.parent))
    together = [*(each for each in together if len(each[1]) == len(FIELDS)), *beside]
    refusals += more_refusals
    units: list[Unit] = []
    for (_, digits), found in sorted(together, key=lambda each: each[0][::-1]):
        recording = f"{int(digits):02d}"
        missing = [f"{digits}_{_kind(dialect)}.csv" for dialect in FIELDS if dialect not in found]
        there = ", ".join(file.name for file in found.values())
        if missing:
            refusals.append(
                f"recording {recording}: {' and '.join(missing)} missing beside {there}. A highD recording needs its "
                "three files in one folder; put the missing one there and run again."
            )
        elif any(unit.recording == recording for unit in units):
            refusals.append(
                f"recording {recording}: a second set of files ({there}); the first was taken. Remove one of them."
            )
        else:
            units.append(Unit((found[RECORDING], found[VEHICLES], found[TRACKS]), recording))
    return Grouping(tuple(units), tuple(refusals))


def gather_sets(files: Sequence[RawFile], folder_of: Callable[[RawFile], str]) -> tuple[list[_Set], list[str]]:
    """Files by folder and number, then by dialect; and messages about those that have no place."""
    gathered: dict[tuple[str, str], dict[str, RawFile]] = {}
    refusals = []
    for file in sorted(files, key=lambda file: (not _is_named_as_shipped(file), file.name)):
        number = re.match(r"(\d+)_", file.filename)
        if number is None:
            refusals.append(
                f"{file.name}: has the columns of a highD {_kind(file.dialect)} file, but its name does not begin with "
                f"the recording's number. Expected `NN_{_kind(file.dialect)}.csv`, as shipped; rename it."
            )
            continue
        found = gathered.setdefault((folder_of(file), number.group(1)), {})
        if file.dialect in found:
            refusals.append(
                f"{file.name}: a second {_kind(file.dialect)} file of recording {number.group(1)} beside "
                f"{found[file.dialect].name}, which was taken. Expected one; remove one of the two."
            )
            continue
        found[file.dialect] = file
    return list(gathered.items()), refusals


def _is_named_as_shipped(file: RawFile) -> bool:
    return PurePosixPath(file.filename).stem.endswith(_kind(file.dialect))


def _kind(dialect: str) -> str:
    return dialect.removeprefix("highd-")


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn a recording's three files into its tables.

    Args:
        parts: recordingMeta, tracksMeta, tracks, in this order.
        recording: its name, the number in the files' names.
    """
    meta_file, vehicles_file, tracks_file = (part.file for part in parts)
    meta_rows, vehicles, tracks = (_read(part.file) for part in parts)
    meta = _only_row(meta_rows, meta_file)
    _check_number(meta, meta_file, recording)
    if tracks.frame.is_empty():
        raise SourceError(
            f"{tracks_file.name}: no readable row. Expected {','.join(RAW_TRACKS_FIELDS[:4])}, ... in each."
            f"{_first_reject(tracks.rejects)} Restore the original file."
        )
    rejected = [
        Part(part.file, rejects=chunk.rejects) for part, chunk in zip(parts, (meta_rows, vehicles, tracks), strict=True)
    ]
    parsed = [chunk.frame.height for chunk in (meta_rows, vehicles, tracks)]
    entries, again = split_duplicates(tracks.frame.with_columns(pl.lit(2, pl.Int64).alias(FILE)), ["id", "frame"])
    del tracks  # the largest recordings have two million rows: no frame of theirs is kept longer than it is used
    entries, conflicts = split_conflicts(entries)
    known, known_again = _unique_vehicles(vehicles.frame, vehicles_file)
    entries, strangers = split_strangers(entries, known, tracks_file, vehicles_file)
    markings = {
        UPPER: _markings(meta["upperLaneMarkings"], meta_file),
        LOWER: _markings(meta["lowerLaneMarkings"], meta_file),
    }
    entries = add_directions(entries, known)
    entries, impossible = split_impossible(entries, *(len(marked) - 1 for marked in markings.values()))
    dropped = [(known_again, DUPLICATE), (again, DUPLICATE), (conflicts, CONFLICT)]
    dropped += [(strangers, STRANGER), *impossible]
    log, rejects = account("highd", recording, rejected, parsed, dropped)
    files = [part.file for part in parts]
    carriageways = {direction: entries.filter(pl.col(DIRECTION) == direction) for direction in CARRIAGEWAYS}
    del entries
    subsets = [
        _to_subset(carriageways.pop(direction), known, direction, recording, meta, markings, files)
        for direction in CARRIAGEWAYS
    ]
    found = tuple(subset for subset in subsets if subset is not None)
    whole = compare("highd", recording, found, _announced(meta, known), log.filter(pl.col("dialect") == TRACKS))
    return Canonical(found, log, rejects, whole.table, whole.notes)


def read_metadata(files: Mapping[str, RawFile], recording: str) -> tuple[dict[str, Any], dict[int, int], pl.DataFrame]:
    """Read what recordingMeta and tracksMeta say.

    Args:
        files: by dialect; the tracks are not read.
        recording: its name, the number in the files' names.

    Returns:
        The row of recordingMeta; lanes by driving direction; the rows of tracksMeta, one per vehicle.

    Raises:
        SourceError: a file cannot be read, or is of another recording.
    """
    meta = _only_row(_read(files[RECORDING]), files[RECORDING])
    _check_number(meta, files[RECORDING], recording)
    columns = {UPPER: "upperLaneMarkings", LOWER: "lowerLaneMarkings"}
    lanes = {side: len(_markings(meta[column], files[RECORDING])) - 1 for side, column in columns.items()}
    vehicles, _ = _unique_vehicles(_read(files[VEHICLES]).frame, files[VEHICLES])
    return meta, lanes, vehicles


def _check_number(meta: dict[str, Any], file: RawFile, recording: str) -> None:
    if f"{meta['id']:02d}" != recording:
        raise SourceError(
            f"{file.name}, line 2: expected id {int(recording)}, as the file's name says, got {meta['id']}. "
            "Two recordings' files are mixed; restore the originals."
        )


def _read(file: RawFile) -> Chunk:
    raw = RAW[file.dialect]
    layout = _layout(file.dialect, raw)
    chunks = list(read_chunks(file, layout))
    if not chunks:
        raise SourceError(
            f"{file.name}: empty. Expected the header {','.join(layout.names[:4])}, ... and rows under it."
        )
    frame = pl.concat([chunk.frame for chunk in chunks]).select(*raw.dtypes)
    rejects = pl.concat([chunk.rejects for chunk in chunks])
    return Chunk(raw.validate(frame, where=file.name), rejects, sum(chunk.rows_read for chunk in chunks))


def _layout(dialect: str, raw: Table) -> Layout:
    wanted = [name for name in raw.dtypes if name != LINE]
    return Layout(
        names=FIELDS[dialect],
        dtypes={name: raw.dtypes[name] for name in wanted},
        required=raw.required & set(wanted),
        bounds={name: limits for name, limits in raw.bounds.items() if name != LINE},
        choices={"class": ("car", "truck")} if dialect == VEHICLES else {},
    )


def _only_row(meta: Chunk, file: RawFile) -> dict[str, Any]:
    if meta.frame.height != 1:
        why = _first_reject(meta.rejects)
        raise SourceError(
            f"{file.name}: expected one readable row under the header, got {meta.frame.height}.{why} "
            "Restore the original file."
        )
    return meta.frame.row(0, named=True)


def _first_reject(rejects: pl.DataFrame) -> str:
    return "".join(f" Line {line} cannot be read: {reason}." for line, reason, _ in rejects.head(1).rows())


def _unique_vehicles(vehicles: pl.DataFrame, file: RawFile) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Vehicles with one row each, and exact repetitions of those rows."""
    unique, again = split_duplicates(vehicles.with_columns(pl.lit(1, pl.Int64).alias(FILE)), ["id"])
    twice = unique.filter(~pl.col("id").is_first_distinct())
    if not twice.is_empty():
        first = twice.row(0, named=True)
        raise SourceError(
            f"{file.name}, line {first[LINE]}: a second, different row of vehicle {first['id']}. Expected one row per "
            "vehicle; restore the original file."
        )
    return unique, again


def _markings(text: str, file: RawFile) -> list[float]:
    try:
        values = [float(value) for value in text.split(";")]
    except ValueError:
        values = []
    increasing = all(low < high for low, high in pairwise(values))
    if len(values) < 2 or not increasing or not all(math.isfinite(value) for value in values):
        raise SourceError(
            f"{file.name}, line 2: expected lane markings as increasing numbers separated by `;`, got {text!r}."
        )
    return values


def _to_subset(
    entries: pl.DataFrame,
    vehicles: pl.DataFrame,
    direction: int,
    recording: str,
    meta: dict[str, Any],
    markings_m: dict[int, list[float]],
    files: Sequence[RawFile],
) -> Subset | None:
    if entries.is_empty():
        return None
    mine = vehicles.filter(pl.col(DIRECTION) == direction)
    upper_m, lower_m = markings_m[UPPER], markings_m[LOWER]
    markings = [upper_m[-1] - y for y in reversed(upper_m)] if direction == UPPER else [y - lower_m[0] for y in lower_m]
    leader = pl.when(pl.col("precedingId") != 0)
    entries = orient_highd(entries, direction, upper_m, lower_m).select(
        "frame",
        "x_m",
        "y_m",
        "lane",
        "speed_mps",
        "accel_mps2",
        "lateral_speed_mps",
        vehicle_id="id",
        leader_id=leader.then(pl.col("precedingId")),
        follower_id=pl.when(pl.col("followingId") != 0).then(pl.col("followingId")),
        headway_recorded_m=leader.then(pl.col("dhw")),
    )
    sizes = mine.select(
        pl.col("class").str.to_lowercase(),
        vehicle_id="id",
        source_vehicle_id="id",
        length_m="width",
        width_m="height",
        entries_announced="numFrames",
    )
    return assemble_subset(
        entries,
        sizes,
        dataset="highd",
        name=f"{recording}-{CARRIAGEWAYS[direction]}",
        facts={
            "recording": recording,
            "site": f"location-{meta['locationId']}",
            "direction": CARRIAGEWAYS[direction],
            "freeway": True,
            "frame_rate_hz": meta["frameRate"],
            "lanes": len(markings) - 1,
            "seconds": meta["duration"],
            "first_frame": FIRST_FRAME,
            "on_ramp_lanes": [],
            "lane_markings_m": markings,
            "ids_split": 0,
            "columns_missing": [],
        },
        use_recorded_headway=False,
        files=files,
    )


def _announced(meta: dict[str, Any], vehicles: pl.DataFrame) -> Announced:
    """What recordingMeta and tracksMeta say that the tracks hold."""
    return Announced(
        totals={"vehicles": meta["numVehicles"], "cars": meta["numCars"], "trucks": meta["numTrucks"]},
        totals_by=RECORDING_META,
        vehicles=vehicles.select(
            source_vehicle_id="id", entries_announced="numFrames", first_frame="initialFrame", last_frame="finalFrame"
        ),
        vehicles_by=TRACKS_META,
    )


HIGHD = Source(
    name="highd",
    title="highD: naturalistic vehicle trajectories on German highways",
    licence="non-commercial, on request from levelXdata (highd-dataset.com)",
    citation="Krajewski, R., Bock, J., Kloeker, L., Eckstein, L. (2018). The highD Dataset. IEEE ITSC. "
    "doi.org/10.1109/ITSC.2018.8569552",
    looks_like="highD: NN_recordingMeta.csv, NN_tracksMeta.csv and NN_tracks.csv with the headers as shipped",
    version=1,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
)
