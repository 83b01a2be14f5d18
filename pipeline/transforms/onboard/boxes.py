"""Position of a vehicle's box from the returns that lie on it, its heading, and its size where that is known.

In the vehicle's own axes a box has two faces that the scanner may see: one across (rear or front) and one along (left
or right). The axes are mirrored so that both lie on the low side: the near corner is the least of both coordinates.
Each of the four edges of the box is then measured in one of three ways:

- by returns on the face: their mean;
- by the last return before the edge, which lies up to one horizontal step inside;
- not at all, where something nearer hides it.

Per axis, the centre follows from both edges and the size by generalised least squares. So an unknown size cancels where
both edges are seen, and counts where one is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Floats, Integers

RANGE_NOISE_M = 0.03
"""Standard deviation of a return's range, in m."""
SHAPE_M = 0.04
"""Standard deviation of a real vehicle's outline around its box, in m."""
FACE_DEPTH_M = 0.3
"""Depth behind the least coordinate within which returns are on a face, in m."""
CORNER_M = 0.12
"""Distance from the face along a vehicle beyond which a return of the near corner is on the face across it, in m: three
standard deviations of the outline. Returns of one face lie nearer to it."""
KNOWN_SIZE_SD_M = (0.05, 0.03)
"""Standard deviation of length and width from messages, in m."""
CAR_SIZE_M, CAR_SIZE_SD_M = (4.6, 1.85), (0.5, 0.12)
"""Usual length and width of a car, and their standard deviations, in m."""
TRUCK_SIZE_M, TRUCK_SIZE_SD_M = (12.0, 2.5), (4.0, 0.1)
"""Usual length and width of a truck or bus, and their standard deviations, in m."""
TRUCK_HEIGHT_M, TRUCK_WIDTH_M = 2.4, 2.25
"""A vehicle of unknown size is taken for a truck from this height or visible width on, in m."""
UNSEEN_M2 = 1e4
"""Variance of an edge that returns do not tell, in m2."""
MARGIN_M = 0.35
"""Distance outside a measured box within which returns are still the vehicle's, in m, before its standard deviation."""
WIDER = 3.0
"""Greatest surprise by a cluster that is wider than the vehicle."""
REAR, FRONT, LEFT, RIGHT = range(4)


@dataclass(frozen=True)
class Returns:
    """The N returns on K vehicles, in the order of the vehicles; every vehicle has at least one."""

    place_m: Floats
    """(N, 2) from the scanner, along the ego's axes."""
    height_m: Floats
    """(N,) above the ground."""
    vehicle: Integers
    """(N,) from 0 to K - 1, not falling."""
    hidden: Flags
    """(K, 2) whether something nearer stands beside the vehicle's counterclockwise and clockwise end."""
    on_top: Flags
    """(N,) whether the return can be on the roof of a car whose near face something nearer hides."""
    step_rad: float
    """Horizontal step of the scanner."""
    whole: bool
    """Whether these are all the returns of each vehicle; otherwise the last one along it does not tell its far end."""


@dataclass(frozen=True)
class Boxes:
    """Measured boxes of K vehicles."""

    centre_m: Floats
    """(K, 2) from the scanner, along the ego's axes."""
    covariance_m2: Floats
    """(K, 2, 2)."""
    size_m: Floats
    """(K, 2) length and width, best estimate."""
    end_sd_m: Floats
    """(K, 2, 2) standard deviations of the low and the high end of the box, along and across the vehicle: the end that
    the scanner sees is exact where the size is unknown, and only the other one is not."""
    seen_m: Floats
    """(K, 2) extents of the returns along and across the vehicle."""
    height_m: Floats
    """(K,) highest return above the ground."""
    surprise: Floats
    """(K,) squared normalised difference between the seen and the given width; small where an edge is not seen."""
    side: Integers
    """(K,) index of SIDES: the face with most returns."""


@dataclass(frozen=True)
class _Edge:
    """Coordinates and variances of one edge of K boxes."""

    at_m: Floats
    variance_m2: Floats


