"""What single ROS messages say, in the units of the ego's tables."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from tracklake.pipeline.sources.v2v.bag_definitions import DETECTION_ARRAY, LAYOUTS, name_layout
from tracklake.pipeline.sources.v2v.bag_records import Record, RosMessage, decode
from tracklake.pipeline.sources.v2v.mounts import make_rotation, read_transforms
from tracklake.pipeline.sources.v2v.pilot_json import recognise_pilot_json
from tracklake.pipeline.sources.v2v.point_clouds import POINT_CLOUD, read_points

MAX_STAMP_ERROR_US = 60_000_000
"""Greatest difference in us between a header's stamp and the bag's time; beyond it the stamp is no UTC time (0, or the
time since a sensor was switched on), and the bag's time counts."""
LATITUDES, LONGITUDES = (-84.0, 80.0), (-180.0, 180.0)
"""Bounds of positions in degrees, as for messages."""
UNKNOWN = -1.0
"""First element of a covariance in sensor_msgs/Imu that says the quantity was not measured."""
JSON_CORE, HEX_DIGITS = re.compile(r"(coreData|BSMcoreData|BSM)\b"), re.compile(r"[0-9A-Fa-f\s]+")
"""Patterns of what JSON with a V2V message contains, and of hex digits; no text takes them more than linear time."""
ORIGIN_TOPIC, ORIGIN_WORD = "/tracklake/origin", "synthetic"
"""Topic of the message that marks a generated bag, and the first word of its text."""


class Item(NamedTuple):
    """One thing that a message says: its kind, its moment in us since 1970, its values, and whose clock that was."""

    kind: str
    utc_us: int
    values: tuple[Any, ...]
    stamped: bool = True


def name_type(topic: str, msgtype: str) -> str | None:
    """Return the type as which messages of a topic are read, or None where they are not."""
    if msgtype == "std_msgs/msg/Float64":
        return msgtype if topic.endswith("heading") else None
    if msgtype in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        return msgtype if topic.rpartition("/")[2] == "tf_static" else None
    return msgtype if msgtype in READERS else None


def read_message(record: Record, version: int) -> list[Item]:
    """Decode a message and return what it says; nothing for a text that is no V2V message.

    Raises:
        ValueError: the bytes are no such message, or it has a value that cannot be used.
    """
    message = (_decode_boxes if record.msgtype == DETECTION_ARRAY else decode)(record, version)
    return READERS[record.msgtype](message, record)


def _decode_boxes(record: Record, version: int) -> RosMessage:
    """Decode camera boxes in the first of the known layouts that their length fits."""
    first: ValueError | None = None
    for layout in LAYOUTS if version == 2 else sorted(LAYOUTS, key=lambda name: not name.startswith("number")):
        try:
            return decode(record, version, name_layout(layout))
        except ValueError as error:
            first = first or error
    assert first is not None
    raise first


def _make_item(kind: str, message: RosMessage, record: Record, *values: object) -> Item:
    """Make an item at the moment of the header's stamp, or at the bag's time where the stamp is no UTC time."""
    stamp = message.header.stamp
    utc_us = int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000
    stamped = abs(utc_us - record.bag_us) <= MAX_STAMP_ERROR_US
    return Item(kind, utc_us if stamped else record.bag_us, values, stamped)


def _read_fix(message: RosMessage, record: Record) -> list[Item]:
    lat, lon, elevation = message.latitude, message.longitude, message.altitude
    if message.status.status < 0:
        raise ValueError("no satellite fix")
    if (lat, lon) == (0, 0):
        raise ValueError("position (0, 0)")
    if not (LATITUDES[0] <= lat <= LATITUDES[1] and LONGITUDES[0] <= lon <= LONGITUDES[1]):
        raise ValueError("position outside -84 to 80 degrees of latitude or 180 of longitude")
    known = elevation if math.isfinite(elevation) else None
    return [_make_item("fix", message, record, lat, lon, known, message.header.frame_id)]


