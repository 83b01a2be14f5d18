"""LiDAR scans from point clouds: returns above the ground and in reach, in the ego's frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.sources.v2v.bag_records import Record, RosMessage, decode, open_bag
from tracklake.pipeline.sources.v2v.mounts import Mount
from tracklake.schemas.arrays import Singles

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
"""Type of a scan."""
COORDINATES = ("x", "y", "z")
"""Names of the fields that are read of a point."""
FLOATS = {7: "f4", 8: "f8"}
"""Types of coordinates by their number in PointField."""
MIN_RANGE_M, MAX_RANGE_M = 0.5, 100.0
"""Least distance from the LiDAR, below which drivers put beams without a return, and greatest from the ego, in m."""
MAX_HEIGHT_M = 5.0
"""Greatest height in m above the ground: no vehicle is as high, bridges and trees are higher."""
GROUND_M, GROUND_SLOPE = 0.3, 0.005
"""Returns lower than this above the ground are the road's, in m, and how much that grows per m of distance, for roads
that rise and for a scanner that is not level. The least bumper is about as high."""


class Scan(NamedTuple):
    """Returns (P, 3) of a scan in the ego's frame, the scan's number in the drive, and its moment in us since 1970."""

    scan: int
    utc_us: int
    points_m: Singles


@dataclass
class Removed:
    """Returns that were left out, and why."""

    no_return: int = 0
    out_of_reach: int = 0
    ground: int = 0


@dataclass(frozen=True)
class Scans:
    """The scans of a drive, which are read again from their files each time that they are iterated.

    Args:
        files: files of the bag with scans.
        moments_us: moment of each cloud of each file, in their order; None for one that was rejected.
        topic: topic of the clouds.
        mount: place of the LiDAR; None where there are no scans.
        removed: counts of the returns left out, complete after an iteration.
    """

    files: Sequence[RawFile] = ()
    moments_us: Sequence[Sequence[int | None]] = ()
    topic: str = ""
    mount: Mount | None = None
    removed: Removed = field(default_factory=Removed)

    def describe_removed(self) -> tuple[str, ...]:
        """Tell which returns the last iteration left out, and why, in a note or none."""
        if not len(self):
            return ()
        own, topic = self.removed, f"{self.files[0].name}: {self.topic}"
        return (
            f"{topic}: LiDAR returns left out: {own.ground:,} of the road, {own.out_of_reach:,} beyond "
            f"{MAX_RANGE_M:g} m or above {MAX_HEIGHT_M:g} m, {own.no_return:,} points without a return",
        )

    def __len__(self) -> int:
        """Count the scans that are used."""
        return sum(moment is not None for moments in self.moments_us for moment in moments)

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans one by one."""
        self.removed.no_return = self.removed.out_of_reach = self.removed.ground = 0
        number = 0
        for file, moments in zip(self.files, self.moments_us, strict=True):
            if not any(moment is not None for moment in moments):
                continue
            with open_bag(file) as bag:
                records = bag.read({(self.topic, POINT_CLOUD)})
                for utc_us in moments:
                    points_m = self._read_next(file, records, bag.version, used=utc_us is not None)
                    if utc_us is not None:
                        yield Scan(number, utc_us, points_m)
                        number += 1

    def _read_next(self, file: RawFile, records: Iterator[Record], version: int, *, used: bool) -> Singles:
        """Read the returns of the next cloud; of one that is not used, none."""
        try:
            record = next(records)
            if not used or self.mount is None:
                return np.empty((0, 3), np.float32)
            return locate_returns(read_points(decode(record, version)), self.mount, self.removed)
        except (StopIteration, ValueError):
            raise SourceError(
                f"{file.name}: holds other scans than when it was first read. Expected a whole bag that stays as it "
                "is. Run the same command again."
            ) from None


def read_points(cloud: RosMessage) -> npt.NDArray[np.void]:
    """Return the points of a cloud as a view of its bytes, with the fields x, y and z.

    Raises:
        ValueError: its fields or lengths contradict each other.
    """
    fields = {each.name: each for each in cloud.fields}
    order = ">" if cloud.is_bigendian else "<"
    places = {}
    for name in COORDINATES:
        if name not in fields:
            raise ValueError(f"a point cloud without the field {name}, with {', '.join(sorted(fields)[:9])}")
        own = fields[name]
        if own.datatype not in FLOATS or own.count not in (0, 1):
            raise ValueError(f"field {name} of type {own.datatype} and count {own.count} instead of 7 or 8 and 1")
        places[name] = order + FLOATS[own.datatype], own.offset
    ends = [offset + np.dtype(kind).itemsize for kind, offset in places.values()]
    size, step, row = len(cloud.data), cloud.point_step, cloud.row_step
    if max(ends) > step:
        raise ValueError(f"fields that end at byte {max(ends):,} of points of {step:,} bytes")
    if cloud.width * cloud.height * step == size:
        row = cloud.width * step  # also where a driver leaves row_step at 0
    if row < cloud.width * step or row * cloud.height != size:
        raise ValueError(
            f"{cloud.width:,} x {cloud.height:,} points of {step:,} bytes, rows of {row:,}, but {size:,} bytes of data"
        )
    kinds, offsets = zip(*places.values(), strict=True)
    point = np.dtype({"names": COORDINATES, "formats": kinds, "offsets": offsets, "itemsize": step})
    if size == 0:
        return np.empty((0, 0), point)
    return np.ndarray((cloud.height, cloud.width), point, cloud.data, strides=(row, step))


def locate_returns(points: npt.NDArray[np.void], mount: Mount, removed: Removed) -> Singles:
    """Return the returns (P, 3) above the ground and in reach, in the ego's frame; count what is left out."""
    own = np.empty((3, points.size), np.float32)
    # Sizes that single precision cannot hold become infinite, which is beyond any reach.
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate(COORDINATES):
            own[axis] = points[name].ravel()
        seen = np.einsum("ij,ij->j", own, own) >= MIN_RANGE_M**2  # not for NaN
        place = np.array([[mount.x_m], [mount.y_m], [mount.z_m]], np.float32)
        if not np.array_equal(np.abs(mount.rotation), np.eye(3)):
            own = mount.rotation.astype(np.float32) @ own
        else:  # only signs change, which saves a third of the time
            own *= np.diag(mount.rotation).astype(np.float32)[:, None]
        own += place
        distance = np.hypot(own[0], own[1])
        near = seen & (distance <= MAX_RANGE_M) & (own[2] <= MAX_HEIGHT_M)
        kept = near & (own[2] >= GROUND_M + np.float32(GROUND_SLOPE) * distance)
    removed.no_return += int(points.size - seen.sum())
    removed.out_of_reach += int(seen.sum() - near.sum())
    removed.ground += int(near.sum() - kept.sum())
    return np.ascontiguousarray(own[:, kept].T)
