"""Derived columns that compare the vehicles of one frame: overlaps, nearest vehicles ahead, headways."""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.quality_reports.rules.scene import ABSENT, UNITS_PER_M, Scene
from tracklake.schemas.arrays import Flags, Floats, Integers

SAME_PLACE_SHARE = 0.7
"""Share of the smaller of two boxes that lies in the other where two tracks are taken for one vehicle."""


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
    the other; of several overlaps the deepest. 0 = none: touching is not overlapping. NaN where the own size is
    unknown; others of unknown size are skipped.
    """
    overlaps = scene.once(find_overlaps)
    depth = np.where(overlaps.known, 0.0, np.nan)
    for rows in (overlaps.first, overlaps.second):
        np.maximum.at(depth, rows, overlaps.depth)
    return depth


def measure_double_tracks(scene: Scene) -> Floats:
    """Measure for how long an entry's vehicle shares its place with another one that shares it here, s; 0 = none.

    Two share a place where SAME_PLACE_SHARE of the smaller box lies in the other; all such frames of the two count.
    NaN where the own size is unknown.
    """
    overlaps = scene.once(find_overlaps)
    rows = _find_same_places(overlaps)
    shared = count_shared_frames(scene) if scene.whole is None else scene.whole.shared_frames
    pairs = _name_pairs(scene, rows).join(shared, on=["one", "other"], how="left", maintain_order="left")
    together = np.where(overlaps.known, 0.0, np.nan)
    for each in rows:
        np.maximum.at(together, each, pairs["frames"].to_numpy() / scene.frame_rate_hz)
    return together


def count_shared_frames(scene: Scene) -> pl.DataFrame:
    """Count the frames in which two vehicles share a place: one, other (ids, the lesser first), frames."""
    rows = _find_same_places(scene.once(find_overlaps))
    return _name_pairs(scene, rows).group_by("one", "other").agg(frames=pl.len().cast(pl.Int64))


def _find_same_places(overlaps: "Overlaps") -> Integers:
    """Find the (2, P) rows of entries that share a place."""
    same = overlaps.share >= SAME_PLACE_SHARE
    return np.stack([overlaps.first[same], overlaps.second[same]])


def _name_pairs(scene: Scene, rows: Integers) -> pl.DataFrame:
    """Return the vehicles of (2, P) rows, the lesser id of each pair first."""
    one, other = np.sort(scene.vehicle_id[rows], axis=0)
    return pl.DataFrame({"one": one, "other": other}, schema={"one": pl.Int32, "other": pl.Int32})


@dataclass(frozen=True)
class Overlaps:
    """Overlaps of two boxes in one frame, and of which entries the size is known, (N,).

    Args:
        first, second: rows of the entries, (P,).
        depth: how deep the boxes lie in each other, m, to 1 mm.
        share: share of the smaller box that lies in the other.
    """

    known: Flags
    first: Integers
    second: Integers
    depth: Floats
    share: Floats


def find_overlaps(scene: Scene) -> Overlaps:
    """Find all pairs of vehicles whose boxes overlap.

    Boxes reach back from the front centre by the length, against the heading (along the road where there is none), and
    half the width to either side.
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
    nothing = np.empty(0)
    found = [(nothing.astype(np.int64), nothing.astype(np.int64), nothing, nothing)]
    ahead, step = np.arange(1, len(rows)), 1
    while ahead.size:
        behind = ahead - step
        within = (x[behind] > rear[ahead]) & (frame[behind] == frame[ahead])
        ahead = ahead[within]
        behind = ahead - step
        meets = side[ahead] + side[behind] > np.abs(boxes.y[ahead] - boxes.y[behind])
        first, second = behind[meets], ahead[meets]
        depths = np.array([*boxes.measure_depths(first, second), *boxes.measure_depths(second, first)])
        depth = np.round(depths.min(axis=0), 3)
        deep = depth > 0
        first, second, depths = first[deep], second[deep], depths[:, deep]
        found.append((rows[first], rows[second], depth[deep], boxes.measure_share(first, second, depths)))
        step += 1
        ahead = ahead[ahead >= step]
    return Overlaps(known, *(np.concatenate(parts) for parts in zip(*found, strict=True)))


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

    def measure_depths(self, one: Integers, other: Integers) -> tuple[Floats, Floats]:
        """Measure how far two boxes overlap along and across the first, m; not above 0 = apart."""
        x, y = self.x[other] - self.x[one], self.y[other] - self.y[one]
        cosine, sine = self.cosine[one], self.sine[one]
        # Of the angle between the two boxes.
        turned = np.abs(cosine * self.cosine[other] + sine * self.sine[other])
        askew = np.abs(sine * self.cosine[other] - cosine * self.sine[other])
        length, width = self.half_length[other], self.half_width[other]
        along = self.half_length[one] + length * turned + width * askew - np.abs(x * cosine + y * sine)
        across = self.half_width[one] + length * askew + width * turned - np.abs(y * cosine - x * sine)
        return along, across

    def measure_share(self, one: Integers, other: Integers, depths: Floats) -> Floats:
        """Measure the share of the smaller of two boxes that lies in the other, as if they were parallel.

        `depths` are how far they overlap along and across the one and the other, (4, P); the greater share counts.
        """
        half = np.minimum(self.half_length[one], self.half_length[other])
        wide = np.minimum(self.half_width[one], self.half_width[other])
        area = np.minimum(
            self.half_length[one] * self.half_width[one], self.half_length[other] * self.half_width[other]
        )
        inside = np.minimum(depths[::2], 2 * half) * np.minimum(depths[1::2], 2 * wide)
        share: Floats = inside.max(axis=0) / (4 * area)
        return share


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
    if scene.whole is None:
        ends_at_bumpers = reads_bumpers(as_fronts - gap, headway - gap)
    else:
        ends_at_bumpers = scene.whole.ends_at_bumpers
    if ends_at_bumpers:
        as_fronts = np.where(np.isnan(length), np.nan, headway)
    return np.round(as_fronts, 3)


def reads_bumpers(by_fronts: Floats, by_bumpers: Floats) -> bool:
    """Return whether recorded headways end at the leader's rear, by the differences of both readings from gap_m."""
    known = ~np.isnan(by_fronts)
    if not known.any():
        return False
    fronts, bumpers = (float(np.median(np.abs(each[known]))) for each in (by_fronts, by_bumpers))
    return bumpers < fronts
