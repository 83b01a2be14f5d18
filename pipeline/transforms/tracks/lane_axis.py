"""A carriageway's axis, fitted to points of its lanes where no headings are known."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tracks.axes import STEP_M, Axis, draw_axis
from tracklake.schemas.arrays import Floats

NODE_M = 25.0
"""Distance between the nodes of an axis that is fitted, in m."""
CELL_M = 5.0
"""Length of the cells of a lane whose points count as one, in m."""
SMOOTHNESS = 30.0
"""Weight of changes of the axis's curvature against the distances to its points: waves of 280 m are halved."""
LEAST_WEIGHT = 1e-4
"""Weight of slopes against the distances to the points."""
FITS = 4
"""Number of fits: the first to the lane with most points, each other to all lanes, moved onto that one."""
NO_LANE = -32_768
"""Number that stands for no lane in arrays."""
Vector = tuple[float, float]


def fit_lane_axis(points: pl.DataFrame, direction: Vector) -> Axis:
    """Fit an axis along the lane with most points, by least squares; other lanes run beside it.

    The road turns by less than a right angle from the direction.

    Args:
        points: x, y in m, y to the left of x, and lane (numbers that only tell lanes apart, or null).
        direction: direction of travel, roughly.
    """
    norm = float(np.hypot(*direction))
    unit = (direction[0] / norm, direction[1] / norm)
    along, right = _turn(points["x"].to_numpy(), points["y"].to_numpy(), unit)
    cells = (
        pl.DataFrame({"along": along, "right": right, "lane": points["lane"].fill_null(NO_LANE)})
        .group_by("lane", cell=(pl.col("along") / CELL_M).floor())
        .agg(pl.col("along", "right").median(), pl.len())
        .sort("lane", "cell")
    )
    main = cells.group_by("lane").agg(pl.col("len").sum()).sort("len", "lane", descending=True)["lane"][0]
    lane = cells["lane"].to_numpy()
    # A line is its own mirror image: turned twice, a point is where it was.
    x, y = _turn(cells["along"].to_numpy(), cells["right"].to_numpy(), unit)
    first_m, nodes = float(along.min()), max(2, int(np.ceil(np.ptp(along) / NODE_M)) + 1)
    used, beside_m, angle = lane == main, np.zeros(len(lane)), np.zeros(len(lane))
    for _ in range(FITS):
        along, right = _turn(x - beside_m * np.sin(angle), y + beside_m * np.cos(angle), unit)
        axis = _draw(unit, first_m, _fit_offsets(along[used] - first_m, right[used], nodes))
        places = axis.project(x, y)
        used, angle = np.ones(len(lane), np.bool_), places.angle_rad
        for one in np.unique(lane[lane != main]):
            beside_m[lane == one] = np.median(places.right_m[lane == one])
    return axis


def find_direction(dx: Floats, dy: Floats) -> Vector:
    """Find the line along which vehicles went, by how far each came: a unit vector; (1, 0) where none moved."""
    moments = np.array([[dx @ dx, dx @ dy], [dx @ dy, dy @ dy]])
    if not moments.any():
        return 1.0, 0.0
    x, y = np.linalg.eigh(moments)[1][:, 1]
    return float(x), float(y)


def _turn(x: Floats, y: Floats, direction: Vector) -> tuple[Floats, Floats]:
    """Return the places of points on a line through the origin, and their distances to its right."""
    return x * direction[0] + y * direction[1], x * direction[1] - y * direction[0]


def _draw(direction: Vector, first_m: float, offset_m: Floats) -> Axis:
    """Draw the axis through nodes, given by their offsets to the right of a line; slopes change evenly between them."""
    node_m = NODE_M * np.arange(len(offset_m))
    slopes: Floats = np.gradient(offset_m, NODE_M, edge_order=2 if len(offset_m) > 2 else 1)
    at = np.arange(0.0, node_m[-1] + STEP_M, STEP_M)
    slope = np.interp(at, node_m, slopes)
    offset = np.concatenate([[0.0], np.cumsum(slope[1:] + slope[:-1]) * STEP_M / 2])
    offset += np.interp(at, node_m, offset_m - np.interp(node_m, at, offset))
    axis = draw_axis(*_turn(at + first_m, offset, direction))
    assert axis is not None  # two nodes are apart
    return axis


def _fit_offsets(along_m: Floats, right_m: Floats, nodes: int) -> Floats:
    """Fit the offsets of the axis's nodes to points, by their places on the line behind the first node."""
    along, row = along_m / NODE_M, np.arange(len(along_m))
    node = np.clip(along.astype(np.int64), 0, nodes - 2)
    system = [np.zeros((len(along), nodes))]
    system[0][row, node], system[0][row, node + 1] = node + 1 - along, along - node
    straight = np.eye(nodes)
    # Slopes count only where nothing else tells them.
    system += [LEAST_WEIGHT * np.diff(straight, axis=0)]
    system += [np.sqrt(SMOOTHNESS * len(along) / nodes) * np.diff(straight, 3, axis=0)]
    known = np.zeros(sum(map(len, system)))
    known[: len(along)] = right_m
    return np.asarray(np.linalg.lstsq(np.concatenate(system), known)[0], np.float64)