def _read_imu(message: RosMessage, record: Record) -> list[Item]:
    found = []
    turn = message.orientation
    # Drivers that know none leave (0, 0, 0, 0) in ROS 1 and (0, 0, 0, 1) in ROS 2, which would be east for ever.
    is_given = any((turn.x, turn.y, turn.z))
    if is_given and message.orientation_covariance[0] != UNKNOWN:
        found.append(_make_item("heading", message, record, _find_heading(turn)))
    if message.angular_velocity_covariance[0] != UNKNOWN:
        yaw_rate_degps = -math.degrees(_check(message.angular_velocity.z))  # clockwise is positive
        found.append(_make_item("yaw_rate", message, record, yaw_rate_degps))
    if message.linear_acceleration_covariance[0] != UNKNOWN:
        found.append(_make_item("accel", message, record, _check(message.linear_acceleration.x)))
    return found


def _find_heading(turn: RosMessage) -> float:
    """Return degrees clockwise from north of the x axis, from a rotation into axes east, north, up."""
    rotation = make_rotation(turn.x, turn.y, turn.z, turn.w)
    return (90 - math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))) % 360


def _read_quaternion(message: RosMessage, record: Record) -> list[Item]:
    return [_make_item("heading", message, record, _find_heading(message.quaternion))]


def _read_heading(message: RosMessage, record: Record) -> list[Item]:
    return [Item("heading", record.bag_us, (_check(message.data) % 360,))]


def _read_speed(message: RosMessage, record: Record) -> list[Item]:
    twist = message.twist.twist if hasattr(message.twist, "twist") else message.twist
    return [_make_item("speed", message, record, _check(math.hypot(twist.linear.x, twist.linear.y)))]


def _check(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("a value that is not finite")
    return float(value)


def _read_boxes(message: RosMessage, record: Record) -> list[Item]:
    boxes = []
    for each in message.detections:
        box = each.bbox
        values = (box.x - box.size_x / 2, box.y - box.size_y / 2, box.size_x, box.size_y)
        if not (all(map(math.isfinite, values)) and box.size_x > 0 and box.size_y > 0):
            raise ValueError(f"a box of {box.size_x:g} x {box.size_y:g} px")
        best = max(each.results, key=lambda result: result.score, default=None)
        result = (None, None) if best is None else (best.score if 0 <= best.score <= 1 else None, str(best.id))
        boxes.append((*values, *result))
    return [_make_item("boxes", message, record, message.header.frame_id, boxes)]


def _read_camera(message: RosMessage, record: Record) -> list[Item]:
    matrix = message.K if hasattr(message, "K") else message.k
    fx, fy, cx, cy = (_check(float(matrix[index])) for index in (0, 4, 2, 5))
    if fx <= 0 or fy <= 0:
        raise ValueError("a camera that is not calibrated: focal length 0")
    return [Item("camera", record.bag_us, (message.header.frame_id, fx, fy, cx, cy))]


def _read_transforms(message: RosMessage, record: Record) -> list[Item]:
    return [Item("transforms", record.bag_us, tuple(read_transforms(message)))]


def _read_text(message: RosMessage, record: Record) -> list[Item]:
    if record.topic == ORIGIN_TOPIC:
        return [Item("origin", record.bag_us, (message.data.startswith(ORIGIN_WORD),))]
    text = (message.data if isinstance(message.data, str) else bytes(message.data).hex()).strip()
    if text.startswith("{"):
        is_message = JSON_CORE.search(text) is not None or recognise_pilot_json(text.encode())
    else:
        is_message = "0014" in text and HEX_DIGITS.fullmatch(text) is not None
    return [Item("text", record.bag_us, (" ".join(text.split()),))] if is_message else []


def _read_cloud(message: RosMessage, record: Record) -> list[Item]:
    read_points(message)
    return [_make_item("scan", message, record, message.header.frame_id)]


READERS: Mapping[str, Callable[[Any, Record], list[Item]]] = {
    "sensor_msgs/msg/NavSatFix": _read_fix,
    "sensor_msgs/msg/Imu": _read_imu,
    "geometry_msgs/msg/QuaternionStamped": _read_quaternion,
    "std_msgs/msg/Float64": _read_heading,
    "geometry_msgs/msg/TwistStamped": _read_speed,
    "nav_msgs/msg/Odometry": _read_speed,
    DETECTION_ARRAY: _read_boxes,
    "sensor_msgs/msg/CameraInfo": _read_camera,
    "tf2_msgs/msg/TFMessage": _read_transforms,
    "tf/msg/tfMessage": _read_transforms,
    "std_msgs/msg/String": _read_text,
    "std_msgs/msg/UInt8MultiArray": _read_text,
    POINT_CLOUD: _read_cloud,
}
"""Functions of a decoded message and its record, by type."""
