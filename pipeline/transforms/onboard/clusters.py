"""Clusters of the returns of one LiDAR scan, by a spacing that follows the range.

The horizontal step of a scanner is an angle, so neighboring returns of one vehicle lie 3 cm apart at 10 m and 30 cm
apart at 90 m. Returns are clustered by DBSCAN in coordinates in which the greatest admitted distance is 1 everywhere.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Floats, Integers, expand_ranges
from tracklake.schemas.extras import require_extras

REACH_ACROSS_M = 0.4
"""Greatest distance of neighboring returns across the line of sight, at the scanner, in m."""
REACH_STEPS = 2.5
"""What is added to it with the range, in horizontal steps of the scanner."""
REACH_ALONG_M = 1.0
"""Greatest distance of neighboring returns along the line of sight, in m."""
CELL = 0.3
"""Edge of the cells that are clustered in place of returns, in greatest distances."""
STEP_LIMITS_RAD = (0.0015, 0.008)
"""Horizontal steps that scanners have, in rad: 0.09 to 0.46 degrees."""
USUAL_STEP_RAD = 0.0035
"""Horizontal step of a 16-beam scanner at 10 Hz, in rad; taken where a scan has too few returns to tell."""
FARTHEST_M = 250.0
"""Greatest range, in m; returns beyond are not used."""
OWN_BODY_M = (2.4, 0.9)
"""Half the length and width around the ego's centre whose returns are its own body, in m."""
HIGHEST_M = 5.0
"""Returns above this height are bridges and signs, in m."""
JOINED_M = 0.3
"""Depth of the places along the line of sight at which returns of several beams are joined, in m."""
LEAST_ROOF_M = 1.1
"""Returns below this height are on the face of a vehicle, not on its roof, in m."""
PASSING_STEPS, CLEARANCE_M = 2.5, 0.5
"""Least gap between two vehicles side by side, in horizontal steps of the scanner, of which one may give no return, and
in m across the line of sight."""
SAME_BEAM = 0.01
"""Difference of slopes within which returns are of one beam, or of neighboring ones; 16 beams lie 0.035 apart."""
HIDING_M = 0.7
"""How much nearer a return must be to hide what is beside it in the picture, in m."""


@dataclass(frozen=True)
class Scan:
    """The P returns of one scan by azimuth, seen from the scanner; those of several beams at one place count as one."""

    place_m: Floats
    """(P, 2) ahead and to the right of the scanner."""
    height_m: Floats
    """(P,) above the ground."""
    range_m: Floats
    """(P,) horizontal distance from the scanner."""
    azimuth_rad: Floats
    """(P,) clockwise from straight ahead."""
    slope: Floats
    """(P,) height above the scanner by distance, of the highest return."""
    step_rad: float
    """Horizontal step of the scanner."""
    on_top: Flags
    """(P,) whether the return can be on the roof of a car whose near face something nearer hides."""
    nearest_m: Floats
    """(A,) range of the nearest return in each of A equal sectors from straight back, clockwise; inf where none is."""


def select_returns(points_m: npt.NDArray[np.floating]) -> Flags:
    """Tell which of (P, 3) points are finite, near enough, and neither the ego's own body nor far above the road."""
    x, y, z = points_m.T
    own = (np.abs(x) < OWN_BODY_M[0]) & (np.abs(y) < OWN_BODY_M[1])
    return cast(Flags, np.isfinite(points_m).all(1) & (np.hypot(x, y) < FARTHEST_M) & (z < HIGHEST_M) & ~own)


