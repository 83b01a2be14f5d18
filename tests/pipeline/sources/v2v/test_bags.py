"""ROS bags: what is read of each type of message, whose clock counts, and the account of every message."""

from pathlib import Path
from typing import Any, Literal

import drive_bags
import numpy as np
import polars as pl
import pyarrow as pa
import pymap3d
import pytest
from drive_bags import EGO, START_US, list_files, write_messages, write_small_bag
from polars.testing import assert_frame_equal

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.bags import BagContents, is_bag, read_bag
from tracklake.pipeline.synthetic.onboard.bag_files import MessageMaker, make_store

MAKE = MessageMaker(make_store(1), 1)


@pytest.mark.parametrize(
    ("version", "options"),
    [
        (1, {}),
        (1, {"compressed": True}),
        (2, {}),
        (2, {"storage": "mcap"}),
        (2, {"compressed": True}),
        (2, {"storage": "mcap", "compressed": True}),
    ],
)
def test_what_was_written_is_read(tmp_path: Path, version: Literal[1, 2], options: dict[str, Any]) -> None:
    """Axes, angles and units come back as those of the tables, whatever the format."""
    folder = tmp_path / "50 % ?mode=rw#"  # no part of it is one of a URI
    folder.mkdir()
    name = "a.bag" if version == 1 else "a"
    files = list_files(write_small_bag(tmp_path / name, version, **options).rename(folder / name))
    bag = read_bag(files)

    assert_frame_equal(bag.ego.select(EGO.columns), EGO, check_dtypes=False, rel_tol=1e-6)
    assert bag.detections.drop("class").rows() == [
        (START_US + 50_000, 0, 100, 200, 50, 40, 0.75),
        (START_US + 50_000, 1, 0, 10, 20, 30, 0.5),
    ]
    assert bag.detections["class"].to_list() == (["3", "8"] if version == 1 else ["car", "truck"])
    assert (bag.images_us - START_US).tolist() == [50_000, 150_000]
    assert bag.camera == (1000, 1100, 960, 540)
    assert bag.camera_mount is not None
    assert bag.scans.mount is not None
    assert (bag.camera_mount.x_m, bag.camera_mount.y_m, bag.camera_mount.z_m) == (1.0, -0.2, 1.4)
    assert (bag.scans.mount.x_m, bag.scans.mount.y_m, bag.scans.mount.z_m) == (0.5, 0.1, 1.9)
    assert bag.texts.rows() == []
    assert bag.rejects.is_empty()
    assert [count for count in bag.rows_read if count] == [17]
    assert bag.synthetic
    assert bag.notes == (f"{', '.join(file.name for file in files)}: not read, by type of message: "
                         "1 std_msgs/msg/String without anything to use",)  # fmt: skip
    # The LiDAR stands 0.5 m ahead, 0.1 m to the right, 1.9 m high; the third return is the road, the fourth 250 m away.
    first, second = bag.scans
    np.testing.assert_allclose(first.points_m, [[10.5, 2.1, 0.9], [5.5, -2.9, 2.4]], atol=1e-6)
    assert (first.scan, first.utc_us, second.scan, second.points_m.shape) == (0, START_US + 10_000, 1, (0, 3))
    removed = bag.scans.removed
    assert (len(bag.scans), removed.no_return, removed.out_of_reach, removed.ground) == (2, 0, 1, 1)


def test_a_file_that_is_compressed_as_a_whole_is_read(tmp_path: Path) -> None:
    """ROS 2 names it after the file that it holds."""
    (plain,) = [file for file in list_files(write_small_bag(tmp_path / "a", 2)) if file.path.suffix == ".db3"]
    packed = RawFile(tmp_path / "a.db3.zstd", "a.db3.zstd")
    with pa.CompressedOutputStream(str(packed.path), "zstd") as stream:
        stream.write(plain.path.read_bytes())
    assert is_bag(packed.path.read_bytes()[:4096], packed.name)
    bag = read_bag([packed])
    assert (bag.ego.height, bag.rows_read, len(list(bag.scans))) == (3, (17,), 2)
    (note,) = bag.scans.describe_removed()
    assert note.endswith("left out: 1 of the road, 1 beyond 100 m or above 5 m, 0 points without a return")


