"""Recognition of exiD, inD and rounD: their metadata files are alike, so that a whole recording tells the dataset."""

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

from tracklake.pipeline.sources.csv import read_head
from tracklake.pipeline.sources.lanelet_map import is_lanelet_map
from tracklake.pipeline.sources.levelx import RECORDING, TRACKS, VEHICLES, FileSet, match_names, read_header
from tracklake.pipeline.sources.levelx_plane import EXID_FORMAT, URBAN_FORMAT
from tracklake.pipeline.sources.source import ColumnsOfFile, Grouping, RawFile, Unit
from tracklake.schemas.columns import Dataset

EXID_TRACKS, URBAN_TRACKS, LANELETS = "exid-tracks", "levelx-tracks", "lanelet2"
"""Dialects of tracks with lanes, tracks without, and maps."""
SIGNATURE = "exiD, inD, rounD: NN_recordingMeta.csv, NN_tracksMeta.csv and NN_tracks.csv with their columns"
"""Description of the files, for messages about unknown files."""
DIALECTS = {
    EXID_TRACKS: EXID_FORMAT.raw[TRACKS],
    URBAN_TRACKS: URBAN_FORMAT.raw[TRACKS],
    f"levelx-{VEHICLES}": EXID_FORMAT.raw[VEHICLES],
    f"levelx-{RECORDING}": EXID_FORMAT.raw[RECORDING],
}
"""Raw schemas by dialect; the first one whose columns a header has is that of its file."""
OWN_COLUMNS = {EXID_TRACKS: {"laneletId", "leadId"}, f"levelx-{VEHICLES}": {"class", "numFrames"}}
"""Further columns that tell a dialect from others."""
IND_CLASSES = frozenset({"truck_bus"})
"""Classes that only inD has."""
ROUND_CLASSES = frozenset({"truck", "van", "trailer", "bus", "motorcycle"})
"""Classes that rounD has, and inD has not."""


def detect(head: bytes, _name: str) -> str | None:
    """Recognise a table by the names of its columns, or a Lanelet2 map."""
    if is_lanelet_map(head):
        return LANELETS
    header = read_header(head)
    for dialect, raw in DIALECTS.items():
        names = match_names(header, raw)
        if names is not None and OWN_COLUMNS.get(dialect, set()) <= set(names):
            return dialect
    return None


def describe_columns(file: RawFile) -> ColumnsOfFile | None:
    """Return the columns of a table; None for a map."""
    if file.dialect == LANELETS:
        return None
    return (URBAN_FORMAT if file.dialect == URBAN_TRACKS else EXID_FORMAT).describe_columns(file)


def group(files: Sequence[RawFile], only: Dataset | None = None) -> Grouping:
    """Gather recordings, each with the map of its location where there is one, and tell the dataset of each.

    Args:
        files: tables and maps.
        only: dataset of recordings without lanes, where the user names it.
    """
    sets, refusals = EXID_FORMAT.gather_recordings([file for file in files if file.dialect != LANELETS])
    maps = _sort_maps(file for file in files if file.dialect == LANELETS)
    by_dataset: dict[Dataset, list[FileSet]] = {}
    for place, found in sets:
        dataset: Dataset | None = "exid"
        if TRACKS in found and found[TRACKS].dialect == URBAN_TRACKS:
            dataset = only if only in ("ind", "round") else _tell_urban(found.get(VEHICLES))
        if dataset is None:
            refusals.append(
                f"{found[VEHICLES].name}: has the columns of inD and rounD, and no class that only one of them has. "
                "Expected a truck_bus (inD), or a truck, van, bus, trailer or motorcycle (rounD). Say which it is: "
                "--dataset ind, or --dataset round."
            )
            continue
        by_dataset.setdefault(dataset, []).append((place, found))
    units: list[Unit] = []
    for dataset, own in sorted(by_dataset.items()):
        grouping = EXID_FORMAT.group_recordings(own)
        refusals += grouping.refusals
        for unit in grouping.units:
            own_map = _find_map(unit.files[0], maps) if dataset == "exid" else []
            units.append(replace(unit, files=(*unit.files, *own_map), dataset=dataset))
    return Grouping(tuple(units), tuple(refusals))


def _tell_urban(vehicles: RawFile | None) -> Dataset | None:
    """Tell inD from rounD by the classes of road users at the beginning of tracksMeta."""
    rows = _read_rows(vehicles) if vehicles is not None else []
    found = {row.get("class", "").strip().lower() for row in rows}
    if found & IND_CLASSES:
        return "ind"
    return "round" if found & ROUND_CLASSES else None


def _find_location(recording_meta: RawFile) -> str:
    """Return the number of a recording's site, empty where it cannot be read."""
    rows = _read_rows(recording_meta)
    return next((row.get("locationid", "").strip() for row in rows), "")


def _read_rows(file: RawFile) -> list[dict[str, str]]:
    """Read the rows at the beginning of a file, by column in lower case; the last of them may be cut short."""
    lines = read_head(file).decode("utf-8-sig", errors="replace").splitlines()
    header = [name.strip().lower() for name in next(csv.reader(lines[:1]), [])]
    return [dict(zip(header, row, strict=False)) for row in csv.reader(lines[1:])]


def _find_map(recording_meta: RawFile, maps: dict[str, list[RawFile]]) -> list[RawFile]:
    """Find the map of a recording's location: of several the one with the longest common folder, the first by name."""

    def count_common(file: RawFile) -> int:
        one, other = ({*PurePosixPath(each.folder, each.filename).parents} for each in (recording_meta, file))
        return len(one & other)

    return sorted(maps.get(_find_location(recording_meta), []), key=count_common, reverse=True)[:1]


def _sort_maps(files: Iterable[RawFile]) -> dict[str, list[RawFile]]:
    """Sort maps by the number of their location (`location0.osm`), and by name."""
    maps: dict[str, list[RawFile]] = {}
    for file in sorted(files, key=lambda each: each.name):
        number = re.fullmatch(r"location(\d+)\.osm", file.filename.lower())
        if number is not None:
            maps.setdefault(number.group(1), []).append(file)
    return maps