def describe_scan(points_m: Floats, origin_m: Floats, scanner_z_m: float) -> tuple[Scan, Integers]:
    """Join the beams that met the same surface one above the other, and see them from the scanner's place (2,).

    Returns:
        The scan, and which of its returns each of the (P, 3) points of the ego's frame is in.
    """
    place = points_m[:, :2] - origin_m
    distance = np.hypot(place[:, 0], place[:, 1])
    azimuth = np.arctan2(place[:, 1], place[:, 0])
    step = estimate_step(azimuth)
    sectors = int(2 * np.pi / step)
    depths = int(2 * FARTHEST_M / JOINED_M)
    key = find_sector(azimuth, sectors) * depths + np.rint(distance / JOINED_M).astype(np.int64)
    names, joined, count = np.unique(key, return_inverse=True, return_counts=True)
    place = np.column_stack([np.bincount(joined, place[:, axis]) for axis in (0, 1)]) / count[:, None]
    height = np.full(names.size, -np.inf)
    np.maximum.at(height, joined, points_m[:, 2])
    distance = np.hypot(place[:, 0], place[:, 1])
    nearest = np.full(sectors, np.inf)
    np.minimum.at(nearest, names // depths, distance)
    behind = nearest[names // depths] < distance - HIDING_M
    on_top = behind & (height > LEAST_ROOF_M) & (height < scanner_z_m)
    azimuth = np.arctan2(place[:, 1], place[:, 0])
    slope = (height - scanner_z_m) / distance
    return Scan(place, height, distance, azimuth, slope, step, on_top, nearest), joined


def find_sector(azimuth_rad: Floats, sectors: int) -> Integers:
    """Return the sector of each azimuth."""
    return np.floor((azimuth_rad + np.pi) / (2 * np.pi) * sectors).astype(np.int64) % sectors


def estimate_step(azimuth_rad: Floats) -> float:
    """Return the horizontal step of the scanner: the median of the gaps between neighboring returns that can be one."""
    gaps = np.diff(np.sort(azimuth_rad))
    gaps = gaps[(gaps > STEP_LIMITS_RAD[0]) & (gaps < STEP_LIMITS_RAD[1])]
    return float(np.median(gaps)) if gaps.size >= 5 else USUAL_STEP_RAD


def cluster_returns(scan: Scan, chosen: Integers) -> Integers:
    """Number the clusters of the chosen returns, the nearest first.

    A cluster is a connected set: each return lies within reach of another one (DBSCAN with one sample as the least). It
    ends where beams pass through it.

    Returns:
        (len(chosen),) numbers from 0.
    """
    if not chosen.size:
        return np.empty(0, np.int64)
    require_extras("LiDAR clusters", "onboard")
    import sklearn
    from sklearn.cluster import dbscan

    # One point stands for all returns of a cell; three coordinates of up to 20 bits make one key.
    cell = np.rint(_scale(scan, chosen) / CELL).astype(np.int64)
    _, first, of_cell = np.unique((cell + 2**19) @ 2 ** np.array([40, 20, 0]), return_index=True, return_inverse=True)
    with sklearn.config_context(assume_finite=True, skip_parameter_validation=True):
        _, label = dbscan(cell[first] * CELL, eps=1.0, min_samples=1, algorithm="ball_tree")  # no threads that wait
    label = part_at_gaps(scan, chosen, label[of_cell])
    nearest = np.full(label.max() + 1, np.inf)
    np.minimum.at(nearest, label, scan.range_m[chosen])
    number = np.empty(nearest.size, np.int64)
    number[np.argsort(nearest, kind="stable")] = np.arange(nearest.size)
    return number[label]


def part_at_gaps(scan: Scan, chosen: Integers, label: Integers) -> Integers:
    """Part clusters where all beams between two neighboring returns went past them.

    A vehicle is convex: beams between two of its returns meet it, or something nearer that is as high in the picture
    as the higher one.

    Args:
        scan: returns.
        chosen: (N,) those in clusters.
        label: (N,) their clusters, numbered from 0.

    Returns:
        (N,) numbers from 0.
    """
    count = np.bincount(label)
    mean = np.column_stack([np.bincount(label, scan.place_m[chosen, axis]) for axis in (0, 1)]) / count[:, None]
    turned = (scan.azimuth_rad[chosen] - np.arctan2(mean[:, 1], mean[:, 0])[label] + np.pi) % (2 * np.pi)
    order = np.lexsort((turned, label))
    nearer = np.minimum(scan.range_m[chosen[order[1:]]], scan.range_m[chosen[order[:-1]]])
    gap = np.diff(turned[order])
    same = label[order[1:]] == label[order[:-1]]
    gaps = np.flatnonzero(same & (gap > PASSING_STEPS * scan.step_rad) & (gap * nearer > CLEARANCE_M))
    if not gaps.size:
        return label
    sectors = scan.nearest_m.size
    sector = find_sector(scan.azimuth_rad, sectors)  # not falling
    low = np.searchsorted(sector, sector[chosen[order[gaps]]], "right")
    high = np.searchsorted(sector, sector[chosen[order[gaps + 1]]], "left")
    between, which = expand_ranges(low, (high - low) % sector.size)
    between %= sector.size
    higher = np.maximum(scan.slope[chosen[order[gaps]]], scan.slope[chosen[order[gaps + 1]]])
    hides = (scan.range_m[between] < nearer[gaps][which] + HIDING_M) & (scan.slope[between] > higher[which] - SAME_BEAM)
    hidden = np.bincount(which[hides], minlength=gaps.size) > 0
    parted = np.zeros(label.size, np.int64)
    parted[gaps[~hidden] + 1] = 1
    parts = np.empty(label.size, np.int64)
    parts[order] = label[order] + np.cumsum(parted)
    return parts


def _scale(scan: Scan, chosen: Integers) -> Floats:
    """Map the plane on a surface of revolution (P, 3) on which the greatest distance is 1 at every range.

    At range r its radius is r / (reach across), so distances across are right; its height makes up for what distances
    along the line of sight lack.
    """
    slope = REACH_STEPS * scan.step_rad
    knots = np.arange(0.0, FARTHEST_M + 1.0, 0.5)
    radial = REACH_ACROSS_M / (REACH_ACROSS_M + slope * knots) ** 2
    climb = np.sqrt(np.maximum(REACH_ALONG_M**-2 - radial**2, 0.0))
    distance = scan.range_m[chosen]
    reach = REACH_ACROSS_M + slope * distance
    height = np.interp(distance, knots, np.cumsum(climb) * 0.5)
    return np.column_stack([scan.place_m[chosen] / reach[:, None], height])


def describe_clusters(points_m: Floats, label: Integers, count: int) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns of LIDAR_CLUSTERS, without place and tick, of (P, 3) points in clusters 0 to count - 1."""
    order = np.lexsort((np.hypot(points_m[:, 0], points_m[:, 1]), label))
    points, label = points_m[order], label[order]
    first = np.searchsorted(label, np.arange(count))
    returns = np.bincount(label, minlength=count)
    if not count:
        first = np.empty(0, np.int64)
    mean = np.column_stack([np.bincount(label, points[:, axis], count) for axis in (0, 1)]) / returns[:, None]
    least = np.minimum.reduceat(points, first) if count else np.empty((0, 3))
    most = np.maximum.reduceat(points, first) if count else np.empty((0, 3))
    columns = {
        "x_m": mean[:, 0],
        "y_m": mean[:, 1],
        "nearest_x_m": points[first, 0],
        "nearest_y_m": points[first, 1],
        "least_x_m": least[:, 0],
        "most_x_m": most[:, 0],
        "least_y_m": least[:, 1],
        "most_y_m": most[:, 1],
        "height_m": most[:, 2],
    }
    singles = {name: values.astype(np.float32) for name, values in columns.items()}
    return {"cluster": np.arange(count, dtype=np.int32), "returns": returns.astype(np.int32), **singles}


def find_hidden(scan: Scan, order: Integers, first: Integers, count: Integers) -> Flags:
    """Tell of (S,) groups of returns whether something nearer stands beside either end: (S, 2) left and right."""
    place = scan.place_m[order]
    mean = np.add.reduceat(place, first) / count[:, None]
    group = np.repeat(np.arange(count.size), count)
    middle = np.arctan2(mean[:, 1], mean[:, 0])
    turn = (scan.azimuth_rad[order] - middle[group] + np.pi) % (2 * np.pi) - np.pi
    sectors = scan.nearest_m.size
    hidden = []
    for sign in (-1, 1):
        last = np.lexsort((sign * turn, group))[np.cumsum(count) - 1]
        sector = find_sector(scan.azimuth_rad[order[last]], sectors)
        beside = scan.nearest_m[(sector[:, None] + sign * np.arange(4)) % sectors].min(1)
        hidden.append(beside < scan.range_m[order[last]] - HIDING_M)
    return np.column_stack(hidden)