def locate_boxes(returns: Returns, heading_rad: Floats, heading_sd_rad: Floats, size_m: Floats, known: Flags) -> Boxes:
    """Measure where K boxes are.

    Args:
        returns: returns on the vehicles, K of which have at least one.
        heading_rad: (K,) clockwise from the ego's axis.
        heading_sd_rad: (K,) its standard deviation.
        size_m: (K, 2) length and width; NaN where unknown.
        known: (K,) whether the size is as the vehicle sent it.
    """
    owner, count = returns.vehicle, heading_rad.size
    first = np.searchsorted(owner, np.arange(count))
    turned = _turn(returns.place_m, heading_rad[owner])
    mean = np.add.reduceat(turned, first) / np.bincount(owner, minlength=count)[:, None]
    sign = np.where(mean < 0, -1.0, 1.0)
    place = turned * sign[owner]
    corner = np.minimum.reduceat(place, first)
    top = np.maximum.reduceat(returns.height_m, first)
    size, size_variance = _assume_size(size_m, known, top, np.maximum.reduceat(place, first) - corner)
    # In the mirrored axes the ends change places where exactly one axis was mirrored.
    hidden = np.where((sign.prod(1) < 0)[:, None], returns.hidden[:, ::-1], returns.hidden)
    within = (place <= corner[owner] + size[owner] + 3 * np.sqrt(size_variance)[owner] + FACE_DEPTH_M).all(1)
    faces = _find_faces(place, corner, owner, within, size[:, 0])
    edges = _measure_edges(place, corner, owner, faces, hidden, size, returns)
    centre, variance, best_size, end_variance, surprise = _combine(edges, size, size_variance)
    roof = np.bincount(owner[~returns.on_top], minlength=count) == 0
    more = (heading_sd_rad[:, None] * size[:, ::-1] / 2) ** 2
    more[:, 0] += roof * size[:, 0] ** 2 / 12
    variance = variance + more
    end_sd = np.sqrt(end_variance + more[..., None])
    across = np.bincount(owner[faces.across], minlength=count)
    along = np.bincount(owner[faces.along], minlength=count)
    seen = np.column_stack([_span(place[:, axis], owner, within, count) for axis in (0, 1)])
    side = np.where(along > across, np.where(sign[:, 1] > 0, LEFT, RIGHT), np.where(sign[:, 0] > 0, REAR, FRONT))
    turn = np.stack([np.cos(heading_rad), np.sin(heading_rad), -np.sin(heading_rad), np.cos(heading_rad)], -1)
    axes = turn.reshape(-1, 2, 2)  # rows: along and across the vehicle
    return Boxes(
        centre_m=np.einsum("ki,kij->kj", centre * sign, axes),
        covariance_m2=np.einsum("kia,ki,kib->kab", axes, variance, axes),
        size_m=best_size,
        end_sd_m=np.where(sign[..., None] < 0, end_sd[..., ::-1], end_sd),
        seen_m=seen,
        height_m=top,
        surprise=surprise,
        side=side,
    )


def _turn(place: Floats, heading: Floats) -> Floats:
    """Return (N, 2) places along and across headings (N,)."""
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = place.T
    return np.column_stack([x * cos + y * sin, y * cos - x * sin])


def _assume_size(given: Floats, known: Flags, top: Floats, extent: Floats) -> tuple[Floats, Floats]:
    """Return (K, 2) lengths and widths and their variances: as given, or usual ones of a car or truck."""
    truck = ((top > TRUCK_HEIGHT_M) | (extent[:, 1] > TRUCK_WIDTH_M) | (extent[:, 0] > CAR_SIZE_M[0] + 2.5))[:, None]
    usual = np.where(truck, TRUCK_SIZE_M, CAR_SIZE_M)
    usual_sd = np.where(truck, TRUCK_SIZE_SD_M, CAR_SIZE_SD_M)
    missing = np.isnan(given)
    sd = np.where(missing | ~known[:, None], usual_sd, KNOWN_SIZE_SD_M)
    return np.where(missing, usual, given), sd**2


@dataclass(frozen=True)
class _Faces:
    """Returns on the face across a vehicle (rear or front) and on that along it (left or right)."""

    across_seen: Flags
    """(K,) whether the scanner is behind or ahead of the box."""
    along_seen: Flags
    """(K,) whether it is beside the box's lane."""
    across: Flags
    """(N,) returns on it; those on the near corner, too."""
    along: Flags
    """(N,) returns on it, the near corner left out."""
    across_sure: Flags
    """(N,) returns of `across` that are not on the near corner."""


