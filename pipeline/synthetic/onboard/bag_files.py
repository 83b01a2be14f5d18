"""Bags as ROS 1 and ROS 2 record them, written from what a virtual vehicle sensed."""

import heapq
import itertools
import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats, Singles
from tracklake.schemas.extras import require_extras

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

ORIGIN_TOPIC, ORIGIN_TEXT = "/tracklake/origin", "synthetic: made by tracklake instrument"
"""Topic and text of the message that marks a bag as synthetic."""
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
"""A point as drivers of 16-beam scanners pack it: x ahead, y to the left, z up, in m."""
RING_STEP_DEG, LOWEST_RING_DEG, RINGS = 2.0, -15.0, 16
"""Angle between two beams, angle of the lowest one, and number of beams of the scanner."""
DEFINITIONS = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
}
"""Definitions of messages that ROS keeps outside its common packages, whatever its version."""
BOXES = {
    1: {
        "Detection2D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\n"
        "sensor_msgs/Image source_img",
        "ObjectHypothesisWithPose": "int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
        "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    },
    2: {
        "Detection2D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id",
        "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
        "ObjectHypothesis": "string class_id\nfloat64 score",
        "BoundingBox2D": "Pose2D center\nfloat64 size_x\nfloat64 size_y",
        "Pose2D": "Point2D position\nfloat64 theta",
        "Point2D": "float64 x\nfloat64 y",
    },
}
"""Definitions of camera boxes in vision_msgs 0.0 of ROS 1, where classes are numbers, and 4.0 of ROS 2."""
CLASS_NUMBERS = {"car": 3, "motorcycle": 4, "bus": 6, "truck": 8}
"""Numbers of the classes in COCO, as detectors in ROS 1 give them."""
FRAMES = {"lidar": "velodyne", "camera": "camera_optical_frame"}
"""Names of the sensors' frames in a bag, by the sensor's name here."""
OPTICAL_ROTATION = (-0.5, 0.5, -0.5, 0.5)
"""Quaternion x, y, z, w from a camera's optical frame (z ahead, x right, y down) to its vehicle's (x ahead, y left)."""


class Camera(NamedTuple):
    """A pinhole camera: focal lengths, principal point and image size, in px."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int


class Image(NamedTuple):
    """What a detector found in an image: boxes (B, 4) as left, top, width, height in px; scores and classes (B,)."""

    utc_us: int
    boxes_px: Floats
    scores: Floats
    classes: tuple[str, ...]


class Stamped(NamedTuple):
    """A message with its topic, its type and the moment at which it is recorded."""

    utc_us: int
    topic: str
    msgtype: str
    message: object


def write_bag(
    path: Path,
    *,
    version: Literal[1, 2],
    ego: pl.DataFrame,
    scans: Iterable[tuple[int, Singles]] = (),
    images: Iterable[Image] = (),
    camera: Camera | None = None,
    mounts: Mapping[str, tuple[float, float, float]] | None = None,
    messages: Iterable[tuple[int, str]] = (),
    storage: Literal["sqlite3", "mcap"] = "sqlite3",
    compressed: bool = False,
) -> None:
    """Write what a virtual vehicle sensed as a bag: a file of ROS 1, or a folder of ROS 2.

    Scans, images and messages are taken one by one, in the order of their times.

    Args:
        path: the file or folder to be made; it appears whole or not at all.
        version: 1 or 2, of ROS.
        ego: `utc_us`, `lat_deg`, `lon_deg`, `elevation_m`, `speed_mps`, `heading_deg`, and if known `accel_mps2` and
            `yaw_rate_degps`, in the units of schemas.EGO_STATES; one row per fix of the receiver.
        scans: moment of each scan, and its points (P, 3) in m from the LiDAR: x ahead, y to the RIGHT, z up.
        images: boxes of each image.
        camera: the pinhole camera; None where there is none.
        mounts: place of `lidar` and `camera` in m: ahead of the ego's centre, to its right, above the ground.
        messages: moment at which each V2V message was received, and the message as JSON or as hex.
        storage: how ROS 2 stores messages.
        compressed: whether they are compressed, by lz4 in ROS 1 and by zstd in ROS 2.
    """
    require_extras("writing ROS bags", "onboard")
    store = make_store(version)
    make = MessageMaker(store, version)
    first_us = int(ego["utc_us"][0])
    head = [make.origin(first_us), make.transforms(first_us, mounts or {})]
    if camera is not None:
        head.append(make.camera_info(first_us, camera))
    stream = itertools.chain(
        head,
        heapq.merge(
            make.ego(ego),
            (make.scan(utc_us, points) for utc_us, points in scans),
            (make.image(image) for image in images),
            (make.text(utc_us, text) for utc_us, text in messages),
            key=lambda each: each.utc_us,
        ),
    )
    # The hidden folder is beside the target, so that renaming works.
    with tempfile.TemporaryDirectory(prefix=".bag-", dir=path.parent) as folder:
        unfinished = Path(folder) / path.name
        write_stream(unfinished, stream, store, version, storage, compressed=compressed)
        unfinished.rename(path)


def write_stream(
    path: Path,
    stream: Iterable[Stamped],
    store: "Typestore",
    version: int,
    storage: str = "sqlite3",
    *,
    compressed: bool = False,
) -> None:
    """Write messages in the order in which they come."""
    from rosbags import rosbag1, rosbag2

    writer: Any
    if version == 1:
        writer = rosbag1.Writer(path)
        if compressed:
            writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    else:
        writer = rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
        if compressed:
            writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for each in stream:
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(each.topic, each.msgtype, typestore=store)
            writer.write(connections[each.topic], each.utc_us * 1000, serialize(each.message, each.msgtype))


def make_store(version: int) -> "Typestore":
    """Return the types of a ROS version, with those of vision_msgs."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    definitions = {**DEFINITIONS, **{f"vision_msgs/msg/{name}": text for name, text in BOXES[version].items()}}
    store.register(
        {
            name: fields
            for own, text in definitions.items()
            for name, fields in get_types_from_msg(text, own).items()
            if name not in store.fielddefs
        }
    )
    return store


class MessageMaker:
    """Makes messages of one ROS version."""

    def __init__(self, store: "Typestore", version: int) -> None:
        self._types: Mapping[str, Any] = store.types
        self._version = version

    def __call__(self, name: str, /, **fields: object) -> object:
        """Make a message, or a part of one, of a type that is named without `msg`."""
        package, _, short = name.partition("/")
        return self._types[f"{package}/msg/{short}"](**fields)

    def header(self, utc_us: int, frame: str) -> object:
        """Make a header; that of ROS 1 has a number, which recorders leave at 0."""
        seconds, microseconds = divmod(utc_us, 1_000_000)
        stamp = self("builtin_interfaces/Time", sec=seconds, nanosec=microseconds * 1000)
        return self("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self._version == 1 else {}))

    def origin(self, utc_us: int) -> Stamped:
        """Make the mark of a synthetic bag."""
        return Stamped(utc_us, ORIGIN_TOPIC, "std_msgs/msg/String", self("std_msgs/String", data=ORIGIN_TEXT))

    def text(self, utc_us: int, text: str) -> Stamped:
        """Make a V2V message as it was received."""
        return Stamped(utc_us, "/v2v/messages", "std_msgs/msg/String", self("std_msgs/String", data=text))

    def transforms(self, utc_us: int, mounts: Mapping[str, tuple[float, float, float]]) -> Stamped:
        """Make the places of the sensors on the vehicle, whose frame lies on the ground below its centre."""
        transforms = []
        for sensor, (x_m, y_m, z_m) in mounts.items():
            x, y, z, w = OPTICAL_ROTATION if sensor == "camera" else (0.0, 0.0, 0.0, 1.0)
            place = self(
                "geometry_msgs/Transform",
                translation=self("geometry_msgs/Vector3", x=float(x_m), y=-float(y_m), z=float(z_m)),
                rotation=self("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
            )
            header = self.header(utc_us, "base_link")
            transforms.append(
                self("geometry_msgs/TransformStamped", header=header, child_frame_id=FRAMES[sensor], transform=place)
            )
        message = self("tf2_msgs/TFMessage", transforms=transforms)
        return Stamped(utc_us, "/tf_static", "tf2_msgs/msg/TFMessage", message)

    def camera_info(self, utc_us: int, camera: Camera) -> Stamped:
        """Make the description of a camera without distortion."""
        matrix = np.array([camera.fx_px, 0, camera.cx_px, 0, camera.fy_px, camera.cy_px, 0, 0, 1], np.float64)
        values = {
            "d": np.zeros(5),
            "k": matrix,
            "r": np.eye(3).ravel(),
            "p": np.hstack([matrix.reshape(3, 3), np.zeros((3, 1))]).ravel(),
        }
        window = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        message = self(
            "sensor_msgs/CameraInfo",
            header=self.header(utc_us, FRAMES["camera"]),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self("sensor_msgs/RegionOfInterest", **window),
            **({name.upper(): array for name, array in values.items()} if self._version == 1 else values),
        )
        return Stamped(utc_us, "/camera/camera_info", "sensor_msgs/msg/CameraInfo", message)

    def ego(self, ego: pl.DataFrame) -> Iterator[Stamped]:
        """Make the messages of the receiver and of the inertial sensor, one set per row."""
        for row in ego.iter_rows(named=True):
            utc_us = row["utc_us"]
            yield Stamped(utc_us, "/gps/fix", "sensor_msgs/msg/NavSatFix", self._fix(row))
            if row["heading_deg"] is not None:
                yield Stamped(utc_us, "/imu/data", "sensor_msgs/msg/Imu", self._imu(row))
            if row["speed_mps"] is not None:
                twist = self._twist(row["speed_mps"])
                stamped = self("geometry_msgs/TwistStamped", header=self.header(utc_us, "base_link"), twist=twist)
                yield Stamped(utc_us, "/vehicle/twist", "geometry_msgs/msg/TwistStamped", stamped)

    def _vector(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> object:
        return self("geometry_msgs/Vector3", x=x, y=y, z=z)

    def _twist(self, speed_mps: float) -> object:
        return self("geometry_msgs/Twist", linear=self._vector(x=float(speed_mps)), angular=self._vector())

    def _fix(self, row: Mapping[str, Any]) -> object:
        return self(
            "sensor_msgs/NavSatFix",
            header=self.header(row["utc_us"], "base_link"),
            status=self("sensor_msgs/NavSatStatus", status=0, service=1),
            latitude=row["lat_deg"],
            longitude=row["lon_deg"],
            altitude=math.nan if row["elevation_m"] is None else float(row["elevation_m"]),
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )

    def _imu(self, row: Mapping[str, Any]) -> object:
        half = math.radians(90 - row["heading_deg"]) / 2  # ROS counts from east, counter-clockwise
        turn = self("geometry_msgs/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        yaw_rate, accel = row.get("yaw_rate_degps"), row.get("accel_mps2")
        known, unknown = np.zeros(9), np.array([-1.0, *[0.0] * 8])
        return self(
            "sensor_msgs/Imu",
            header=self.header(row["utc_us"], "base_link"),
            orientation=turn,
            orientation_covariance=np.zeros(9),
            angular_velocity=self._vector(z=-math.radians(yaw_rate or 0.0)),
            angular_velocity_covariance=unknown if yaw_rate is None else known,
            linear_acceleration=self._vector(x=float(accel or 0.0)),
            linear_acceleration_covariance=unknown if accel is None else known,
        )

    def scan(self, utc_us: int, points_m: Singles) -> Stamped:
        """Make the point cloud of a scan, its beams numbered from the lowest."""
        points = np.zeros(len(points_m), POINT)
        points["x"], points["y"], points["z"] = points_m[:, 0], -points_m[:, 1], points_m[:, 2]
        elevation_deg = np.degrees(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
        elevation_deg = np.nan_to_num(elevation_deg)
        points["ring"] = np.clip(np.round((elevation_deg - LOWEST_RING_DEG) / RING_STEP_DEG), 0, RINGS - 1)
        kinds = {"<f4": 7, "<u2": 4}  # numbers of FLOAT32 and UINT16
        fields = [
            self("sensor_msgs/PointField", name=name, offset=int(place[1]), datatype=kinds[place[0].str], count=1)
            for name, place in (POINT.fields or {}).items()
        ]
        message = self(
            "sensor_msgs/PointCloud2",
            header=self.header(utc_us, FRAMES["lidar"]),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=POINT.itemsize * len(points),
            data=points.view(np.uint8).reshape(-1),
            is_dense=True,
        )
        return Stamped(utc_us, "/velodyne_points", "sensor_msgs/msg/PointCloud2", message)

    def image(self, image: Image) -> Stamped:
        """Make the detector's result for an image."""
        rows = zip(image.boxes_px.tolist(), image.scores.tolist(), image.classes, strict=True)
        header = self.header(image.utc_us, FRAMES["camera"])
        boxes = [self._detection(header, box, score, name) for box, score, name in rows]
        message = self("vision_msgs/Detection2DArray", header=header, detections=boxes)
        return Stamped(image.utc_us, "/camera/detections", "vision_msgs/msg/Detection2DArray", message)

    def _detection(self, header: object, box: list[float], score: float, name: str) -> object:
        left, top, width, height = box
        x, y = left + width / 2, top + height / 2
        if self._version == 1:
            center = self("geometry_msgs/Pose2D", x=x, y=y, theta=0.0)
            result: dict[str, object] = {"id": CLASS_NUMBERS.get(name, 0), "score": score}
            rest = {"source_img": self._no_image(header)}
        else:
            center = self("vision_msgs/Pose2D", position=self("vision_msgs/Point2D", x=x, y=y), theta=0.0)
            result = {"hypothesis": self("vision_msgs/ObjectHypothesis", class_id=name, score=score)}
            rest = {"id": ""}
        return self(
            "vision_msgs/Detection2D",
            header=header,
            results=[self("vision_msgs/ObjectHypothesisWithPose", pose=self._no_pose(), **result)],
            bbox=self("vision_msgs/BoundingBox2D", center=center, size_x=width, size_y=height),
            **rest,
        )

    def _no_pose(self) -> object:
        pose = self(
            "geometry_msgs/Pose",
            position=self("geometry_msgs/Point", x=0.0, y=0.0, z=0.0),
            orientation=self("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        return self("geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36))

    def _no_image(self, header: object) -> object:
        facts = {"height": 0, "width": 0, "encoding": "", "is_bigendian": 0, "step": 0}
        return self("sensor_msgs/Image", header=header, data=np.zeros(0, np.uint8), **facts)
