"""Assignment of camera boxes to predicted vehicles, and the bearing and rough range that a box gives.

Predicted vehicles are projected as boxes that stand on flat ground, by a pinhole that looks along the ego's axis.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.pipeline.transforms.onboard.boxes import CAR_SIZE_M, TRUCK_SIZE_M, TRUCK_WIDTH_M
from tracklake.pipeline.transforms.onboard.measurements import Camera, CameraMeasurement, Predicted
from tracklake.schemas.arrays import Flags, Floats, Integers

GATE = 11.34
"""99 % quantile of chi squared with 3 degrees of freedom: column, width and foot of a box."""
CLEAR = 4.0
"""What the next best vehicle of a box, or box of a vehicle, must be worse by; otherwise neither is used."""
EDGE_NOISE_PX = 3.0
"""Standard deviation of each edge of a box, in px."""
PITCH_SD_RAD, YAW_SD_RAD = 0.01, 0.002
"""Standard deviations of the camera's pitch (braking, slopes) and of its direction, in rad."""
SHARE_SD, UNKNOWN_SHARE_SD = 0.05, 0.12
"""Relative standard deviation of the width seen, by the heading, and of a vehicle of unknown size."""
CAR_HEIGHT_M, TRUCK_HEIGHT_M = 1.5, 3.6
"""Usual heights, in m."""
LEAST_DEPTH_M = 1.0
"""Vehicles with a corner closer before the camera than this are not matched, in m."""
BORDER_PX = 2.0
"""A box that ends this near the image's border is cut off, in px; the image is taken to be twice `cx_px` wide."""


@dataclass(frozen=True)
class _Picture:
    """Predicted vehicles in the image, V of them."""

    edges_px: Floats
    """(V, 4) left, top, right, bottom."""
    shown: Flags
    """(V,) whether the whole vehicle is before the camera."""
    away_m: Floats
    """(V, 2) centre from the camera."""


def match_boxes(boxes_px: npt.NDArray[np.floating], camera: Camera, predicted: Predicted) -> CameraMeasurement:
    """Assign boxes to vehicles and measure bearing and range.

    Args:
        boxes_px: (B, 4) left, top, width, height.
        camera: focal lengths, principal point and place.
        predicted: vehicles expected at the moment of the image.
    """
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    count = len(boxes)
    row = np.full(count, -1)
    empty = np.full((4, count), np.nan)
    picture = _project(camera, predicted)
    if not count or not picture.shown.any():
        return CameraMeasurement(row, *empty)
    edges = np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
    cost = _compare(edges, picture, camera, predicted)
    box, vehicle = _assign(cost)
    row[box] = vehicle
    empty[:, box] = _measure(edges[box], picture, vehicle, camera, predicted)
    return CameraMeasurement(row, *empty)