def test_each_file_of_a_bag_is_recognised(tmp_path: Path) -> None:
    for path in (write_small_bag(tmp_path / "a.bag"), write_small_bag(tmp_path / "b", 2)):
        for file in list_files(path):
            assert is_bag(file.path.read_bytes()[:4096], file.name) == (file.path.suffix != ".yaml")
    assert not is_bag(b"", "a.bag")


def make_fix(utc_us: int = START_US, lat: float = 40.0, lon: float = -83.0, status: int = 0, frame: str = "gps") -> Any:
    """Make a fix of the receiver; a moment of 0 is an empty stamp."""
    return MAKE(
        "sensor_msgs/NavSatFix",
        header=MAKE.header(utc_us, frame),
        status=MAKE("sensor_msgs/NavSatStatus", status=status, service=1),
        latitude=lat,
        longitude=lon,
        altitude=float("nan"),
        position_covariance=np.zeros(9),
        position_covariance_type=0,
    )


def make_turn(degrees: float, utc_us: int) -> Any:
    """Make a heading, in degrees from east and counter-clockwise."""
    half = np.radians(degrees) / 2
    turn = MAKE("geometry_msgs/Quaternion", x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))
    return MAKE("geometry_msgs/QuaternionStamped", header=MAKE.header(utc_us, "base_link"), quaternion=turn)


def make_transform(parent: str, child: str, place: tuple[float, float, float], yaw_deg: float = 0.0) -> Any:
    """Make the place of a frame in its parent."""
    turn = make_turn(yaw_deg, START_US).quaternion
    return MAKE(
        "geometry_msgs/TransformStamped",
        header=MAKE.header(START_US, parent),
        child_frame_id=child,
        transform=MAKE(
            "geometry_msgs/Transform",
            translation=MAKE("geometry_msgs/Vector3", x=place[0], y=place[1], z=place[2]),
            rotation=turn,
        ),
    )


def make_transforms(*transforms: Any) -> Any:
    """Make a message of transforms."""
    return MAKE("tf2_msgs/TFMessage", transforms=list(transforms))


def read_messages(tmp_path: Path, *messages: tuple[str, str, int, Any]) -> BagContents:
    """Read a bag with these messages alone."""
    return read_bag(list_files(write_messages(tmp_path / "a.bag", messages)))


FIX, TF, HEADING = "sensor_msgs/NavSatFix", "tf2_msgs/TFMessage", "geometry_msgs/QuaternionStamped"


def test_fixes_that_cannot_be_used_are_rejected_with_their_place(tmp_path: Path) -> None:
    bag = read_messages(
        tmp_path,
        ("/fix", FIX, 0, make_fix()),
        ("/fix", FIX, 1_000_000, make_fix(START_US + 1_000_000, status=-1)),
        ("/fix", FIX, 2_000_000, make_fix(START_US + 2_000_000, lat=float("nan"))),
        ("/fix", FIX, 3_000_000, make_fix(START_US + 3_000_000, lat=0.0, lon=0.0)),
        ("/fix", FIX, 4_000_000, make_fix(START_US)),
        ("/fix", FIX, 5_000_000, make_fix(START_US + 5_000_000, lon=181.0)),
    )
    assert bag.ego["utc_us"].to_list() == [START_US]
    assert bag.ego["elevation_m"].to_list() == bag.ego["heading_deg"].to_list() == [None]
    assert bag.rejects.sort("line")["line", "reason"].rows() == [
        (2, "no satellite fix"),
        (3, "position outside -84 to 80 degrees of latitude or 180 of longitude"),
        (4, "position (0, 0)"),
        (5, "the moment of another message of its topic"),
        (6, "position outside -84 to 80 degrees of latitude or 180 of longitude"),
    ]
    assert bag.rejects["text"][0].startswith("/fix (sensor_msgs/msg/NavSatFix) at 2023-11-14 22:13:21")
    assert bag.rows_read == (6,)


