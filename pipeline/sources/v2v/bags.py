"""ROS bags: what an instrumented vehicle's receiver, inertial sensor, LiDAR, camera and radio logged."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv import LINE, REJECT_SCHEMA
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.bag_messages import Item, name_type, read_message
from tracklake.pipeline.sources.v2v.bag_records import (
    MCAP_MAGIC,
    ROS1_MAGIC,
    SQLITE_MAGIC,
    ZSTD_MAGIC,
    Record,
    list_bag_files,
    open_bag,
)
from tracklake.pipeline.sources.v2v.mounts import Mount, find_mount
from tracklake.pipeline.sources.v2v.point_clouds import POINT_CLOUD, Scans
from tracklake.schemas import DETECTIONS, EGO_STATES
from tracklake.schemas.arrays import Floats, Integers

MAX_GAP_US = 500_000
"""Greatest distance in us from a fix to the nearest heading or speed that is interpolated to its moment."""
MAX_DRIVE_US = 86_400_000_000
"""Time in us from the middle message of a bag at which others are no part of its drive: a day."""
HEADING_TYPES = ("std_msgs/msg/Float64", "geometry_msgs/msg/QuaternionStamped", "sensor_msgs/msg/Imu")
"""Types that state a heading, the first preferred where a bag has several."""
SERIES = {"speed": "speed_mps", "heading": "heading_deg", "accel": "accel_mps2", "yaw_rate": "yaw_rate_degps"}
"""Columns of the ego's states that have topics of their own, by kind of item."""
SINGLE = ("fix", "boxes", "camera", "scan", *SERIES)
"""Kinds of items that are read of one topic only."""
REPEATED = "the moment of another message of its topic"
"""Reason to reject a message where one of its topic has the same moment, as in two copies of a bag."""
OPTICAL = "optical"
"""Part of the name of a camera's frame whose z axis, not x, looks ahead (REP-103)."""
MAX_CAMERA_TURN_DEG = 10.0
"""Angle in degrees between the camera's axis and the ego's beyond which there is a note."""
EQUATOR_M, ECCENTRICITY2 = 6_378_137.0, 0.006_694_379_990_14
"""Semi-major axis in m and squared eccentricity of WGS-84."""
STATE_SCHEMA: dict[str, Any] = {
    FILE: pl.Int64(),
    LINE: pl.Int64(),
    "utc_us": pl.Int64(),
    **{name: dtype for name, dtype in EGO_STATES.dtypes.items() if name not in ("dataset", "subset", "time_s")},
}
"""Columns of the ego's states in a bag: where they stand, the moment in us since 1970, and those of the table."""
BOX_SCHEMA: dict[str, Any] = {
    "utc_us": pl.Int64(),
    **{name: dtype for name, dtype in DETECTIONS.dtypes.items() if name not in ("dataset", "subset", "time_s")},
}
"""Columns of camera boxes in a bag: the moment in us since 1970, and those of the table."""
TEXT_SCHEMA = {FILE: pl.Int64(), LINE: pl.Int64(), "received_us": pl.Int64(), "text": pl.String()}
"""Columns of V2V messages in a bag: where they stand, when they were received, and JSON or hex."""


@dataclass(frozen=True)
class BagContents:
    """What is read of a bag, which may have several files.

    Args:
        ego: rows of STATE_SCHEMA, one per fix of the receiver.
        detections: rows of BOX_SCHEMA.
        images_us: moment of each image, with or without boxes, in us since 1970.
        texts: rows of TEXT_SCHEMA, V2V messages that are still to be decoded.
        scans: scans of the LiDAR, read while they are iterated.
        camera: focal lengths and principal point (fx, fy, cx, cy) in px; None where unknown.
        camera_mount: place of the camera; None where unknown.
        rejects: FILE (index in the given files), `line` (the message's number among those of its file that are read,
            from 1), `reason`, `text`.
        rows_read: messages read, by file; those of other types are in the notes alone.
        notes: messages for the user.
        synthetic: whether the bag carries the mark of a generated one.
    """

    ego: pl.DataFrame
    detections: pl.DataFrame
    images_us: Integers
    texts: pl.DataFrame
    scans: Scans
    camera: tuple[float, float, float, float] | None
    camera_mount: Mount | None
    rejects: pl.DataFrame
    rows_read: tuple[int, ...]
    notes: tuple[str, ...]
    synthetic: bool


class _Found(NamedTuple):
    """An item with the place where it stands, and its record without the bytes."""

    file: int
    line: int
    item: Item
    record: Record


