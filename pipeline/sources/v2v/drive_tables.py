"""Tables of one drive from its messages and what was sensed beside them, on the drive's clock."""

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import polars as pl

from tracklake.pipeline.sources.source import Drive, RawFile, SourceError
from tracklake.pipeline.sources.v2v.assembly import Assembled, assemble_messages, date_messages
from tracklake.pipeline.sources.v2v.bags import BagContents
from tracklake.pipeline.sources.v2v.clocks import count_seconds
from tracklake.pipeline.sources.v2v.logs import Logs
from tracklake.pipeline.sources.v2v.point_clouds import Scans
from tracklake.pipeline.sources.v2v.truth import resolve_truth
from tracklake.schemas import (
    BSM,
    DETECTIONS,
    DRIVES,
    EGO_STATES,
    LIDAR_RETURNS,
    STATIONS,
    SURROUNDING_TRUTH,
    Table,
)

EPOCH = datetime(1970, 1, 1, tzinfo=UTC).replace(tzinfo=None)
"""Moment from which microseconds count, in UTC."""


def make_drive(
    name: str, recording: str, messages: pl.DataFrame, bag: BagContents | None, logs: Logs, files: Sequence[RawFile]
) -> tuple[Drive, Assembled]:
    """Make the tables of a drive.

    Args:
        name: name of the drive.
        recording: name of its folder.
        messages: messages that the ego of this drive sent or received.
        bag: what its bags sensed.
        logs: all that was read of the folder.
        files: files of the folder.

    Returns:
        the drive and its messages, with those that it does not take.
    """
    dated = date_messages(messages)
    start_us = _find_start(dated, bag, logs, recording)
    refused = logs.impossible.join(messages.select("receiver"), on="receiver", how="semi", nulls_equal=True)
    assembled = assemble_messages(dated, start_us, refused)
    states = [assembled.bsm.filter("own").select(_STATES, source=pl.lit("bsm"))]
    place = {"dataset": pl.lit("v2v"), "subset": pl.lit(name)}
    tables: dict[Table, pl.DataFrame] = {STATIONS: assembled.stations, BSM: assembled.bsm}
    if bag is not None:
        states.insert(0, _set_clock(bag.ego, start_us).select(*_STATES, "source"))
        tables[DETECTIONS] = _set_clock(bag.detections, start_us).sort(DETECTIONS.key)
    # Where a moment has both, the receiver states more digits than a message.
    tables[EGO_STATES] = pl.concat(states, how="vertical_relaxed").unique("time_s", keep="first").sort("time_s")
    if logs.truths:
        tables[SURROUNDING_TRUTH] = resolve_truth(logs.truths[0], assembled.bsm, start_us)
    facts = {
        "subset": name,
        "recording": recording,
        "origin": "synthetic" if logs.synthetic else "recorded",
        "start_utc": EPOCH + timedelta(microseconds=start_us),
        "source_files": [{"file": file.name, "sha256": file.sha256} for file in files],
        **_describe_messages(tables),
        **(_describe_sensors(bag, start_us) if bag is not None else {}),
    }
    facts["seconds"] = max(facts["seconds"], facts.pop("sensed_s", 0.0))
    row = pl.DataFrame([{**dict.fromkeys(DRIVES.dtypes), "scans": 0, "images": 0, **facts}], schema=DRIVES.dtypes)
    frames = {
        table: frame.lazy().with_columns(**place).pipe(table.conform).collect()
        for table, frame in {DRIVES: row, **tables}.items()
    }
    returns = {} if bag is None else {LIDAR_RETURNS: _read_returns(bag.scans, start_us, name)}
    describe = bag.scans.describe_removed if bag is not None else tuple
    return Drive(name, {**frames, **returns}, describe), assembled


_STATES = [name for name in EGO_STATES.dtypes if name not in ("dataset", "subset", "source")]


def _find_start(messages: pl.DataFrame, bag: BagContents | None, logs: Logs, recording: str) -> int:
    """Return the least moment that a drive's files state, in microseconds since 1970."""
    least = messages.filter(~pl.col("is_far")).select(pl.col("utc_us", "received_us").min())
    moments = [*least.row(0), *(each.start_us for each in logs.truths)]
    known = [moment for moment in moments if moment is not None] + (_list_moments(bag) if bag is not None else [])
    if not known:
        raise SourceError(
            f"recording {recording}: none of its {messages.height:,} messages states a date. Expected a UTC time of "
            "sending or receiving; the second mark alone tells the second in an unknown minute. Give logs with times."
        )
    return int(min(known))


def _list_moments(bag: BagContents) -> list[int]:
    """List the moments of all that a bag's sensors logged, in microseconds since 1970."""
    scans = [moment for moments in bag.scans.moments_us for moment in moments if moment is not None]
    return [*bag.ego["utc_us"].to_list(), *bag.images_us.tolist(), *scans]


def _set_clock(frame: pl.DataFrame, start_us: int) -> pl.DataFrame:
    return frame.with_columns(time_s=count_seconds("utc_us", start_us))


def _describe_messages(tables: dict[Table, pl.DataFrame]) -> dict[str, Any]:
    """Return the columns of `drives` that follow from its messages."""
    ego = tables[STATIONS].filter("own").sort("messages", descending=True).head(1)
    last_s = tables[BSM].select(pl.max_horizontal(pl.col("time_s", "received_s").max())).item()
    known = {name: ego[name].item() if ego.height else None for name in ("vehicle_id", "length_m", "width_m")}
    return {
        "seconds": max(last_s or 0.0, 0.0),
        "stations": tables[STATIONS].height,
        "messages": tables[BSM].height,
        "ego_id": known["vehicle_id"],
        "ego_length_m": known["length_m"],
        "ego_width_m": known["width_m"],
    }


def _describe_sensors(bag: BagContents, start_us: int) -> dict[str, Any]:
    """Return the columns of `drives` about sensors, and the time of the last thing sensed."""
    lens = zip(("fx", "fy", "cx", "cy"), bag.camera or (), strict=False)
    mounts = {"camera": bag.camera_mount, "lidar": bag.scans.mount}
    return {
        "scans": len(bag.scans),
        "images": len(bag.images_us),
        "sensed_s": (max(_list_moments(bag), default=start_us) - start_us) / 1_000_000,
        **{f"camera_{name}_px": value for name, value in lens},
        **{
            f"{sensor}_{axis}_m": getattr(mount, f"{axis}_m")
            for sensor, mount in mounts.items()
            if mount is not None
            for axis in "xyz"
        },
    }


def _read_returns(scans: Scans, start_us: int, name: str) -> Iterator[pl.DataFrame]:
    """Yield the rows of `lidar_returns` of each scan; all of a drive would not fit into the memory."""
    for scan in scans:
        points = pl.DataFrame(scan.points_m, schema=["x_m", "y_m", "z_m"], orient="row")
        yield (
            points.with_row_index("point")
            .lazy()
            .with_columns(
                dataset=pl.lit("v2v"),
                subset=pl.lit(name),
                scan=pl.lit(scan.scan),
                time_s=pl.lit((scan.utc_us - start_us) / 1_000_000),
            )
            .pipe(LIDAR_RETURNS.conform)
            .collect()
        )
