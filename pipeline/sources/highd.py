"""highD: drone recordings of German motorways, 25 Hz, three CSV files per recording."""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import account_rows
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.completeness import Announced, compare_counts
from tracklake.pipeline.sources.highd_rows import DIRECTION, add_directions, split_impossible
from tracklake.pipeline.sources.levelx import RECORDING, TRACKS, VEHICLES, LevelxFormat
from tracklake.pipeline.sources.source import Canonical, Part, RawFile, Source, SourceError, Subset
from tracklake.pipeline.transforms.tracks.orientation import LOWER, UPPER, orient_highd
from tracklake.schemas import references
from tracklake.schemas.columns import Origin
from tracklake.schemas.completeness import RECORDING_META, TRACKS_META
from tracklake.schemas.raw_highd import (
    RAW_HIGHD_RECORDING,
    RAW_HIGHD_TRACKS,
    RAW_HIGHD_VEHICLES,
    RAW_RECORDING_FIELDS,
    RAW_TRACKS_FIELDS,
    RAW_VEHICLES_FIELDS,
)

HIGHD_FORMAT = LevelxFormat(
    dataset="highd",
    title="highD",
    fields={RECORDING: RAW_RECORDING_FIELDS, VEHICLES: RAW_VEHICLES_FIELDS, TRACKS: RAW_TRACKS_FIELDS},
    raw={RECORDING: RAW_HIGHD_RECORDING, VEHICLES: RAW_HIGHD_VEHICLES, TRACKS: RAW_HIGHD_TRACKS},
    choices={VEHICLES: {"class": ("car", "truck")}},
)

FIRST_FRAME = 1
"""Number of a recording's first frame, where time_s = 0 even if the first vehicle appears later."""
SYNTHETIC_DAY = "synthetic"
"""Value of recordingMeta's weekDay that marks a generated recording."""
CARRIAGEWAYS = {UPPER: "upper", LOWER: "lower"}
"""Carriageways by drivingDirection."""


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn a recording's recordingMeta, tracksMeta and tracks, in this order, into its tables."""
    files = [part.file for part in parts]
    read, entries = HIGHD_FORMAT.read_recording(parts, recording)
    markings = _read_markings(read.meta, files[0])
    entries = add_directions(entries, read.vehicles)
    entries, impossible = split_impossible(entries, *(len(marked) - 1 for marked in markings.values()))
    dropped = [*read.dropped, *impossible]
    log, rejects = account_rows("highd", recording, read.parts, read.rows_parsed, dropped)
    carriageways = {direction: entries.filter(pl.col(DIRECTION) == direction) for direction in CARRIAGEWAYS}
    del entries, dropped, impossible
    subsets = [
        _to_subset(carriageways.pop(direction), read.vehicles, direction, recording, read.meta, markings, files)
        for direction in CARRIAGEWAYS
    ]
    found = tuple(subset for subset in subsets if subset is not None)
    of_tracks = log.filter(pl.col("dialect") == HIGHD_FORMAT.name_dialect(TRACKS))
    completeness, notes = compare_counts(
        "highd", recording, found, _list_announced(read.meta, read.vehicles), of_tracks
    )
    return Canonical(found, log, rejects, completeness, notes)


def read_metadata(files: Sequence[RawFile], recording: str) -> tuple[dict[str, Any], dict[int, int], pl.DataFrame]:
    """Read recordingMeta and tracksMeta, a recording's first two files.

    Returns the row of recordingMeta, lanes by driving direction, and the rows of tracksMeta, one per vehicle.

    Raises:
        SourceError: a file cannot be read or belongs to another recording.
    """
    meta, vehicles = HIGHD_FORMAT.read_metadata(files, recording)
    markings = _read_markings(meta, files[0])
    return meta, {direction: len(marked) - 1 for direction, marked in markings.items()}, vehicles


def find_origin(meta: Mapping[str, Any]) -> Origin:
    """Tell by the row of recordingMeta whether a recording was generated."""
    return "synthetic" if (meta["weekDay"] or "").strip().lower() == SYNTHETIC_DAY else "recorded"


def _read_markings(meta: dict[str, Any], file: RawFile) -> dict[int, list[float]]:
    """Parse y of the lane markings, by driving direction, in m from the image's top."""
    columns = {UPPER: "upperLaneMarkings", LOWER: "lowerLaneMarkings"}
    return {direction: _parse_markings(meta[column], file) for direction, column in columns.items()}


def _parse_markings(text: str, file: RawFile) -> list[float]:
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
    upper_m, lower_m = markings_m[UPPER], markings_m[LOWER]
    markings = [upper_m[-1] - y for y in reversed(upper_m)] if direction == UPPER else [y - lower_m[0] for y in lower_m]
    leader = pl.when(pl.col("precedingId") != 0)
    ranges = entries.group_by(vehicle_id="id").agg(
        length_range_m=_find_range("width"),
        width_range_m=_find_range("height"),
    )
    entries = orient_highd(entries, direction, upper_m, lower_m, meta["frameRate"]).select(
        *("frame", "x_m", "y_m", "heading_rad", "lane", "speed_mps", "accel_mps2", "lateral_speed_mps"),
        vehicle_id="id",
        leader_id=leader.then(pl.col("precedingId")),
        follower_id=pl.when(pl.col("followingId") != 0).then(pl.col("followingId")),
        headway_recorded_m=leader.then(pl.col("dhw")),
    )
    sizes = vehicles.filter(pl.col(DIRECTION) == direction).select(
        pl.col("class").str.to_lowercase(),
        vehicle_id="id",
        source_vehicle_id="id",
        length_m="width",
        width_m="height",
        entries_announced="numFrames",
    )
    sizes = sizes.join(ranges, on="vehicle_id", how="left", maintain_order="left")
    return assemble_subset(
        entries,
        sizes,
        dataset="highd",
        name=f"{recording}-{CARRIAGEWAYS[direction]}",
        facts={
            "recording": recording,
            "site": f"location-{meta['locationId']}",
            "origin": find_origin(meta),
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


def _find_range(column: str) -> pl.Expr:
    """Return the greatest less the least value of a column, to 1 mm."""
    return (pl.col(column).max() - pl.col(column).min()).round(3)


def _list_announced(meta: dict[str, Any], vehicles: pl.DataFrame) -> Announced:
    """List the counts that recordingMeta and tracksMeta announce."""
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
    citation=references.KRAJEWSKI.full,
    signature="highD: NN_recordingMeta.csv, NN_tracksMeta.csv and NN_tracks.csv with the headers as shipped",
    version=2,
    detect=HIGHD_FORMAT.detect,
    group=HIGHD_FORMAT.group,
    to_canonical=to_canonical,
    describe_columns=HIGHD_FORMAT.describe_columns,
)
