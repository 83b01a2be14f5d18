"""Bags of a virtual vehicle, read with the library's own reader and the definitions that are in the bag."""

from collections import Counter
from pathlib import Path
from typing import Any, Literal

import drive_bags
import numpy as np
import pytest
from rosbags.highlevel import AnyReader


@pytest.mark.parametrize(
    ("version", "options"),
    [
        (1, {}),
        (1, {"compressed": True}),
        (2, {}),
        (2, {"storage": "mcap"}),
        (2, {"compressed": True}),
    ],
)
def test_other_programs_read_every_message(tmp_path: Path, version: Literal[1, 2], options: dict[str, Any]) -> None:
    """The bag carries its definitions; units, axes and angles are those of ROS."""
    path = drive_bags.write_small_bag(tmp_path / ("small.bag" if version == 1 else "small"), version, **options)
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(raw, connection.msgtype))

    assert Counter({topic: len(messages) for topic, messages in found.items()}) == {
        "/tracklake/origin": 1,
        "/tf_static": 1,
        "/camera/camera_info": 1,
        "/gps/fix": 3,
        "/imu/data": 3,
        "/vehicle/twist": 3,
        "/velodyne_points": 2,
        "/camera/detections": 2,
        "/v2v/messages": 1,
    }
    assert list(tmp_path.iterdir()) == [path]
    cloud = found["/velodyne_points"][0]
    points = np.ndarray(cloud.width, "<f4", cloud.data.tobytes(), cloud.fields[1].offset, cloud.point_step)
    assert points.tolist() == [-2.0, 3.0, 0.0]  # left is positive
    turn = found["/imu/data"][1].orientation
    assert np.degrees(2 * np.arctan2(turn.z, turn.w)) == pytest.approx(90)  # north
    assert found["/imu/data"][1].angular_velocity.z == pytest.approx(np.radians(-2))
    lidar, camera = found["/tf_static"][0].transforms
    assert (lidar.transform.translation.y, camera.transform.translation.y) == (-0.1, 0.2)
    first = found["/camera/detections"][0].detections[0]
    center = first.bbox.center if version == 1 else first.bbox.center.position
    assert (center.x, center.y, first.bbox.size_x, first.bbox.size_y) == (125, 220, 50, 40)
    assert (first.results[0].id if version == 1 else first.results[0].hypothesis.class_id) in (3, "car")
    assert found["/gps/fix"][2].header.stamp.nanosec == 200_000_000
    assert "synthetic" in found["/tracklake/origin"][0].data