def _find_faces(place: Floats, corner: Floats, owner: Integers, within: Flags, length: Floats) -> _Faces:
    """Tell the face of each return: beams on one side of the near corner meet one face, the others the other."""
    seen = corner > 0
    inside = place - corner[owner]
    first, second = seen[owner].T
    beyond = place[:, 1] * corner[owner, 0] >= place[:, 0] * corner[owner, 1]
    across = within & first & (~second | beyond) & (inside[:, 0] < FACE_DEPTH_M)
    depth = FACE_DEPTH_M + 0.02 * length
    along = within & second & (~first | ~beyond & (inside[:, 0] >= FACE_DEPTH_M)) & (inside[:, 1] < depth[owner])
    sure = across & (~second | (inside[:, 1] > CORNER_M))
    return _Faces(seen[:, 0], seen[:, 1], across, along, sure)


def _measure_edges(
    place: Floats, corner: Floats, owner: Integers, faces: _Faces, hidden: Flags, size: Floats, returns: Returns
) -> tuple[tuple[_Edge, _Edge], tuple[_Edge, _Edge]]:
    """Return the low and the high edge along the vehicle, and both across it."""
    count, step = corner.shape[0], returns.step_rad
    has_across = np.bincount(owner[faces.across_sure], minlength=count) > 0
    has_along = np.bincount(owner[faces.along], minlength=count) > 0
    far = np.column_stack(
        [
            _find_greatest(place[:, 0], owner, faces.along, corner[:, 0]),
            _find_greatest(place[:, 1], owner, faces.across, corner[:, 1]),
        ]
    )
    # Distance of neighboring returns along each face, near its low and its high end.
    u, v = np.maximum(np.abs(corner), 1e-3).T
    low_gap = step * np.column_stack([u * u / v + v, u + v * v / u])
    far_u, far_v = np.maximum(np.abs(far), 1e-3).T
    high_gap = step * np.column_stack([far_u**2 / v + v, u + far_v**2 / u])
    # A beam that passes the last return of one face would have met the other one, were the corner far from it.
    both = faces.across_seen & faces.along_seen
    slack = np.column_stack([size[:, 1] * u / v, size[:, 0] * v / u])
    low_gap = np.where(both[:, None], np.maximum(low_gap - slack, 0.0), low_gap)
    near_end, far_end = hidden[:, 0], hidden[:, 1]
    unseen_low = np.column_stack([far_end & ~has_across, near_end & ~has_along])
    unseen_high = np.column_stack(
        [
            ~has_along | near_end | (faces.across_seen & (not returns.whole)),
            (np.bincount(owner[faces.across], minlength=count) == 0) | far_end,
        ]
    )
    result = []
    for axis, (on_face, has) in enumerate(((faces.across, has_across), (faces.along, has_along))):
        face = _average(place[:, axis], owner, on_face, count)
        gap = np.minimum(low_gap[:, axis], size[:, axis])
        unseen = unseen_low[:, axis] & ~has
        slack_m = np.maximum(size[:, axis] - (far - corner)[:, axis], 0.0)
        gap = np.where(unseen, slack_m, gap)
        edge = _Edge(
            np.where(has, face.at_m, corner[:, axis] - gap / 2),
            np.where(has, face.variance_m2, gap**2 / 12 + RANGE_NOISE_M**2 + SHAPE_M**2),
        )
        lost = unseen & ~unseen_high[:, axis]
        low = _Edge(edge.at_m, np.where(lost, UNSEEN_M2, edge.variance_m2))
        reach = high_gap[:, axis]
        high = _Edge(
            far[:, axis] + reach / 2,
            np.where(unseen_high[:, axis], UNSEEN_M2, reach**2 / 12 + RANGE_NOISE_M**2 + SHAPE_M**2),
        )
        result.append((low, high))
    return result[0], result[1]


def _average(values: Floats, owner: Integers, chosen: Flags, count: int) -> _Edge:
    """Return the mean of each vehicle's chosen values, and its variance."""
    number = np.maximum(np.bincount(owner[chosen], minlength=count), 1)
    mean = np.bincount(owner[chosen], values[chosen], count) / number
    return _Edge(mean, RANGE_NOISE_M**2 / number + SHAPE_M**2)


def _find_greatest(values: Floats, owner: Integers, chosen: Flags, least: Floats) -> Floats:
    """Return the greatest of each vehicle's chosen values, or `least` where it has none."""
    most = least.copy()
    np.maximum.at(most, owner[chosen], values[chosen])
    return most