def _project(camera: Camera, predicted: Predicted) -> _Picture:
    """Project the corners of the vehicles' boxes."""
    size = predicted.size_m
    truck = np.nan_to_num(size[:, 1]) > TRUCK_WIDTH_M
    size = np.where(np.isnan(size), np.where(truck[:, None], TRUCK_SIZE_M, CAR_SIZE_M), size)
    away = predicted.centre_m - (camera.x_m, camera.y_m)
    cos, sin = np.cos(predicted.heading_rad)[:, None], np.sin(predicted.heading_rad)[:, None]
    ends = np.array([(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])
    along, across = ends[:, 0] * size[:, :1], ends[:, 1] * size[:, 1:]
    depth = away[:, :1] + along * cos - across * sin
    aside = away[:, 1:] + along * sin + across * cos
    shown = depth.min(1, initial=np.inf) >= LEAST_DEPTH_M
    depth = np.maximum(depth, LEAST_DEPTH_M)
    column = camera.cx_px + camera.fx_px * aside / depth
    foot = camera.cy_px + camera.fy_px * camera.z_m / depth
    head = camera.cy_px + camera.fy_px * (camera.z_m - np.where(truck, TRUCK_HEIGHT_M, CAR_HEIGHT_M)[:, None]) / depth
    return _Picture(np.column_stack([column.min(1), head.min(1), column.max(1), foot.max(1)]), shown, away)


def _compare(edges: Floats, picture: _Picture, camera: Camera, predicted: Predicted) -> Floats:
    """Return (B, V) costs of pairs, negative within the gate: squared normalised differences less the overlap."""
    depth = np.maximum(picture.away_m[:, 0], LEAST_DEPTH_M)
    slope = np.column_stack([-picture.away_m[:, 1] / depth**2, 1 / depth])
    aside = np.einsum("va,vab,vb->v", slope, predicted.covariance_m2, slope)
    far = predicted.covariance_m2[:, 0, 0] / depth**2
    wide = np.maximum(picture.edges_px[:, 2] - picture.edges_px[:, 0], 1.0)
    below = camera.fy_px * camera.z_m / depth
    share = _find_share(predicted)
    variance = (
        camera.fx_px**2 * (aside + YAW_SD_RAD**2) + EDGE_NOISE_PX**2 / 2,
        far + share**2 + 2 * EDGE_NOISE_PX**2 / wide**2,
        below**2 * far + (camera.fy_px * PITCH_SD_RAD) ** 2 + EDGE_NOISE_PX**2,
    )
    width = np.maximum(edges[:, 2] - edges[:, 0], 1.0)
    difference = (
        _find_middle(edges)[:, None] - _find_middle(picture.edges_px),
        np.log(width[:, None] / wide),
        edges[:, 3, None] - picture.edges_px[:, 3],
    )
    cut = _is_cut(edges, camera)[:, None] | _is_cut(picture.edges_px, camera)
    square = sum(np.where(cut, 0.0, d**2 / v) for d, v in zip(difference[:2], variance[:2], strict=True))
    square = square + difference[2] ** 2 / variance[2]
    overlap = _find_overlap(edges, picture.edges_px)
    # A box that the border cuts tells its vehicle by overlap alone.
    allowed = (square <= GATE) & picture.shown & (~cut | (overlap > 0.3))
    return np.where(allowed, square - GATE - overlap, 0.0)


def _find_middle(edges: Floats) -> Floats:
    """Return the middle columns of boxes."""
    middle: Floats = (edges[:, 0] + edges[:, 2]) / 2
    return middle


def _find_share(predicted: Predicted) -> Floats:
    """Return the relative standard deviation of each vehicle's visible width."""
    return np.where(np.isnan(predicted.size_m[:, 1]), UNKNOWN_SHARE_SD, SHARE_SD)


def _is_cut(edges: Floats, camera: Camera) -> Flags:
    """Tell which boxes end at the left or right border of the image."""
    cut: Flags = (edges[:, 0] <= BORDER_PX) | (edges[:, 2] >= 2 * camera.cx_px - BORDER_PX)
    return cut


def _find_overlap(first: Floats, second: Floats) -> Floats:
    """Return the intersection over union of (B, 4) and (V, 4) edges, (B, V)."""
    low = np.maximum(first[:, None, :2], second[:, :2])
    high = np.minimum(first[:, None, 2:], second[:, 2:])
    common = np.maximum(high - low, 0).prod(-1)
    areas = [np.maximum(edges[:, 2:] - edges[:, :2], 0).prod(-1) for edges in (first, second)]
    overlap: Floats = common / np.maximum(areas[0][:, None] + areas[1] - common, 1e-9)
    return overlap


def _assign(cost: Floats) -> tuple[Integers, Integers]:
    """Return the pairs of boxes and vehicles of least cost, without those that another pair comes near to."""
    from scipy.optimize import linear_sum_assignment

    box, vehicle = linear_sum_assignment(cost)
    best = cost[box, vehicle]
    others = cost.copy()
    others[box, vehicle] = 0.0
    rival = np.minimum(others[box].min(1, initial=0.0), others[:, vehicle].min(0, initial=0.0))
    clear = (best < 0) & (best <= rival - CLEAR * (rival < 0))
    return box[clear], vehicle[clear]


def _measure(edges: Floats, picture: _Picture, vehicle: Integers, camera: Camera, predicted: Predicted) -> Floats:
    """Return bearings, their variances, ranges and their variances of matched boxes, (4, N)."""
    away, shape = picture.away_m[vehicle], picture.edges_px[vehicle]
    expected = np.arctan((_find_middle(shape) - camera.cx_px) / camera.fx_px)
    seen = np.arctan((_find_middle(edges) - camera.cx_px) / camera.fx_px)
    # The middle of the picture of a box is not the picture of its middle; the prediction tells the difference.
    offset = np.arctan2(away[:, 1], away[:, 0]) - expected
    width, wide = edges[:, 2] - edges[:, 0], shape[:, 2] - shape[:, 0]
    cut = _is_cut(edges, camera)
    noise = np.where(cut, width, EDGE_NOISE_PX / np.sqrt(2)) / camera.fx_px
    distance = np.hypot(*away.T) * wide / np.maximum(width, 1.0)
    share = np.sqrt(_find_share(predicted)[vehicle] ** 2 + 2 * EDGE_NOISE_PX**2 / np.maximum(width, 1.0) ** 2)
    unknown = np.where(cut, np.nan, 1.0)
    variance = noise**2 + YAW_SD_RAD**2 + (0.2 * offset) ** 2
    return np.stack([seen + offset, variance, distance * unknown, (distance * share) ** 2 * unknown])
