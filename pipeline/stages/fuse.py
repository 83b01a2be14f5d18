"""Fuse: the vehicles around an instrumented vehicle, by its messages, LiDAR and camera."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.pipeline.transforms.onboard.measurements import Camera, Scanner
from tracklake.pipeline.transforms.onboard.surrounding import Scan, Sensors, fuse_drive
from tracklake.schemas import (
    ASSOCIATION,
    BSM,
    DETECTIONS,
    DRIVES,
    EGO_STATES,
    LIDAR_CLUSTERS,
    LIDAR_RETURNS,
    SURROUNDING,
    Table,
)
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.extras import require_extras

SCANS_PER_READ = 50
"""LiDAR scans that are in memory at once."""
CAMERA = ("fx_px", "fy_px", "cx_px", "cy_px", "x_m", "y_m", "z_m")
"""Columns of `drives` about the camera, without their prefix."""
EGO_SOURCES = "add a log with its own messages or NavSatFix to the drive's folder, and ingest it again"
"""Next step where positions of the ego are missing."""
LONGEST_S = 86_400.0
"""Longest drive that is tracked, in s: a day; a longer one has a wrong clock."""


def read_scans(returns: pl.LazyFrame, count: int) -> Iterator[Scan]:
    """Yield the scans of LIDAR_RETURNS in the order of time, a few in memory at once.

    Args:
        returns: rows of the drive, sorted by scan.
        count: number of scans, `drives.scans`.
    """
    for first in range(0, count, SCANS_PER_READ):
        inside = pl.col("scan").is_between(first, first + SCANS_PER_READ - 1)
        rows = returns.filter(inside).select("scan", "time_s", "x_m", "y_m", "z_m").collect()
        starts = np.flatnonzero(np.diff(rows["scan"].to_numpy(), prepend=-1))
        points = rows.select("x_m", "y_m", "z_m").to_numpy()
        times = rows["time_s"].to_numpy()[starts].tolist()
        yield from zip(times, np.split(points, starts[1:]), strict=True) if times else ()


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Track the vehicles around the ego over one drive."""
    require_extras("`tracklake fuse`", "onboard")
    facts = reader.table(DRIVES).row(0, named=True)
    ego_states = reader.table(EGO_STATES)
    reason = None
    if ego_states.is_empty():
        reason = f"no position of the ego was logged; {EGO_SOURCES}"
    elif facts["seconds"] > LONGEST_S:
        reason = f"it lasts {facts['seconds']:,.0f} s, more than a day, so a clock is wrong"
    if reason is not None:
        empty = {table: table.empty() for table in (LIDAR_CLUSTERS, ASSOCIATION, SURROUNDING)}
        return StageResult(empty, notes=[f"{reader.subset}: vehicles around the ego are not tracked: {reason}"])
    ticks = int(facts["seconds"] * TICK_RATE_HZ + 1e-6) + 1
    fused = fuse_drive(reader.table(BSM), ego_states, ticks, open_sensors(reader, facts, settings))
    unknown = fused.counts["ticks_without_ego"]
    notes = [*list_missing(reader.subset, facts, settings)]
    note = (
        f"{reader.subset}: the ego's position is unknown at {unknown:,} of {ticks:,} ticks, which have no rows; "
        f"{EGO_SOURCES}"
    )
    return StageResult(
        {table: _add_place(table, frame, reader) for table, frame in fused.tables.items()},
        info=dict(fused.counts),
        notes=notes + [note] * bool(unknown),
    )


def open_sensors(reader: SubsetReader, facts: Mapping[str, Any], settings: Settings) -> Sensors:
    """Return what LiDAR and camera of a drive gave, as far as it is known and the settings want it.

    Args:
        reader: reader of the drive's tables.
        facts: the drive's row of `drives`.
        settings: `onboard_lidar` and `onboard_camera`.
    """
    sensors = Sensors()
    if facts["scans"] and settings.onboard_lidar:
        from tracklake.pipeline.transforms.onboard.association import measure_by_lidar

        mount = {name: facts[f"lidar_{name}"] for name in ("x_m", "y_m", "z_m")}
        scanner = Scanner(**{name: value for name, value in mount.items() if value is not None})
        sensors.scans = read_scans(reader.scan(LIDAR_RETURNS), facts["scans"])
        sensors.measure = partial(measure_by_lidar, scanner=scanner)
    if facts["images"] and settings.onboard_camera and _knows_camera(facts):
        from tracklake.pipeline.transforms.onboard.camera import match_boxes

        sensors.detections, sensors.match_boxes = reader.table(DETECTIONS), match_boxes
        sensors.camera = Camera(**{name: facts[f"camera_{name}"] for name in CAMERA})
    return sensors


def list_missing(subset: str, facts: Mapping[str, Any], settings: Settings) -> Iterator[str]:
    """Yield notes about what was logged and cannot be used."""
    if facts["images"] and settings.onboard_camera and not _knows_camera(facts):
        lacking = ", ".join(f"camera_{name}" for name in CAMERA if facts[f"camera_{name}"] is None)
        yield f"{subset}: camera boxes are not used: `drives` lacks {lacking}"


def _knows_camera(facts: Mapping[str, Any]) -> bool:
    return all(facts[f"camera_{name}"] is not None for name in CAMERA)


def _add_place(table: Table, frame: pl.DataFrame, reader: SubsetReader) -> pl.DataFrame:
    """Return a frame with the columns of its place, in the table's order."""
    place = [pl.lit(value).alias(name) for name, value in reader.partition.items()]
    return frame.with_columns(place).select(list(table.dtypes))


STAGE = Stage(
    name="fuse",
    meaning="Track the vehicles around an instrumented vehicle, by its messages, LiDAR and camera.",
    scope="drive",
    after=(INGEST,),
    settings=("onboard_lidar", "onboard_camera"),
    version=6,
    build=build,
)