def _span(values: Floats, owner: Integers, chosen: Flags, count: int) -> Floats:
    """Return the extent of each vehicle's chosen values."""
    least, most = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(least, owner[chosen], values[chosen])
    np.maximum.at(most, owner[chosen], values[chosen])
    return cast(Floats, most - least)


def _combine(
    edges: tuple[tuple[_Edge, _Edge], tuple[_Edge, _Edge]], size: Floats, size_variance: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Combine the edges of each axis.

    Returns:
        Centres, their variances, sizes, (K, 2) each; variances of both ends, (K, 2, 2); (K,) `surprise` of Boxes.
    """
    low_at, high_at = (np.column_stack([edges[0][end].at_m, edges[1][end].at_m]) for end in (0, 1))
    low, high = (np.column_stack([edges[0][end].variance_m2, edges[1][end].variance_m2]) for end in (0, 1))
    # Both edges give a centre; their errors by the size are opposite.
    total = low + high + size_variance
    weight = (high + size_variance / 2) / total
    centre = weight * (low_at + size / 2) + (1 - weight) * (high_at - size / 2)
    variance = ((low + size_variance / 4) * (high + size_variance / 4) - (size_variance / 4) ** 2) / total
    excess = high_at - low_at - size
    best = size + excess * size_variance / total
    ends = np.stack([low * (high + size_variance), high * (low + size_variance)], -1) / total[..., None]
    surprise = excess[:, 1] ** 2 / total[:, 1]
    # A cluster of two vehicles is wider than one: that alone does not exclude it.
    return centre, variance, best, ends, np.where(excess[:, 1] > 0, np.minimum(surprise, WIDER), surprise)


def compute_lean(boxes: Boxes) -> Floats:
    """Return `lean` of Measured."""
    rear, front = np.square(boxes.end_sd_m[:, 0]).T
    lean: Floats = (front - rear) / (front + rear)
    return lean


def measure_depth(place: Floats, boxes: Boxes, heading: Floats, margin_m: float | None = None) -> Floats:
    """Return how far (N, 2) places lie outside each of K boxes with a margin, in m; negative inside. (N, K)."""
    margin = MARGIN_M + boxes.end_sd_m if margin_m is None else np.full_like(boxes.end_sd_m, margin_m)
    cos, sin = np.cos(heading), np.sin(heading)
    axes = np.stack([[cos, sin], [-sin, cos]])  # (2, 2, K): along and across, x and y
    off = np.einsum("na,iak->nki", place, axes) - np.einsum("ka,iak->ki", boxes.centre_m, axes)
    ends = boxes.size_m[..., None] / 2 + margin  # (K, 2, 2)
    result: Floats = np.maximum(-off - ends[..., 0], off - ends[..., 1]).max(-1)
    return result


def pick_boxes(boxes: Boxes, rows: Integers) -> Boxes:
    """Return some of the boxes."""
    fields: Mapping[str, npt.NDArray[np.generic]] = vars(boxes)
    return Boxes(**{name: values[rows] for name, values in fields.items()})  # type: ignore[arg-type]  # all are arrays


def join_boxes(first: Boxes, second: Boxes) -> Boxes:
    """Return the boxes of both, one after the other."""
    pairs = {name: (values, vars(second)[name]) for name, values in vars(first).items()}
    return Boxes(**{name: np.concatenate(pair) for name, pair in pairs.items()})


def expect_boxes(centre_m: Floats, covariance_m2: Floats, size_m: Floats) -> Boxes:
    """Return boxes of K vehicles of known size where they are expected; nothing is seen of them."""
    sd = np.sqrt(np.linalg.eigvalsh(covariance_m2)[:, 1])
    nothing = np.zeros(len(sd))
    return Boxes(
        centre_m=centre_m,
        covariance_m2=covariance_m2,
        size_m=size_m,
        end_sd_m=np.broadcast_to(sd[:, None, None], (len(sd), 2, 2)),
        seen_m=np.zeros_like(size_m),
        height_m=nothing,
        surprise=nothing,
        side=np.zeros(len(sd), np.int64),
    )


def make_no_boxes() -> Boxes:
    """Return boxes of no vehicles."""
    pair = np.empty((0, 2))
    square = np.empty((0, 2, 2))
    return Boxes(pair, square, pair, square, pair, np.empty(0), np.empty(0), np.empty(0, np.int64))
