"""Point clouds in any layout against a loop that unpacks one number after the other."""

import math
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.sources.v2v.mounts import Mount, find_mount, make_rotation
from tracklake.pipeline.sources.v2v.point_clouds import Removed, Scans, locate_returns, read_points

LEVEL = Mount(0.5, -0.25, 2.0, np.diag([1.0, -1.0, 1.0]))
"""A LiDAR without a turn; y is to the left for the sensor and to the right for the ego."""
COORDINATE = st.one_of(
    st.floats(-8, 8, width=32),
    st.floats(-150, 150, width=32),
    st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 3e38]),
)


@st.composite
def clouds(draw: st.DrawFn) -> tuple[Any, list[tuple[float, float, float]]]:
    """Draw a cloud, and its points."""
    height, width = draw(st.integers(0, 3)), draw(st.integers(0, 4))
    kinds = [draw(st.sampled_from([7, 8])) for _ in "xyz"]
    gaps = [draw(st.integers(0, 5)) for _ in range(4)]
    order = draw(st.sampled_from("<>"))
    offsets, at = [], 0
    for kind, gap in zip(kinds, gaps, strict=False):
        offsets.append(at + gap)
        at += gap + (4 if kind == 7 else 8)
    step, padding = at + gaps[3], draw(st.integers(0, 9))
    row = width * step + padding
    data = bytearray(draw(st.binary(min_size=row * height, max_size=row * height)))
    points = []
    for line in range(height):
        for column in range(width):
            point = tuple(draw(COORDINATE) for _ in "xyz")
            for value, kind, offset in zip(point, kinds, offsets, strict=True):
                struct.pack_into(order + " fd"[kind - 6], data, line * row + column * step + offset, value)
            points.append(point)
    names = zip("xyz", kinds, offsets, strict=True)
    fields = [SimpleNamespace(name=name, datatype=kind, offset=offset, count=1) for name, kind, offset in names]
    cloud = SimpleNamespace(
        fields=draw(st.permutations(fields)),
        height=height,
        width=width,
        is_bigendian=order == ">",
        point_step=step,
        row_step=row,
        data=np.frombuffer(bytes(data), np.uint8),
    )
    return cloud, points


def locate_slowly(points: list[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Keep returns over 0.5 m from the LiDAR, up to 100 m from the ego, over a road that may rise, up to 5 m high."""
    kept = []
    for x, y, z in points:
        if not all(map(math.isfinite, (x, y, z))) or math.dist((0, 0, 0), (x, y, z)) < 0.5:
            continue
        ahead, right, up = x + 0.5, -y - 0.25, z + 2.0
        if math.hypot(ahead, right) <= 100 and 0.3 + 0.005 * math.hypot(ahead, right) <= up <= 5:
            kept.append((ahead, right, up))
    return kept


@settings(max_examples=50, deadline=None)
@given(clouds())
def test_points_of_any_layout_are_those_of_a_loop(drawn: tuple[Any, list[tuple[float, float, float]]]) -> None:
    cloud, points = drawn
    removed = Removed()
    found = locate_returns(read_points(cloud), LEVEL, removed)
    np.testing.assert_allclose(found, np.array(locate_slowly(points), np.float32).reshape(-1, 3), rtol=1e-5, atol=1e-5)
    assert len(found) + removed.no_return + removed.out_of_reach + removed.ground == len(points)


def make_cloud(**changes: Any) -> Any:
    """Make a cloud of one point at the origin."""
    fields = [SimpleNamespace(name=name, datatype=7, offset=4 * at, count=1) for at, name in enumerate("xyz")]
    values = {"fields": fields, "height": 1, "width": 1, "is_bigendian": False, "point_step": 12, "row_step": 12}
    return SimpleNamespace(**(values | {"data": np.zeros(12, np.uint8)} | changes))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 2**32 - 1}, "4,294,967,295 x 1 points of 12 bytes, rows of 12, but 12 bytes of data"),
        ({"height": 2}, "1 x 2 points of 12 bytes"),
        ({"row_step": 11, "data": np.zeros(11, np.uint8)}, "rows of 11"),
        ({"point_step": 11}, "end at byte 12 of points of 11 bytes"),
        ({"point_step": 0}, "end at byte 12 of points of 0 bytes"),
        ({"fields": make_cloud().fields[:2]}, "without the field z, with x, y"),
        ({"fields": []}, "without the field x"),
        ({"fields": [SimpleNamespace(name=name, datatype=4, offset=0, count=1) for name in "xyz"]}, "x of type 4"),
        ({"fields": [SimpleNamespace(name=name, datatype=7, offset=0, count=3) for name in "xyz"]}, "count 3"),
        (
            {"fields": [SimpleNamespace(name=name, datatype=7, offset=2**32 - 1, count=1) for name in "xyz"]},
            "4,294,967",
        ),
    ],
)
def test_clouds_that_contradict_themselves_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        read_points(make_cloud(**changes))


def test_a_row_step_that_a_driver_left_at_zero_does_no_harm() -> None:
    assert read_points(make_cloud(row_step=0)).shape == (1, 1)
    assert read_points(make_cloud(width=0, row_step=0, data=np.zeros(0, np.uint8))).size == 0


def test_a_file_that_changed_since_it_was_read_is_refused(tmp_path: Any) -> None:
    """One scan less than at first."""
    import drive_bags

    path = drive_bags.write_small_bag(tmp_path / "a.bag", scans=iter(drive_bags.SCANS[:1]))
    scans = Scans((RawFile(path, "a.bag"),), ((1, 2),), "/velodyne_points", LEVEL)
    with pytest.raises(SourceError, match=r"a\.bag: holds other scans than when it was first read"):
        list(scans)


def make_step(x: float, yaw_deg: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Make a transform by x along the parent's axis and a turn to the left."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    matrix[:3, :3] = make_rotation(0, 0, math.sin(math.radians(yaw_deg) / 2), math.cos(math.radians(yaw_deg) / 2))
    return matrix


def test_mounts_follow_transforms_in_both_directions_and_end_in_circles() -> None:
    chain = [
        ("ego/base_link", "ego/rack", make_step(1.0, 180)),
        ("ego/lidar", "ego/rack", make_step(3.0)),  # the rack lies 3 m ahead of the LiDAR, which looks back
        ("ego/rack", "ego/base_link", make_step(1.0, 180)),
    ]
    mount = find_mount("/ego/lidar", chain)
    assert mount is not None
    assert (mount.x_m, mount.z_m) == (pytest.approx(4.0), 0.0)
    assert find_mount("elsewhere", chain) is None
    assert find_mount("lidar", []) is None
    own = find_mount("base_link", [])
    assert own is not None
    assert (own.x_m, own.y_m, own.z_m) == (0, 0, 0)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 9.0)])
def test_a_rotation_without_a_direction_is_refused(turn: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="orientation of norm"):
        make_rotation(*turn)