def test_the_time_of_the_bag_counts_where_a_stamp_is_no_utc_time(tmp_path: Path) -> None:
    """A stamp of 0, or the seconds since a sensor was switched on, are no moments of a drive."""
    bag = read_messages(
        tmp_path,
        ("/fix", FIX, 0, make_fix(0)),
        ("/fix", FIX, 100_000, make_fix(17_000_000)),
        ("/fix", FIX, 200_000, make_fix(START_US + 50_000)),
    )
    assert (bag.ego["utc_us"] - START_US).to_list() == [0, 50_000, 100_000]
    assert bag.notes == (
        "a.bag: /fix: steps of its clock backwards: 1",
        "a.bag: /fix: stamps that are no UTC times, so that the bag's times count: 2",
    )


def test_one_wrong_time_does_not_stretch_a_drive(tmp_path: Path) -> None:
    """The bag's time is a day late, too: a recorder's clock that was set while it recorded."""
    day_us = 86_400_000_000
    bag = read_messages(
        tmp_path,
        ("/tf_static", TF, 0, make_transforms(make_transform("base_link", "lidar", (0.0, 0.0, 2.0)))),
        ("/fix", FIX, 0, make_fix()),
        ("/points", CLOUD, 0, make_cloud("lidar")),
        ("/fix", FIX, day_us, make_fix(START_US + day_us)),
        ("/points", CLOUD, day_us, make_cloud("lidar", header=MAKE.header(START_US + day_us, "lidar"))),
    )
    assert bag.ego["utc_us"].to_list() == [START_US]
    assert [scan.utc_us for scan in bag.scans] == [START_US]
    assert bag.rejects["line", "reason"].sort("line").rows() == [
        (line, "a day or more from the other messages of the bag") for line in (4, 5)
    ]


def test_heading_is_interpolated_over_north_to_the_moment_of_a_fix(tmp_path: Path) -> None:
    """91 and 89 degrees from east are 359 and 1 from north; halfway is north. Beyond half a second it is unknown."""
    bag = read_messages(
        tmp_path,
        ("/q", HEADING, 0, make_turn(91, START_US)),
        ("/fix", FIX, 50_000, make_fix(START_US + 50_000)),
        ("/q", HEADING, 100_000, make_turn(89, START_US + 100_000)),
        ("/fix", FIX, 700_000, make_fix(START_US + 700_000)),
    )
    first, second = bag.ego["heading_deg"]
    assert (first + 180) % 360 == pytest.approx(180, abs=1e-4)
    assert second is None


