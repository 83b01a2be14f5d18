"""A carriageway's axis, fitted to points of its lanes, and positions along and across it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats

STEP_M = 25.0
"""Distance between the nodes of an axis, in m."""
CELL_M = 5.0
"""Length of the cells of a lane whose points count as one, in m."""
SMOOTHNESS = 30.0
"""Weight of changes of the axis's curvature against the distances to its points: waves of 280 m are halved."""
GRID_M = 1.0
"""Distance between the places whose distance along the axis is computed; between them it is interpolated, in m."""
SEARCHES = 8
"""Steps of the search for the nearest point of the axis; each leaves less than a tenth of the distance."""
LEAST_WEIGHT = 1e-4
"""Weight of slopes against the distances to the points."""
FITS = 3
"""Number of times that all lanes are moved onto the one with most points, and the axis is fitted again."""
NO_LANE = -32_768
"""Number that stands for no lane in arrays."""
Vector = tuple[float, float]


@dataclass(frozen=True)
class RoadAxis:
    """A smooth curve in the direction of travel, which turns by less than a right angle.

    It is given by its offsets to the right of a straight line: at nodes STEP_M apart, cubic between them, straight
    beyond the first and the last.

    Args:
        direction: unit vector of the line.
        first_m: place of the first node on the line.
        offset_m: (P,) offsets of the nodes, P >= 2.
        y_points_down: whether y of the plane points down, as in images, so that the right of (1, 0) is (0, 1).
    """

    direction: Vector
    first_m: float
    offset_m: Floats
    y_points_down: bool

    @classmethod
    def fit(cls, points: pl.DataFrame, direction: Vector, *, y_points_down: bool) -> Self:
        """Fit the axis along the lane with most points, by least squares; other lanes run beside it.

        Args:
            points: x, y in m, and lane (numbers that only tell lanes apart, or null).
            direction: direction of travel, roughly.
            y_points_down: see above.
        """
        norm = float(np.hypot(*direction))
        unit = (direction[0] / norm, direction[1] / norm)
        along_m, right_m = _turn(points["x"].to_numpy(), points["y"].to_numpy(), unit, y_points_down=y_points_down)
        first_m = float(along_m.min())
        cells = (
            pl.DataFrame({"along": along_m - first_m, "right": right_m, "lane": points["lane"]})
            .group_by("lane", cell=(pl.col("along") / CELL_M).floor())
            .agg(pl.col("along", "right").median(), pl.len())
            .sort("lane", "cell")
        )
        along, right = cells["along"].to_numpy(), cells["right"].to_numpy()
        lane = cells["lane"].fill_null(NO_LANE).to_numpy()
        sizes = cells.group_by("lane").agg(pl.col("len").sum()).sort("len", "lane", descending=True)
        is_main = lane == sizes["lane"].fill_null(NO_LANE)[0]
        nodes = max(2, int(np.ceil(along.max() / STEP_M)) + 1)
        axis = cls(unit, first_m, _fit_offsets(along[is_main], right[is_main], nodes), y_points_down)
        for _ in range(FITS):
            _, beside, slope = axis._find_nearest(along, right)
            # Each lane is moved onto the main one, by the median of its distances.
            way = np.zeros(len(lane))
            for one in np.unique(lane[~is_main]):
                way[lane == one] = np.median(beside[lane == one])
            way /= np.sqrt(1 + slope**2)
            axis = cls(unit, first_m, _fit_offsets(along + slope * way, right - way, nodes), y_points_down)
        return axis

    def project(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the distances of points along the axis from its first node and to its right, in m."""
        along_m, right_m = _turn(x, y, self.direction, y_points_down=self.y_points_down)
        at, across, slope = self._find_nearest(along_m - self.first_m, right_m)
        grid, distance = self._distances
        inside = np.clip(at, grid[0], grid[-1])
        return np.interp(inside, grid, distance) + (at - inside) * np.sqrt(1 + slope**2), across

    def _find_nearest(self, along_m: Floats, right_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Find the nearest points of the axis: their places on the line, the distances to the right, the slopes there.

        The points are places on the line, in m behind the first node, and distances to its right.
        """
        at = along_m.copy()
        for _ in range(SEARCHES):
            offset, slope = self._evaluate(at)
            at -= (at - along_m + (offset - right_m) * slope) / (1 + slope**2)
        offset, slope = self._evaluate(at)
        return at, (right_m - offset) * np.sqrt(1 + slope**2), slope

    def _evaluate(self, at_m: Floats) -> tuple[Floats, Floats]:
        """Return the axis's offsets and slopes at places of the line, in m behind the first node."""
        slopes: Floats = np.gradient(self.offset_m, STEP_M, edge_order=2 if len(self.offset_m) > 2 else 1)
        inside = np.clip(at_m / STEP_M, 0, len(slopes) - 1)
        node = np.minimum(inside.astype(np.int64), len(slopes) - 2)
        t = inside - node
        rise = self.offset_m[node + 1] - self.offset_m[node]
        low, high = slopes[node] * STEP_M, slopes[node + 1] * STEP_M
        # Cubic Hermite polynomials, by their coefficients of t, t^2 and t^3.
        square, cube = 3 * rise - 2 * low - high, low + high - 2 * rise
        slope = (low + t * (2 * square + t * 3 * cube)) / STEP_M
        offset = self.offset_m[node] + t * (low + t * (square + t * cube))
        return offset + (at_m - inside * STEP_M) * slope, slope

    @cached_property
    def _distances(self) -> tuple[Floats, Floats]:
        """Places of the line, GRID_M apart, and their distances along the axis."""
        end = (len(self.offset_m) - 1) * STEP_M
        grid = np.linspace(0.0, end, round(end / GRID_M) + 1)
        stretch = np.sqrt(1 + self._evaluate(grid)[1] ** 2)
        steps = (stretch[1:] + stretch[:-1]) / 2 * np.diff(grid)
        return grid, np.concatenate([[0.0], np.cumsum(steps)])


def find_direction(dx: Floats, dy: Floats) -> Vector:
    """Find the line along which vehicles went, by how far each came: a unit vector; (1, 0) where none moved."""
    moments = np.array([[dx @ dx, dx @ dy], [dx @ dy, dy @ dy]])
    if not moments.any():
        return 1.0, 0.0
    x, y = np.linalg.eigh(moments)[1][:, 1]
    return float(x), float(y)


def _turn(x: Floats, y: Floats, direction: Vector, *, y_points_down: bool) -> tuple[Floats, Floats]:
    """Return the places of points on a line through the origin, and their distances to its right."""
    ahead_x, ahead_y = direction
    right_x, right_y = (-ahead_y, ahead_x) if y_points_down else (ahead_y, -ahead_x)
    return x * ahead_x + y * ahead_y, x * right_x + y * right_y


def _fit_offsets(along_m: Floats, right_m: Floats, nodes: int) -> Floats:
    """Fit the offsets of the axis's nodes to points, by their places on the line behind the first node."""
    along, row = along_m / STEP_M, np.arange(len(along_m))
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
