"""Vehicles among the LiDAR returns that no expected vehicle has taken; walls, barriers and posts are none."""

import numpy as np

from tracklake.pipeline.transforms.onboard.boxes import (
    Boxes,
    Returns,
    locate_boxes,
    make_no_boxes,
    measure_depth,
    pick_boxes,
)
from tracklake.pipeline.transforms.onboard.clusters import Scan, cluster_returns, find_hidden, part_at_gaps
from tracklake.schemas.arrays import Flags, Floats, Integers

NEW_HEADING_SD_RAD = 0.08
"""Standard deviation of the ego's axis as the heading of a new vehicle, in rad."""
NEAR_BOX_M = 1.5
"""A cluster closer than this to a measured vehicle is a part of it or hangs on it, and no new vehicle, in m."""
LEAST_RETURNS = 3
"""Returns in different directions or depths that a new vehicle must have."""
LONGEST_M, WIDEST_M, NARROWEST_M = 26.0, 3.2, 0.5
"""Greatest length and width, and least greater extent, of what can be a vehicle, in m."""
LONG_M, LONG_HEIGHT_M = 7.0, 1.8
"""What is longer than a car and lower than this is a barrier, in m: the beam above the horizon meets every truck."""
BARRIER_GAP_M = 30.0
"""Distance from the end of a barrier up to which clusters in line with it belong to it, in m."""
ROADSIDE_M = 25.0
"""What lies farther than this beside the ego is off its road, in m."""


def find_new_vehicles(scan: Scan, is_free: Flags, known: Boxes, heading: Floats) -> tuple[Integers, Integers, Boxes]:
    """Group the returns that no vehicle has, and tell which groups are vehicles.

    A cluster within the usual box of a nearer one belongs to it: the side of a vehicle far ahead gives returns metres
    apart.

    Args:
        scan: returns.
        is_free: (P,) whether no vehicle has a return.
        known: measured vehicles.
        heading: their headings.

    Returns:
        (P,) group of each return from 0, undefined where a vehicle has it; the groups that are vehicles; their boxes.
    """
    group = np.zeros(is_free.size, np.int64)
    free = np.flatnonzero(is_free)
    if not free.size:
        return group, np.empty(0, np.int64), make_no_boxes()
    owner = cluster_returns(scan, free)
    boxes, mean = _locate_new(scan, free, owner, whole=False)
    straight = np.zeros(len(mean))
    inside = measure_depth(mean, boxes, straight) <= 0
    # (child, parent): clusters are numbered from the nearest on, and a parent must not be a child itself.
    inside = np.tril(inside, -1)
    inside &= ~inside.any(1)
    parent = np.where(inside.any(1), inside.argmax(1), np.arange(len(mean)))
    _, renumbered = np.unique(parent, return_inverse=True)
    owner = part_at_gaps(scan, free, renumbered[owner])
    boxes, mean = _locate_new(scan, free, owner, whole=True)
    vehicle = _is_vehicle(boxes, mean, np.bincount(owner))
    if known.side.size:
        vehicle &= (measure_depth(mean, known, heading, NEAR_BOX_M) > 0).all(1)
    group[free] = owner
    new = np.flatnonzero(vehicle)
    return group, new, pick_boxes(boxes, new)


def _locate_new(scan: Scan, free: Integers, owner: Integers, whole: bool) -> tuple[Boxes, Floats]:
    """Measure boxes of groups of returns along the ego's axis, and the means of their returns."""
    order = np.argsort(owner, kind="stable")
    points, owner = free[order], owner[order]
    count = np.bincount(owner)
    first = np.cumsum(count) - count
    hidden = find_hidden(scan, points, first, count)
    returns = Returns(
        scan.place_m[points], scan.height_m[points], owner, hidden, scan.on_top[points], scan.step_rad, whole
    )
    groups = count.size
    boxes = locate_boxes(
        returns,
        np.zeros(groups),
        np.full(groups, NEW_HEADING_SD_RAD),
        np.full((groups, 2), np.nan),
        np.zeros(groups, np.bool_),
    )
    return boxes, np.add.reduceat(scan.place_m[points], first) / count[:, None]


def _is_vehicle(boxes: Boxes, mean: Floats, returns: Integers) -> Flags:
    """Tell what can be a vehicle by its extents, its returns and its place; walls, barriers and posts cannot."""
    long, wide = boxes.seen_m.T
    barrier = (long > LONGEST_M) | ((long > LONG_M) & (boxes.height_m < LONG_HEIGHT_M))
    fits = ~barrier & (wide <= WIDEST_M) & (np.maximum(long, wide) >= NARROWEST_M)
    if barrier.any():
        line = pick_boxes(boxes, np.flatnonzero(barrier))
        line.size_m[:, 0] += 2 * BARRIER_GAP_M
        fits &= (measure_depth(mean, line, np.zeros(line.side.size), 0.0) > 0).all(1)
    return np.asarray(fits & (returns >= LEAST_RETURNS) & (np.abs(mean[:, 1]) <= ROADSIDE_M))
