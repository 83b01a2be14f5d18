"""Assignment of LiDAR returns to vehicles, and the positions of these that follow from it.

The assignment of clusters to expected vehicles is gated, and the most likely as a whole (the Hungarian method). A
vehicle then takes all returns within its box, from whatever cluster; what its clusters hold beyond is clustered again
and offered to the others. So a cluster of two vehicles is parted, and a vehicle in two clusters is joined. What remains
are new vehicles, or no vehicles (`new_vehicles`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.pipeline.transforms.onboard.boxes import (
    Boxes,
    Returns,
    compute_lean,
    expect_boxes,
    join_boxes,
    locate_boxes,
    make_no_boxes,
    measure_depth,
    pick_boxes,
)
from tracklake.pipeline.transforms.onboard.clusters import (
    Scan,
    cluster_returns,
    describe_clusters,
    describe_scan,
    find_hidden,
    find_sector,
    select_returns,
)
from tracklake.pipeline.transforms.onboard.measurements import LidarMeasurement, Measured, Predicted, Scanner
from tracklake.pipeline.transforms.onboard.new_vehicles import find_new_vehicles
from tracklake.schemas.arrays import Flags, Floats, Integers, expand_ranges
from tracklake.schemas.perception import FIRST_LIDAR_ID

GATE = 9.21
"""99 % quantile of chi squared with 2 degrees of freedom."""
CLUTTER_PER_M2 = 1 / 175
"""Density of vehicles that were not predicted: one per lane and 50 m."""
SEEN_SHARE, SEEN_SHARE_HIDDEN = 0.9, 0.2
"""Probability that a predicted vehicle in free sight, or behind something nearer, gives returns."""
HEADING_SD_RAD = 0.03
"""Standard deviation of a predicted heading, in rad."""
ROUNDS = 3
"""Times that parted clusters are offered again."""


@dataclass
class _Choice:
    """What has been decided on a scan so far."""

    vehicle: Integers
    """(P,) predicted vehicle of each return; -1 = none yet."""
    segment: Integers
    """(P,) cluster of each return without a vehicle."""
    main: Integers
    """(V,) the cluster that each vehicle chose; -1 = none."""
    candidates: Integers
    """(V,) clusters within each vehicle's gate when it first chose."""


def measure_by_lidar(
    points_m: npt.NDArray[np.floating], predicted: Predicted, scanner: Scanner | None = None
) -> LidarMeasurement:
    """Measure predicted and new vehicles by the returns of one scan.

    Args:
        points_m: (P, 3) returns above the ground, in the ego's frame.
        predicted: vehicles expected at the moment of the scan.
        scanner: place of the LiDAR; None = above the ego's centre.
    """
    scanner = scanner or Scanner()
    points = np.asarray(points_m, np.float64).reshape(-1, 3)
    points = points[select_returns(points)]
    origin = np.array([scanner.x_m, scanner.y_m])
    scan, joined = describe_scan(points, origin, scanner.z_m)
    shifted = Predicted(
        predicted.vehicle_id,
        predicted.centre_m - origin,
        predicted.covariance_m2,
        predicted.heading_rad,
        predicted.size_m,
    )
    vehicles = predicted.vehicle_id.size
    choice = _Choice(
        np.full(scan.range_m.size, -1),
        cluster_returns(scan, np.arange(scan.range_m.size)),
        np.full(vehicles, -1),
        np.zeros(vehicles, np.int64),
    )
    _choose(scan, shifted, choice)
    found, boxes, gate = _locate_chosen(scan, shifted, choice)
    group, new, new_boxes = find_new_vehicles(scan, choice.vehicle < 0, boxes, shifted.heading_rad[found])
    cluster = np.concatenate([np.arange(found.size), new + found.size])
    offset = boxes.centre_m - shifted.centre_m[found]
    measured = Measured(
        row=np.concatenate([found, np.full(new.size, -1)]),
        centre_m=np.concatenate([boxes.centre_m, new_boxes.centre_m]) + origin,
        covariance_m2=np.concatenate([boxes.covariance_m2, new_boxes.covariance_m2]),
        cluster=cluster,
        lean=np.concatenate([compute_lean(boxes), compute_lean(new_boxes)]),
        size_m=np.concatenate([boxes.size_m, new_boxes.size_m]),
    )
    number = np.full(vehicles, -1)
    number[found] = np.arange(found.size)
    label = np.where(choice.vehicle >= 0, number[choice.vehicle] if vehicles else -1, group + found.size)
    count = int(label.max() + 1) if label.size else 0
    unknown = np.full(new.size, np.nan)
    return LidarMeasurement(
        measured,
        describe_clusters(points, label[joined], count),
        {
            "cluster": cluster.astype(np.int32),
            "side": np.concatenate([boxes.side, new_boxes.side]),
            "distance_m": np.concatenate([np.hypot(*offset.T), unknown]).astype(np.float32),
            "gate": np.concatenate([gate, unknown]).astype(np.float32),
            "candidates": np.concatenate([choice.candidates[found], np.zeros(new.size)]).astype(np.int32),
        },
    )


