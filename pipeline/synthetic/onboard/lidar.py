"""A LiDAR with rotating beams: rays are cast against the boxes of the vehicles around it.

A scan is taken at one moment: the movement during a rotation (0.1 s) is left out.
"""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Floats, Integers, Singles, expand_ranges


@dataclass(frozen=True)
class Lidar:
    """A scanner of 16 beams on the ego's roof, as a Velodyne VLP-16 has them.

    Args:
        x_m: ahead of the ego's centre.
        y_m: to the right of the ego's centre.
        z_m: above the ground.
        elevations_deg: angles of the beams above the horizon.
        step_deg: angle between the rays of a beam, at 10 rotations per second.
        range_m: greatest range.
        least_m: smallest range.
        noise_m: standard deviation of ranges.
        ground: whether the ground returns, too.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.9
    elevations_deg: tuple[float, ...] = tuple(range(-15, 16, 2))
    step_deg: float = 0.2
    range_m: float = 100.0
    least_m: float = 0.5
    noise_m: float = 0.03
    ground: bool = False


@dataclass(frozen=True)
class Boxes:
    """Boxes that stand on the ground, B of them, in the ego's frame: x ahead, y to the right."""

    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    """Heading, clockwise."""
    size_m: Floats
    """(B, 3) length, width, height."""


@dataclass(frozen=True)
class Scan:
    """The returns of one rotation."""

    points_m: Singles
    """(P, 3) in the LiDAR's own frame: x ahead, y to the right, z up."""
    box: Integers
    """(P,) box of each return, or -1 for the ground."""
    visible: Floats
    """(B,) share of the directions towards a box in which it returned a ray; 0 for one out of range."""


def cast_rays(lidar: Lidar, boxes: Boxes, random: np.random.Generator) -> Scan:
    """Cast all rays of one rotation; each returns from the nearest box that it meets."""
    azimuths = round(360 / lidar.step_deg)
    azimuth, box = _find_directions(lidar, boxes, azimuths)
    angle = np.radians(lidar.step_deg) * azimuth
    near_m, far_m = _cut_outlines(lidar, boxes, box, angle)
    crosses = (far_m >= near_m) & (near_m > 0)
    azimuth, box, near_m, far_m = azimuth[crosses] % azimuths, box[crosses], near_m[crosses], far_m[crosses]
    elevation = np.radians(np.array(lidar.elevations_deg))
    slope = np.tan(elevation)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        at_ground, at_roof = -lidar.z_m / slope, (boxes.size_m[box, 2] - lidar.z_m) / slope
    enter_m = np.maximum(near_m, np.minimum(at_ground, at_roof))  # (beams, pairs), horizontal distances
    meets = enter_m <= np.minimum(far_m, np.maximum(at_ground, at_roof))
    range_m = np.where(meets, enter_m / np.cos(elevation)[:, None], np.inf)
    range_m[(range_m > lidar.range_m) | (range_m < lidar.least_m)] = np.inf
    ray = np.arange(len(elevation))[:, None] * azimuths + azimuth
    nearest = np.full(len(elevation) * azimuths, np.inf)
    np.minimum.at(nearest, ray.ravel(), range_m.ravel())
    first = (range_m == nearest[ray]) & np.isfinite(range_m)
    seen = np.bincount(box[first.any(axis=0)], minlength=len(boxes.x_m))
    visible = seen / np.maximum(np.bincount(box, minlength=len(boxes.x_m)), 1)
    owner = np.full(len(nearest), -1)
    owner[ray[first]] = np.broadcast_to(box, ray.shape)[first]
    if lidar.ground:
        beam_m = np.where(elevation < 0, -lidar.z_m / np.sin(np.minimum(elevation, -1e-9)), np.inf)
        below = np.repeat(np.where(beam_m <= lidar.range_m, beam_m, np.inf), azimuths)
        nearest = np.minimum(nearest, below)
    return _place_returns(lidar, nearest, owner, visible, random)


def _find_directions(lidar: Lidar, boxes: Boxes, azimuths: int) -> tuple[Integers, Integers]:
    """Return the azimuths, clockwise from ahead, at which each box can be met, and the box of each, (N,) each."""
    dx, dy = boxes.x_m - lidar.x_m, boxes.y_m - lidar.y_m
    distance_m, radius_m = np.hypot(dx, dy), np.hypot(boxes.size_m[:, 0], boxes.size_m[:, 1]) / 2
    half = np.where(distance_m > radius_m, np.arcsin(np.minimum(radius_m / np.maximum(distance_m, 1e-9), 1)), np.pi)
    bearing, step = np.arctan2(dy, dx), np.radians(lidar.step_deg)
    first = np.ceil((bearing - half) / step).astype(np.int64)
    last = np.floor((bearing + half) / step).astype(np.int64)
    count = np.clip(last - first + 1, 0, azimuths)
    return expand_ranges(first, np.where(distance_m - radius_m <= lidar.range_m, count, 0))


def _cut_outlines(lidar: Lidar, boxes: Boxes, box: Integers, angle: Floats) -> tuple[Floats, Floats]:
    """Return the horizontal distances at which rays enter and leave the outlines of boxes, by slabs, (N,) each."""
    dx, dy, yaw = boxes.x_m[box] - lidar.x_m, boxes.y_m[box] - lidar.y_m, boxes.yaw_rad[box]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along, across = dx * cosine + dy * sine, dy * cosine - dx * sine  # of the box's centre, in its own frame
    with np.errstate(divide="ignore", invalid="ignore"):
        ends, sides = (
            np.stack(((centre - extent / 2) / direction, (centre + extent / 2) / direction))
            for centre, extent, direction in (
                (along, boxes.size_m[box, 0], np.cos(angle - yaw)),
                (across, boxes.size_m[box, 1], np.sin(angle - yaw)),
            )
        )
    return np.maximum(ends.min(axis=0), sides.min(axis=0)), np.minimum(ends.max(axis=0), sides.max(axis=0))


def _place_returns(
    lidar: Lidar, nearest: Floats, owner: Integers, visible: Floats, random: np.random.Generator
) -> Scan:
    """Add the noise of ranges and turn returns into points."""
    azimuths = round(360 / lidar.step_deg)
    met = np.flatnonzero(np.isfinite(nearest))
    elevation = np.radians(np.array(lidar.elevations_deg))[met // azimuths]
    angle = np.radians(lidar.step_deg) * (met % azimuths)
    range_m = nearest[met] + lidar.noise_m * random.standard_normal(len(met))
    flat_m = range_m * np.cos(elevation)
    points_m = np.stack((flat_m * np.cos(angle), flat_m * np.sin(angle), range_m * np.sin(elevation)), axis=1)
    return Scan(points_m.astype(np.float32), owner[met], visible)
