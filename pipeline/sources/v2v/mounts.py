"""Places of sensors on a vehicle, from the static transforms in a bag."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.sources.v2v.bag_records import RosMessage
from tracklake.schemas.arrays import Floats

BASE_FRAMES = ("base_footprint", "base_link", "ego_vehicle")
"""Names of the vehicle's own frame, the first preferred; its origin counts as the ego's centre on the ground."""
TO_RIGHT = np.diag([1.0, -1.0, 1.0])
"""Turns the axes of ROS (x ahead, y to the left, z up) into those of the ego's frame, where y is to the right."""


@dataclass(frozen=True)
class Mount:
    """Place of a sensor in the ego's frame in m, and the rotation (3, 3) of the sensor's axes into the ego's."""

    x_m: float
    y_m: float
    z_m: float
    rotation: Floats


def read_transforms(message: RosMessage) -> list[tuple[str, str, Floats]]:
    """Return parent frame, child frame and matrix (4, 4) from child to parent of each transform in a message.

    Raises:
        ValueError: a rotation is no unit quaternion, or a number is not finite.
    """
    found = []
    for each in message.transforms:
        place, turn = each.transform.translation, each.transform.rotation
        matrix = np.eye(4)
        matrix[:3, :3] = make_rotation(turn.x, turn.y, turn.z, turn.w)
        matrix[:3, 3] = place.x, place.y, place.z
        if not np.isfinite(matrix).all():
            raise ValueError(f"transform of {each.child_frame_id} is not finite")
        found.append((_normalize(each.header.frame_id), _normalize(each.child_frame_id), matrix))
    return found


def make_rotation(x: float, y: float, z: float, w: float) -> Floats:
    """Return the rotation matrix (3, 3) of a quaternion.

    Raises:
        ValueError: its norm is not about 1, as in messages without an orientation.
    """
    norm = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not 0.9 < norm < 1.1:
        raise ValueError(f"orientation of norm {norm:.3g} instead of 1")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def find_mount(frame: str, transforms: Iterable[tuple[str, str, Floats]]) -> Mount | None:
    """Return the place of a frame on the vehicle, over any number of transforms; None where none leads to it."""
    edges: dict[str, dict[str, Floats]] = {}
    for parent, child, matrix in transforms:
        edges.setdefault(parent, {})[child] = matrix
        edges.setdefault(child, {})[parent] = np.linalg.inv(matrix).astype(np.float64)
    frame = _normalize(frame)
    base = next((known for name in BASE_FRAMES for known in (frame, *sorted(edges)) if _is_named(known, name)), None)
    found = None if base is None else _follow(edges, base, frame)
    if found is None:
        return None
    x_m, y_m, z_m = (TO_RIGHT @ found[:3, 3]).tolist()
    return Mount(x_m, y_m, z_m, TO_RIGHT @ found[:3, :3])


def _follow(edges: Mapping[str, Mapping[str, Floats]], base: str, frame: str) -> Floats | None:
    """Return the matrix from a frame to the base by the fewest transforms, or None where none lead there."""
    reached: dict[str, Floats] = {base: np.eye(4)}
    waiting = [base]
    for name in waiting:
        for other, matrix in edges.get(name, {}).items():
            if other not in reached:
                reached[other] = reached[name] @ matrix
                waiting.append(other)
    return reached.get(frame)


def _normalize(frame: str) -> str:
    return frame.strip("/")


def _is_named(frame: str, name: str) -> bool:
    """Tell whether a frame has a name, whatever vehicle it is prefixed by."""
    return frame.rpartition("/")[2] == name