def _choose(scan: Scan, predicted: Predicted, choice: _Choice) -> None:
    """Assign clusters to vehicles until none wants one; write `choice`."""
    for turn in range(ROUNDS):
        waiting = np.flatnonzero(choice.main < 0)
        vehicle, segment, mean, boxes = _measure_pairs(scan, predicted, waiting, choice)
        if not vehicle.size:
            return
        row, column, gated = _assign(scan, predicted, vehicle, segment, mean, boxes)
        if turn == 0:
            choice.candidates = np.bincount(vehicle[gated], minlength=choice.main.size)
        if not row.size:
            return
        chosen = np.flatnonzero(gated)
        pair = chosen[_find_pairs(vehicle[chosen], segment[chosen], row, column)]
        # A small cluster within the box of another vehicle with a larger one is a part of that vehicle.
        returns = np.bincount(choice.segment[choice.vehicle < 0])[column]
        inside = measure_depth(mean[pair], pick_boxes(boxes, pair), predicted.heading_rad[row]) <= 0
        own = ~(inside & (returns > returns[:, None])).any(1)
        row, column, pair = row[own], column[own], pair[own]
        choice.main[row] = column
        others = np.setdiff1d(waiting, row)
        others = others[~np.isnan(predicted.size_m[others, 0])]
        rivals = expect_boxes(predicted.centre_m[others], predicted.covariance_m2[others], predicted.size_m[others])
        heading = predicted.heading_rad[np.concatenate([row, others])]
        parted = _assign_free_returns(scan, choice, row, join_boxes(pick_boxes(boxes, pair), rivals), heading)
        if not parted:
            return


def _measure_pairs(
    scan: Scan, predicted: Predicted, waiting: Integers, choice: _Choice
) -> tuple[Integers, Integers, Floats, Boxes]:
    """Measure each waiting vehicle by each cluster that can be in its gate.

    Returns:
        (R,) vehicles and clusters, the means of these, and where each vehicle would be.
    """
    nothing = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), make_no_boxes()
    free = np.flatnonzero(choice.vehicle < 0)
    if not (free.size and waiting.size):
        return nothing
    order = free[np.argsort(choice.segment[free], kind="stable")]
    names, first, count = np.unique(choice.segment[order], return_index=True, return_counts=True)
    least = np.minimum.reduceat(scan.place_m[order], first)
    most = np.maximum.reduceat(scan.place_m[order], first)
    size = np.where(np.isnan(predicted.size_m[waiting]), (12.0, 2.6), predicted.size_m[waiting])
    spread = np.sqrt(np.linalg.eigvalsh(predicted.covariance_m2[waiting])[:, 1])
    reach = np.sqrt(GATE) * (spread + 0.5) + np.hypot(*size.T) / 2
    centre = predicted.centre_m[waiting][:, None]
    outside = np.maximum(np.maximum(least - centre, centre - most), 0)
    near = np.hypot(outside[..., 0], outside[..., 1]) <= reach[:, None]
    row, column = np.nonzero(near)
    if not row.size:
        return nothing
    within, pair = expand_ranges(first[column], count[column])
    hidden = find_hidden(scan, order, first, count)
    vehicle = waiting[row]
    boxes = _locate(scan, order[within], pair, hidden[column], predicted, vehicle, whole=False)
    mean = np.add.reduceat(scan.place_m[order], first) / count[:, None]
    return vehicle, names[column], mean[column], boxes


def _locate(
    scan: Scan, points: Integers, owner: Integers, hidden: Flags, predicted: Predicted, vehicle: Integers, whole: bool
) -> Boxes:
    """Measure predicted vehicles, of which some may occur more than once, by their returns."""
    returns = Returns(
        scan.place_m[points], scan.height_m[points], owner, hidden, scan.on_top[points], scan.step_rad, whole
    )
    return locate_boxes(
        returns,
        predicted.heading_rad[vehicle],
        np.full(vehicle.size, HEADING_SD_RAD),
        predicted.size_m[vehicle],
        predicted.vehicle_id[vehicle] < FIRST_LIDAR_ID,
    )


