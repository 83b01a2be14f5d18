"""A plain LiDAR for tests: every beam against every box, the nearest hit counts."""

import math
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Floats, Integers

SCANNER_Z_M = 1.9
BEAMS_DEG = tuple(range(-15, 16, 2))


@dataclass(frozen=True)
class CarBox:
    """One vehicle: centre ahead and to the right of the ego's, heading clockwise from the ego's, and size."""

    x_m: float
    y_m: float
    heading_deg: float = 0.0
    length_m: float = 4.6
    width_m: float = 1.85
    height_m: float = 1.5
    from_m: float = 0.2


def truck(x_m: float, y_m: float, heading_deg: float = 0.0) -> CarBox:
    """Return a truck of 14 m."""
    return CarBox(x_m, y_m, heading_deg, 14.0, 2.5, 3.8)


def cast_rays(
    boxes: list[CarBox],
    *,
    step_deg: float = 0.2,
    noise_m: float = 0.0,
    seed: int = 0,
    phase: float = 0.5,
    reach_m: float = 120.0,
) -> tuple[Floats, Integers]:
    """Return (P, 3) returns in the ego's frame, and the box of each."""
    rng = np.random.default_rng(seed)
    points, hits = [np.empty((0, 3))], [np.empty(0, np.int64)]
    azimuth = np.radians((np.arange(round(360 / step_deg)) + phase) * step_deg - 180)
    for beam in BEAMS_DEG:
        elevation = math.radians(beam)
        nearest, hit = np.full(azimuth.size, np.inf), np.full(azimuth.size, -1)
        for number, box in enumerate(boxes):
            far = meet_box(box, azimuth, elevation)
            closer = far < nearest
            nearest[closer], hit[closer] = far[closer], number
        keep = nearest < reach_m
        length = nearest[keep] + noise_m * rng.standard_normal(int(keep.sum()))
        flat = length * math.cos(elevation)
        x, y = flat * np.cos(azimuth[keep]), flat * np.sin(azimuth[keep])
        points.append(np.column_stack([x, y, SCANNER_Z_M + length * math.sin(elevation)]))
        hits.append(hit[keep])
    return np.concatenate(points), np.concatenate(hits)


def meet_box(box: CarBox, azimuth: Floats, elevation: float) -> Floats:
    """Return how far along each ray the box begins; inf where the ray misses it."""
    turn = math.radians(box.heading_deg)
    cos, sin = math.cos(turn), math.sin(turn)
    start = (-box.x_m * cos - box.y_m * sin, box.x_m * sin - box.y_m * cos, SCANNER_Z_M)
    x, y = math.cos(elevation) * np.cos(azimuth), math.cos(elevation) * np.sin(azimuth)
    way = (x * cos + y * sin, y * cos - x * sin, np.full(azimuth.size, math.sin(elevation) or 1e-12))
    half = box.length_m / 2, box.width_m / 2
    bounds = ((-half[0], half[0]), (-half[1], half[1]), (box.from_m, box.height_m))
    enter, leave = np.zeros(azimuth.size), np.full(azimuth.size, np.inf)
    for axis in range(3):
        first, second = ((bound - start[axis]) / way[axis] for bound in bounds[axis])
        enter = np.maximum(enter, np.minimum(first, second))
        leave = np.minimum(leave, np.maximum(first, second))
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)