@dataclass
class _Collection:
    """What has been read so far."""

    found: dict[tuple[str, str], list[_Found]] = field(default_factory=dict)
    clouds: dict[tuple[int, str], list[_Found | None]] = field(default_factory=dict)
    rejects: list[tuple[int, int, str, str]] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    backwards: Counter[str] = field(default_factory=Counter)
    unstamped: Counter[str] = field(default_factory=Counter)
    latest_us: dict[str, int] = field(default_factory=dict)

    def reject(self, file: int, line: int, record: Record, reason: str) -> None:
        moment = datetime.fromtimestamp(max(record.bag_us, 0) // 1_000_000, tz=UTC) if record.bag_us < 1 << 57 else "?"
        text = f"{record.topic} ({record.msgtype}) at {moment}, {len(record.raw):,} bytes"
        self.rejects.append((file, line, reason, text))

    def reject_found(self, found: _Found, reason: str) -> None:
        self.reject(found.file, found.line, found.record, reason)

    def of_kind(self, kind: str) -> dict[str, list[_Found]]:
        return {topic: found for (own, topic), found in self.found.items() if own == kind}


def is_bag(head: bytes, name: str) -> bool:
    """Recognise a bag of ROS 1, or a file with messages of a ROS 2 bag, by its first bytes."""
    if head.startswith(ZSTD_MAGIC):
        return name.lower().endswith((".db3.zstd", ".mcap.zstd"))
    return head.startswith((ROS1_MAGIC, MCAP_MAGIC)) or (head.startswith(SQLITE_MAGIC) and b"topics" in head)


def read_bag(files: Sequence[RawFile]) -> BagContents:
    """Read the files of a bag, in the order of their names: one of ROS 1, or the folder of one of ROS 2.

    Everything but the points of the scans is read now, and every message is checked; the scans are read again, one by
    one, as they are iterated.

    Raises:
        SourceError: a file is damaged, cut short, or no bag, or metadata.yaml lists files that are not beside it.
        MissingExtraError: the library for bags is not installed.
    """
    collected = _Collection()
    rows_read = [_collect(index, file, collected) for index, file in enumerate(files)]
    _drop_far(collected)
    names = ", ".join(file.name for file in files[:3])
    chosen = {kind: _choose_topic(kind, collected) for kind in SINGLE}
    transforms = [
        each for found in collected.of_kind("transforms").values() for own in found for each in own.item.values
    ]
    notes: list[str] = []
    scans = _arrange_scans(files, chosen["scan"], transforms, collected)
    cameras = chosen["camera"][1][:1]
    images = _drop_repeated(chosen["boxes"][1], collected)
    ego = _make_states({kind: found for kind, (_, found) in chosen.items()}, transforms, collected)
    frame = cameras[0].item.values[0] if cameras else images[0].item.values[0] if images else ""
    camera_mount = find_mount(frame, transforms) if frame else None
    notes += _describe_camera(camera_mount, frame)
    notes += _describe_collection(collected, chosen)
    texts = [own for found in collected.of_kind("text").values() for own in found]
    return BagContents(
        ego=ego,
        detections=_make_boxes(images),
        images_us=np.array([own.item.utc_us for own in images], np.int64),
        texts=pl.DataFrame(
            [(own.file, own.line, own.item.utc_us, own.item.values[0]) for own in texts],
            schema=TEXT_SCHEMA,
            orient="row",
        ).sort(FILE, LINE),
        scans=scans,
        camera=cameras[0].item.values[1:] if cameras else None,
        camera_mount=camera_mount,
        rejects=pl.DataFrame(collected.rejects, schema={FILE: pl.Int64(), **REJECT_SCHEMA}, orient="row"),
        rows_read=tuple(rows_read),
        notes=tuple(f"{names}: {note}" for note in notes),
        synthetic=any(own.item.values[0] for found in collected.of_kind("origin").values() for own in found),
    )


def _collect(index: int, file: RawFile, collected: _Collection) -> int:
    """Read a file's messages into the collection and return their number."""
    if file.path.suffix in (".yaml", ".yml"):
        list_bag_files(file)
        return 0
    line = 0
    with open_bag(file) as bag:
        wanted = {key for key in bag.counts if name_type(*key)}
        for (topic, msgtype), count in bag.counts.items():
            if (topic, msgtype) not in wanted:
                collected.ignored[msgtype] += count
        for line, record in enumerate(bag.read(wanted), start=1):
            clouds = collected.clouds.setdefault((index, record.topic), [])
            try:
                items = read_message(record, bag.version)
            except ValueError as error:
                collected.reject(index, line, record, str(error))
                clouds += [None] * (record.msgtype == POINT_CLOUD)
                continue
            if not items:
                collected.ignored[f"{record.msgtype} without anything to use"] += 1
            light = record._replace(raw=b"")
            for item in items:
                found = _Found(index, line, item, light)
                if item.kind == "scan":
                    clouds.append(found)
                collected.found.setdefault((item.kind, record.topic), []).append(found)
            for item in items[:1]:
                collected.backwards[record.topic] += item.utc_us < collected.latest_us.get(record.topic, item.utc_us)
                collected.unstamped[record.topic] += not item.stamped
                collected.latest_us[record.topic] = item.utc_us
    return line


def _drop_far(collected: _Collection) -> None:
    """Reject messages a day or more from the others: one wrong time would stretch the drive over years."""
    moments = [own.item.utc_us for found in collected.found.values() for own in found]
    if not moments or max(moments) - min(moments) < MAX_DRIVE_US:
        return
    middle_us = int(np.median(moments))

    def is_far(own: _Found | None) -> bool:
        return own is not None and abs(own.item.utc_us - middle_us) >= MAX_DRIVE_US

    for kind, topic in list(collected.found):
        found = collected.found[kind, topic]
        far = [own for own in found if is_far(own)]
        known = {(file, line) for file, line, _, _ in collected.rejects}
        for own in far:
            if (own.file, own.line) not in known:
                collected.reject_found(own, "a day or more from the other messages of the bag")
        collected.found[kind, topic] = [own for own in found if not is_far(own)]
        if not collected.found[kind, topic]:
            del collected.found[kind, topic]
    collected.clouds = {
        place: [None if is_far(cloud) else cloud for cloud in clouds] for place, clouds in collected.clouds.items()
    }


def _choose_topic(kind: str, collected: _Collection) -> tuple[str, list[_Found]]:
    """Choose the topic of a kind with the most messages, of a heading that of the preferred type."""

    def rank(entry: tuple[str, list[_Found]]) -> tuple[int, int, str]:
        topic, found = entry
        msgtype = found[0].record.msgtype
        preferred = HEADING_TYPES.index(msgtype) if kind == "heading" and msgtype in HEADING_TYPES else 0
        return preferred, -len(found), topic

    return min(collected.of_kind(kind).items(), key=rank, default=("", []))


def _arrange_scans(
    files: Sequence[RawFile],
    chosen: tuple[str, list[_Found]],
    transforms: Iterable[tuple[str, str, Floats]],
    collected: _Collection,
) -> Scans:
    """Find the LiDAR's place; reject scans in a frame whose place is unknown, and those of a moment that has one."""
    topic, found = chosen
    if not found:
        return Scans()
    frame = found[0].item.values[0]
    mount = find_mount(frame, transforms)
    moments: list[list[int | None]] = []
    seen: set[int] = set()
    for index in range(len(files)):
        moments.append([])
        for cloud in collected.clouds.get((index, topic), []):
            reason = "" if cloud is None else _find_obstacle(cloud, frame, mount, seen)
            moments[-1].append(None if cloud is None or reason else cloud.item.utc_us)
            if cloud is not None and reason:
                collected.reject_found(cloud, reason)
            elif cloud is not None:
                seen.add(cloud.item.utc_us)
    return Scans(files, moments, topic, mount)


def _find_obstacle(cloud: _Found, frame: str, mount: Mount | None, seen: Collection[int]) -> str:
    """Return why a scan cannot be used, or nothing; `seen` are the moments of those before it."""
    where = f"frame {cloud.item.values[0]!r}"
    if mount is None:
        return f"{where}: no static transform (/tf_static) leads from it to base_link"
    if cloud.item.values[0] != frame:
        return f"{where} instead of {frame!r}"
    return REPEATED if cloud.item.utc_us in seen else ""


def _drop_repeated(found: Sequence[_Found], collected: _Collection) -> list[_Found]:
    """Sort by moment; of several at one moment only the first is kept."""
    kept: list[_Found] = []
    for own in sorted(found, key=lambda each: (each.item.utc_us, each.file, each.line)):
        if kept and own.item.utc_us == kept[-1].item.utc_us:
            collected.reject_found(own, REPEATED)
        else:
            kept.append(own)
    return kept


def _make_states(
    chosen: Mapping[str, list[_Found]], transforms: Iterable[tuple[str, str, Floats]], collected: _Collection
) -> pl.DataFrame:
    """Make a state of each fix, with what other topics say of its moment, at the ego's centre."""
    fixes = _drop_repeated(chosen["fix"], collected)
    utc_us = np.array([own.item.utc_us for own in fixes], np.int64)
    lat_deg = np.array([own.item.values[0] for own in fixes], np.float64)
    lon_deg = np.array([own.item.values[1] for own in fixes], np.float64)
    series = {name: _interpolate(chosen[kind], utc_us, turns=kind == "heading") for kind, name in SERIES.items()}
    if fixes and (antenna := find_mount(fixes[0].item.values[3], transforms)) is not None:
        lat_deg, lon_deg = _move_to_centre(lat_deg, lon_deg, series["heading_deg"], antenna)
    frame = pl.DataFrame(
        {
            FILE: [own.file for own in fixes],
            LINE: [own.line for own in fixes],
            "utc_us": utc_us,
            "source": ["gnss"] * len(fixes),
            "lat_deg": lat_deg,
            "lon_deg": lon_deg,
            "elevation_m": [own.item.values[2] for own in fixes],
            **series,
        },
        schema_overrides=STATE_SCHEMA,
    ).with_columns(pl.col(*series.keys()).fill_nan(None))
    # Single precision rounds 359.99999 to 360.
    return frame.with_columns(pl.col("heading_deg") % 360).select(*STATE_SCHEMA)


def _interpolate(found: Sequence[_Found], at_us: Integers, *, turns: bool) -> Floats:
    """Interpolate a quantity to moments; NaN where no message is near in time."""
    if not found:
        return np.full(at_us.shape, np.nan)
    times, first = np.unique([own.item.utc_us for own in found], return_index=True)
    values = np.array([own.item.values[0] for own in found], np.float64)[first]
    if turns:
        values = np.unwrap(values, period=360)
    after = np.clip(np.searchsorted(times, at_us), 1, max(len(times) - 1, 1))
    nearest = np.minimum(np.abs(times[after - 1] - at_us), np.abs(times[np.minimum(after, len(times) - 1)] - at_us))
    # From the first time on, differences are small enough for exact floats.
    result = np.interp(at_us - times[0], times - times[0], values)
    return np.where(nearest <= MAX_GAP_US, result % 360 if turns else result, np.nan)


def _move_to_centre(lat_deg: Floats, lon_deg: Floats, heading_deg: Floats, antenna: Mount) -> tuple[Floats, Floats]:
    """Return positions of the ego's centre from those of its antenna; where the heading is unknown, of the antenna."""
    heading, latitude = np.radians(np.where(np.isnan(heading_deg), 0, heading_deg)), np.radians(lat_deg)
    known = ~np.isnan(heading_deg)
    north_m = known * (antenna.x_m * np.cos(heading) - antenna.y_m * np.sin(heading))
    east_m = known * (antenna.x_m * np.sin(heading) + antenna.y_m * np.cos(heading))
    flat = 1 - ECCENTRICITY2 * np.sin(latitude) ** 2
    north_radius_m, east_radius_m = EQUATOR_M * (1 - ECCENTRICITY2) / flat**1.5, EQUATOR_M / np.sqrt(flat)
    return (
        lat_deg - np.degrees(north_m / north_radius_m),
        lon_deg - np.degrees(east_m / (east_radius_m * np.cos(latitude))),
    )


def _make_boxes(images: Sequence[_Found]) -> pl.DataFrame:
    rows = [(own.item.utc_us, number, *box) for own in images for number, box in enumerate(own.item.values[1])]
    return pl.DataFrame(rows, schema=BOX_SCHEMA, orient="row")


def _describe_camera(mount: Mount | None, frame: str) -> list[str]:
    """Tell the user of a camera that does not look ahead: boxes are matched as if it did."""
    if mount is None:
        return []
    ahead = float(mount.rotation[0, 2 if OPTICAL in frame else 0])
    turn_deg = float(np.degrees(np.arccos(np.clip(ahead, -1, 1))))
    if turn_deg <= MAX_CAMERA_TURN_DEG:
        return []
    return [f"the camera looks {turn_deg:.0f} degrees off the vehicle's axis; its boxes count as seen straight ahead"]


def _describe_collection(collected: _Collection, chosen: Mapping[str, tuple[str, list[_Found]]]) -> list[str]:
    """Tell the user what was not read, and whose clocks are not to be trusted."""
    notes = []
    if collected.ignored:
        listed = ", ".join(f"{count:,} {msgtype}" for msgtype, count in sorted(collected.ignored.items()))
        notes.append(f"not read, by type of message: {listed}")
    for kind, (topic, _) in chosen.items():
        others = {name: len(found) for name, found in collected.of_kind(kind).items() if name != topic}
        if others:
            listed = ", ".join(f"{name} ({count:,})" for name, count in sorted(others.items()))
            notes.append(f"{kind.replace('_', ' ')} is taken from {topic}; not used: {listed}")
    used = {topic for topic, _ in chosen.values()}
    for topic in sorted(used & collected.backwards.keys()):
        if count := collected.backwards[topic]:
            notes.append(f"{topic}: steps of its clock backwards: {count:,}")
        if count := collected.unstamped[topic]:
            notes.append(f"{topic}: stamps that are no UTC times, so that the bag's times count: {count:,}")
    return notes