def _assign(
    scan: Scan, predicted: Predicted, vehicle: Integers, segment: Integers, mean: Floats, boxes: Boxes
) -> tuple[Integers, Integers, Flags]:
    """Choose the most likely set of pairs.

    A pair is chosen only if it is more likely than a missed vehicle and an unknown cluster.

    Returns:
        The chosen vehicles and their clusters, and (R,) which pairs are within the gate.
    """
    from scipy.optimize import linear_sum_assignment

    spread = predicted.covariance_m2[vehicle] + boxes.covariance_m2
    square = _square(boxes.centre_m - predicted.centre_m[vehicle], spread)
    centre = predicted.centre_m[vehicle]
    sector = find_sector(np.arctan2(centre[:, 1], centre[:, 0]), scan.nearest_m.size)
    distance = np.hypot(*centre.T)
    behind = scan.nearest_m[sector] < distance - np.nan_to_num(predicted.size_m[vehicle, 0], nan=5.0) - 3.0
    share = np.where(behind, SEEN_SHARE_HIDDEN, SEEN_SHARE)
    missed = 2 * np.log((1 - share) * CLUTTER_PER_M2 / share)
    cost = square + boxes.surprise + np.log(np.linalg.det(2 * np.pi * spread)) + missed
    gated = (square <= GATE) & (boxes.surprise <= GATE) & (cost < 0)
    gated &= ~_find_parts(vehicle, mean, boxes, predicted.heading_rad[vehicle], gated)
    rows, row = np.unique(vehicle[gated], return_inverse=True)
    columns, column = np.unique(segment[gated], return_inverse=True)
    costs = np.zeros((rows.size, columns.size))
    costs[row, column] = cost[gated]
    left, right = linear_sum_assignment(costs)
    taken = costs[left, right] < 0
    return rows[left[taken]], columns[right[taken]], gated


def _find_parts(vehicle: Integers, mean: Floats, boxes: Boxes, heading: Floats, gated: Flags) -> Flags:
    """Tell which of (R,) pairs have a cluster within the box that a nearer cluster in the gate gives the vehicle.

    The side of a vehicle far ahead gives returns metres apart: clusters that are parts of the one with its rear.
    """
    inside = measure_depth(mean, boxes, heading) <= 0
    distance = np.hypot(*mean.T)
    inside &= (vehicle[:, None] == vehicle) & gated & (distance[:, None] > distance)
    return np.asarray(inside.any(1))


def _find_pairs(vehicle: Integers, segment: Integers, row: Integers, column: Integers) -> Integers:
    """Return the positions in (R,) pairs of some pairs."""
    width = int(max(segment.max(), column.max())) + 1
    key = vehicle * width + segment
    order = np.argsort(key)
    return np.asarray(order[np.searchsorted(key, row * width + column, sorter=order)])


def _assign_free_returns(scan: Scan, choice: _Choice, row: Integers, boxes: Boxes, heading: Floats) -> bool:
    """Give vehicles the free returns within their boxes, and cluster again what their clusters hold beyond.

    Args:
        scan: returns.
        choice: what has been decided; written.
        row: (K,) vehicles that chose a cluster.
        boxes: theirs, and those of vehicles that have not chosen yet: what lies in these remains free.
        heading: headings of the boxes.

    Returns:
        Whether such returns remain.
    """
    free = np.flatnonzero(choice.vehicle < 0)
    place = scan.place_m[free]
    off = np.maximum(measure_depth(place, boxes, heading, 0.0), 0) + boxes.end_sd_m.max((1, 2))
    off = np.where(measure_depth(place, boxes, heading) <= 0, off, np.inf)
    owner = off.argmin(1)
    inside = np.isfinite(off[np.arange(free.size), owner]) & (owner < row.size)
    choice.vehicle[free[inside]] = row[owner[inside]]
    touched = np.unique(np.concatenate([choice.segment[free[inside]], choice.main[row]]))
    rest = free[~inside & np.isin(choice.segment[free], touched)]
    if rest.size:
        choice.segment[rest] = choice.segment.max() + 1 + cluster_returns(scan, rest)
    return bool(rest.size)


def _locate_chosen(scan: Scan, predicted: Predicted, choice: _Choice) -> tuple[Integers, Boxes, Floats]:
    """Measure the vehicles by all returns that they took, and take these from vehicles that they put out of the gate.

    Returns:
        The measured vehicles, where they are, and squared Mahalanobis distances from where they were expected.
    """
    taken = np.flatnonzero(choice.vehicle >= 0)
    if not taken.size:
        return np.empty(0, np.int64), make_no_boxes(), np.empty(0)
    order = taken[np.argsort(choice.vehicle[taken], kind="stable")]
    found, owner, count = np.unique(choice.vehicle[order], return_inverse=True, return_counts=True)
    hidden = find_hidden(scan, order, np.cumsum(count) - count, count)
    boxes = _locate(scan, order, owner, hidden, predicted, found, whole=True)
    spread = predicted.covariance_m2[found] + boxes.covariance_m2
    square = _square(boxes.centre_m - predicted.centre_m[found], spread)
    stays = np.flatnonzero(square <= GATE)
    choice.vehicle[~np.isin(choice.vehicle, found[stays])] = -1
    return found[stays], pick_boxes(boxes, stays), square[stays]


def _square(offset: Floats, covariance: Floats) -> Floats:
    """Return squared Mahalanobis distances of (K, 2) offsets."""
    solved = np.linalg.solve(covariance, offset[..., None])[..., 0]
    result: Floats = (offset * solved).sum(-1)
    return result