@pytest.mark.parametrize("w", [0.0, 1.0])
def test_an_orientation_that_was_never_set_is_no_heading(tmp_path: Path, w: float) -> None:
    """Imu of a driver without one: not a car that always heads east, and its turning is read all the same."""
    turn = MAKE("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=w)
    vectors = [MAKE("geometry_msgs/Vector3", x=0.0, y=0.0, z=z) for z in (0.1, 9.81)]
    imu = MAKE(
        "sensor_msgs/Imu", header=MAKE.header(START_US, "imu"), orientation=turn, orientation_covariance=np.zeros(9),
        angular_velocity=vectors[0], angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vectors[1], linear_acceleration_covariance=np.zeros(9),
    )  # fmt: skip
    bag = read_messages(tmp_path, ("/fix", FIX, 0, make_fix()), ("/imu", "sensor_msgs/Imu", 0, imu))
    assert bag.ego.select("heading_deg", "yaw_rate_degps").rows() == [(None, pytest.approx(-5.7296, abs=1e-4))]
    assert bag.rejects.is_empty()


HEX_IN_JSON = '{"payload": {"data": {"bytes": "001425AB"}}}'


@pytest.mark.parametrize("text", [" " * 1_000_000, " " * 1_000_000 + "!", "0014" * 250_000 + "!"])
def test_long_texts_are_judged_at_once(tmp_path: Path, text: str) -> None:
    """By backtracking, these took hours."""
    bag = read_messages(tmp_path, ("/say", "std_msgs/String", 0, MAKE("std_msgs/String", data=text)))
    assert bag.texts.is_empty()
    assert "1 std_msgs/msg/String without anything to use" in bag.notes[0]


def test_topics_are_chosen_by_type_and_number_and_the_others_named(tmp_path: Path) -> None:
    """A heading in degrees is preferred to one of an orientation; other numbers and texts are not read."""
    number = MAKE("std_msgs/Float64", data=370.0)
    bag = read_messages(
        tmp_path,
        ("/gps/heading", "std_msgs/Float64", 0, number),
        ("/temperature", "std_msgs/Float64", 0, number),
        ("/q", HEADING, 0, make_turn(91, START_US)),
        ("/a", FIX, 0, make_fix(lat=41.0)),
        ("/b", FIX, 0, make_fix()),
        ("/b", FIX, 100_000, make_fix(START_US + 100_000)),
        ("/say", "std_msgs/String", 0, MAKE("std_msgs/String", data='{"battery": 12}')),
        ("/v2v", "std_msgs/String", 0, MAKE("std_msgs/String", data=' {"coreData":\n {}} ')),
        ("/v2v", "std_msgs/String", 0, MAKE("std_msgs/String", data="0014 25AB")),
        ("/v2v", "std_msgs/String", 0, MAKE("std_msgs/String", data=HEX_IN_JSON)),
        ("/tf", TF, 0, make_transforms()),
    )
    assert bag.ego["lat_deg"].to_list() == [40.0, 40.0]
    assert bag.ego["heading_deg"].to_list() == [10.0, 10.0]
    texts = ['{"coreData": {}}', "0014 25AB", HEX_IN_JSON]
    assert bag.texts.select("received_us", "text").rows() == [(START_US, text) for text in texts]
    assert bag.notes == (
        "a.bag: not read, by type of message: 1 std_msgs/msg/Float64, 1 std_msgs/msg/String without anything to use, "
        "1 tf2_msgs/msg/TFMessage",
        "a.bag: fix is taken from /b; not used: /a (1)",
        "a.bag: heading is taken from /gps/heading; not used: /q (1)",
    )
    assert not bag.synthetic


def make_cloud(frame: str, **changes: Any) -> Any:
    """Make a cloud of two points, (4, 1, 1) and (NaN, 0, 0): x and y in single, z in double precision."""
    points = np.array(
        [(4.0, 1.0, 1.0), (np.nan, 0.0, 0.0)],
        np.dtype({"names": ["x", "y", "z"], "formats": ["<f4", "<f4", "<f8"], "offsets": [0, 4, 10], "itemsize": 20}),
    )
    fields = [
        MAKE("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in (("x", 0, 7), ("y", 4, 7), ("z", 10, 8))
    ]
    values = {"height": 1, "width": 2, "fields": fields, "is_bigendian": False, "point_step": 20, "row_step": 40}
    values |= {"data": points.view(np.uint8), "is_dense": False, "header": MAKE.header(START_US, frame)}
    return MAKE("sensor_msgs/PointCloud2", **(values | changes))


CLOUD = "sensor_msgs/PointCloud2"


def test_points_are_carried_over_every_hop_to_the_vehicle(tmp_path: Path) -> None:
    """The rack stands 1 m ahead, turned left by 90 degrees; the LiDAR 2 m higher and 0.5 m to the rack's left."""
    rack = make_transform("base_link", "rack", (1.0, 0.0, 0.0), yaw_deg=90)
    lidar = make_transform("rack", "lidar", (0.0, 0.5, 2.0))
    ground = make_transform("base_link", "base_footprint", (0.0, 0.0, -0.3))
    bag = read_messages(
        tmp_path,
        ("/tf_static", TF, 0, make_transforms(lidar, ground)),
        ("/tf_static", TF, 0, make_transforms(rack)),
        ("/points", CLOUD, 0, make_cloud("lidar")),
        ("/points", CLOUD, 0, make_cloud("other")),
        ("/points", CLOUD, 0, make_cloud("lidar", width=3)),
        ("/points", CLOUD, 100_000, make_cloud("/lidar")),
    )
    # From the rack: (4, 1.5, 3); turned left: (-1.5, 4, 3); from base_link (-0.5, 4), the ground 0.3 m lower.
    (first,) = bag.scans
    np.testing.assert_allclose(first.points_m, [[-0.5, -4.0, 3.3]], atol=1e-6)
    assert bag.scans.removed.no_return == 1
    assert bag.rejects.sort("line")["line", "reason"].rows() == [
        (4, "frame 'other' instead of 'lidar'"),
        (5, "3 x 1 points of 20 bytes, rows of 40, but 40 bytes of data"),
        (6, "frame '/lidar' instead of 'lidar'"),
    ]


def test_scans_without_a_known_place_are_rejected(tmp_path: Path) -> None:
    bag = read_messages(tmp_path, ("/points", CLOUD, 0, make_cloud("lidar")))
    assert (len(bag.scans), list(bag.scans), bag.scans.mount) == (0, [], None)
    assert bag.rejects["reason"].to_list() == [
        "frame 'lidar': no static transform (/tf_static) leads from it to base_link"
    ]


def test_positions_are_moved_from_the_antenna_to_the_centre_of_the_vehicle(tmp_path: Path) -> None:
    """The antenna is 2 m ahead and 1 m to the right of the centre of a vehicle that heads for 30 degrees."""
    bag = read_messages(
        tmp_path,
        ("/tf_static", TF, 0, make_transforms(make_transform("base_link", "gps", (2.0, -1.0, 1.5)))),
        ("/fix", FIX, 0, make_fix()),
        ("/q", HEADING, 0, make_turn(60, START_US)),
    )
    east_m = 2 * np.sin(np.radians(30)) + np.cos(np.radians(30))
    north_m = 2 * np.cos(np.radians(30)) - np.sin(np.radians(30))
    lat_deg, lon_deg, _ = pymap3d.enu2geodetic(-east_m, -north_m, 0, 40.0, -83.0, 0.0)
    assert bag.ego["lat_deg"][0] == pytest.approx(lat_deg, abs=1e-8)
    assert bag.ego["lon_deg"][0] == pytest.approx(lon_deg, abs=1e-8)


def test_boxes_of_older_layouts_are_read(tmp_path: Path) -> None:
    """Since vision_msgs 3.0 a box has an id at its end; ROS 2 before had the image, and whether it was tracked."""
    make = MessageMaker(make_store(2), 2)
    store = make_store(2)
    from rosbags.typesys import get_types_from_msg

    store.register(get_types_from_msg("float64 x\nfloat64 y\nfloat64 theta\nfloat64 w\nfloat64 h", "old/msg/Box"))
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nold/Box bbox\n"
            "sensor_msgs/Image source_img\nbool is_tracking\nstring tracking_id",
            "old/msg/Detection2D",
        )
    )
    store.register(get_types_from_msg("std_msgs/Header header\nold/Detection2D[] detections", "old/msg/Array"))
    old = MessageMaker(store, 2)
    new = make.image(drive_bags.IMAGES[0]).message
    detections = [
        old("old/Detection2D", header=each.header, results=each.results, is_tracking=True, tracking_id="7",
            source_img=old._no_image(each.header),
            bbox=old("old/Box", x=50.0, y=40.0, theta=0.0, w=20.0, h=10.0))
        for each in new.detections
    ]  # fmt: skip
    from rosbags import rosbag2

    with rosbag2.Writer(tmp_path / "a", version=8) as writer:
        connection = writer.add_connection("/boxes", "vision_msgs/msg/Detection2DArray", typestore=store)
        message = old("old/Array", header=new.header, detections=detections)
        writer.write(connection, new.header.stamp.sec * 10**9, store.serialize_cdr(message, "old/msg/Array"))
    bag = read_bag(list_files(tmp_path / "a"))
    assert bag.rejects.is_empty()
    assert bag.detections.select(pl.exclude("utc_us")).rows() == [
        (0, 40.0, 35.0, 20.0, 10.0, 0.75, "car"),
        (1, 40.0, 35.0, 20.0, 10.0, 0.5, "truck"),
    ]


def test_a_second_copy_of_a_bag_adds_nothing(tmp_path: Path) -> None:
    """The same drive as ROS recorded it and as it was converted: each scan, fix and image counts once."""
    once = list_files(write_small_bag(tmp_path / "a.bag", 1))
    bag = read_bag([*once, *list_files(write_small_bag(tmp_path / "b", 2))])
    assert ([scan.scan for scan in bag.scans], bag.ego.height, len(bag.images_us)) == ([0, 1], 3, 2)
    again = bag.rejects.filter(pl.col("reason") == "the moment of another message of its topic")
    assert (again["file_index"].to_list(), again.height) == ([1] * 7, bag.rejects.height)
