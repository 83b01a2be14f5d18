"""Derived columns that compare the vehicles of one frame: overlaps, nearest vehicles ahead, headways."""

import numpy as np
from numpy.typing import NDArray

from tracklake.quality_reports.rules.scene import ABSENT, UNITS_PER_M, Scene
from tracklake.schemas.arrays import Flags, Floats, Integers


def sort_rows(*keys: NDArray[np.integer]) -> Integers:
    """Sort rows by keys, the first most significant; rows with equal keys come in any order.

    The keys are packed into one whole number, which sorts many times faster than one key after another; where their
    ranges are too wide for 63 bits, they are sorted one after another.
    """
    if not len(keys[0]):
        return np.empty(0, np.int64)
    least = [int(key.min()) for key in keys]
    spans = [int(key.max()) - low + 1 for key, low in zip(keys, least, strict=True)]
    total = 1
    for span in spans:
        total *= span
    if total >= 2**63:
        return np.lexsort(keys[::-1])
    packed = np.zeros(len(keys[0]), np.int64)
    for key, low, span in zip(keys, least, spans, strict=True):
        packed *= span
        packed += key
        packed -= low
    return np.argsort(packed)


def measure_overlaps(scene: Scene) -> Floats:
    """Measure how deep an entry's box lies in that of another vehicle in the same frame, m, to 1 mm.

    Depth is the least distance that one of the two would have to move, along or across either of them, to be clear of
    the other; of several overlaps the deepest. 0 = none: touching is not overlapping. Boxes reach back from the front
    centre by the length, against the heading (along the road where there is none), and half the width to either side.
    NaN where the own size is unknown; others of unknown size are skipped.
    """
    length, width = (scene.trait(name)[scene.track] for name in ("length_m", "width_m"))
    known = ~(np.isnan(length) | np.isnan(width))
    rows = np.flatnonzero(known)
    # In the order of (frame, x), those that can reach into a vehicle's rear are the ones right before it.
    order = sort_rows(scene.frame[rows], scene.x_units[rows])
    rows = rows[order]
    frame, x = scene.frame[rows], scene.tracks["x_m"].to_numpy()[rows]
    boxes = _Boxes(scene, rows)
    # No box reaches farther ahead of its front centre than its corners do.
    ahead_m = float(np.max(boxes.half_width * np.abs(boxes.sine), initial=0.0))
    rear = boxes.x - boxes.half_length * boxes.cosine - boxes.half_width * np.abs(boxes.sine) - ahead_m
    side = boxes.half_length * np.abs(boxes.sine) + boxes.half_width * boxes.cosine
    depth = np.zeros(len(rows))
    ahead, step = np.arange(1, len(rows)), 1
    while ahead.size:
        behind = ahead - step
        within = (x[behind] > rear[ahead]) & (frame[behind] == frame[ahead])
        ahead = ahead[within]
        behind = ahead - step
        meets = side[ahead] + side[behind] > np.abs(boxes.y[ahead] - boxes.y[behind])
        first, second = behind[meets], ahead[meets]
        deep = np.round(np.minimum(boxes.measure_depth(first, second), boxes.measure_depth(second, first)), 3)
        depth[first] = np.maximum(depth[first], deep)
        depth[second] = np.maximum(depth[second], deep)
        step += 1
        ahead = ahead[ahead >= step]
    overlap = np.full(scene.height, np.nan)
    overlap[rows] = depth
    return overlap


class _Boxes:
    """Rectangles of entries in the plane: middles, half sizes and headings."""

    def __init__(self, scene: Scene, rows: Integers) -> None:
        self.half_length, self.half_width = (
            scene.trait(name)[scene.track[rows]].astype(np.float64) / 2 for name in ("length_m", "width_m")
        )
        heading = scene.headings[rows]
        self.cosine, self.sine = np.cos(heading), np.sin(heading)
        x, y = (scene.tracks[name].to_numpy()[rows] for name in ("x_m", "y_m"))
        self.x, self.y = x - self.half_length * self.cosine, y - self.half_length * self.sine

    def measure_depth(self, one: Integers, other: Integers) -> Floats:
        """Measure the lesser of how far two boxes overlap along and across the first, m; not above 0 = apart."""
        x, y = self.x[other] - self.x[one], self.y[other] - self.y[one]
        cosine, sine = self.cosine[one], self.sine[one]
        # Of the angle between the two boxes.
        turned = np.abs(cosine * self.cosine[other] + sine * self.sine[other])
        askew = np.abs(sine * self.cosine[other] - cosine * self.sine[other])
        length, width = self.half_length[other], self.half_width[other]
        along = self.half_length[one] + length * turned + width * askew - np.abs(x * cosine + y * sine)
        across = self.half_width[one] + length * askew + width * turned - np.abs(y * cosine - x * sine)
        depth: Floats = np.minimum(along, across)
        return depth


def measure_nearest_ahead(scene: Scene) -> Floats:
    """Measure the distance from an entry's front to the next front ahead in its lane, m; NaN where there is none.

    A vehicle exactly abreast (to 0.1 mm) is not ahead.
    """
    rows = np.flatnonzero(scene.lane != ABSENT)
    order = sort_rows(scene.frame[rows], scene.lane[rows], scene.x_units[rows])
    rows = rows[order]
    frame, lane, x = scene.frame[rows], scene.lane[rows], scene.x_units[rows]
    distance = np.full(len(rows), np.nan)
    own, step = np.arange(len(rows) - 1), 1
    while own.size:
        other = own + step
        beside: Flags = (frame[other] == frame[own]) & (lane[other] == lane[own])
        own, other = own[beside], other[beside]
        apart = x[other] - x[own]
        ahead = apart > 0
        distance[own[ahead]] = apart[ahead] / UNITS_PER_M
        step += 1
        own = own[~ahead]
        own = own[own < len(rows) - step]
    nearest = np.full(scene.height, np.nan)
    nearest[rows] = distance
    return nearest


def measure_leader_ahead(scene: Scene) -> Floats:
    """Measure the distance from an entry's front to its recorded leader's, m, negative behind; NaN if unknown."""
    seen = scene.leader_row != ABSENT
    apart = (scene.x_units[scene.leader_row] - scene.x_units) / UNITS_PER_M
    return np.where(seen, apart, np.nan)


def is_leader_in_lane(scene: Scene) -> Floats:
    """Return 1 where the recorded leader is in the entry's lane, 0 where it is in another, NaN where unknown."""
    other = scene.lane[scene.leader_row]
    seen = (scene.leader_row != ABSENT) & (other != ABSENT) & (scene.lane != ABSENT)
    return np.where(seen, (other == scene.lane).astype(np.float64), np.nan)


def measure_recorded_gaps(scene: Scene) -> Floats:
    """Measure the recorded headway as a gap from bumper to bumper, m, to 1 mm; NaN without the leader's length.

    Sources record headways from front to front or from bumper to bumper. The reading that is nearer to gap_m in the
    subset's median is used; if neither is, from front to front.
    """
    headway = scene.measurements("headway_recorded_m").astype(np.float64)
    gap = scene.measurements("gap_m")
    length = scene.trait("length_m")[scene.leader].astype(np.float64)
    as_fronts = headway - length
    known = ~(np.isnan(as_fronts) | np.isnan(gap))
    if known.any():
        fronts, bumpers = (float(np.median(np.abs((each - gap)[known]))) for each in (as_fronts, headway))
        if bumpers < fronts:
            as_fronts = np.where(np.isnan(length), np.nan, headway)
    return np.round(as_fronts, 3)
