"""Carriageways of a recording that does not name them: directions of travel, and the lanes on a road axis."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats, Integers

COMPASS = ("east", "north", "west", "south")
"""Directions by quarter turns counterclockwise from east."""
PIECE_M = 10.0
"""Length of the pieces of an axis in which lanes are counted, in m."""
APART_M = 1.8
"""Least distance of two lanes' middles, in m; where lanes part or join, two lie closer and are one."""
MAIN_SHARE = 0.9
"""Least share of the pieces with lanes in which a main lane exists."""
MAX_DRIFT_M = 0.5
"""Greatest range of a lane's middle, of its pieces' middle four fifths, at which it has markings, in m."""


@dataclass(frozen=True)
class LaneLayout:
    """The lanes of one carriageway.

    Args:
        lanes: lanelet and lane, 1 the leftmost.
        main: number of main lanes; None where no lanelet is known.
        others: lanes right of the main ones: ramps, and lanes that join or leave.
        left_m: the carriageway's left edge, to the right of the axis.
        markings_m: markings of the main lanes, from the left edge; None where they are not parallel to the axis.
    """

    lanes: pl.DataFrame
    main: int | None
    others: list[int]
    left_m: float
    markings_m: list[float] | None


NO_LANES = LaneLayout(pl.DataFrame(schema={"lanelet": pl.Int64, "lane": pl.Int16}), None, [], 0.0, None)
"""Layout of a carriageway of which no lanelet is known."""


def part_directions(angle_rad: Floats) -> Integers:
    """Part vehicles by their mean direction of travel (N,) into one way (0) and the opposite one (1)."""
    # Opposite directions are equal when doubled.
    axis = np.arctan2(np.sin(2 * angle_rad).sum(), np.cos(2 * angle_rad).sum()) / 2
    backwards: Integers = (np.cos(angle_rad - axis) < 0).astype(np.int64)
    return backwards


def name_direction(angle_rad: Floats) -> str:
    """Name the point of the compass that is nearest to the mean of directions (N,)."""
    mean = np.arctan2(np.sin(angle_rad).sum(), np.cos(angle_rad).sum())
    return COMPASS[round(mean / (np.pi / 2)) % 4]


def name_movements(start_rad: Floats, end_rad: Floats) -> list[str]:
    """Name each vehicle's way over a junction by where it comes from and goes to, such as `south-to-east`.

    The arms are taken to be square to each other; the compass is turned by up to an eighth to fit them.

    Args:
        start_rad: (N,) directions in which the vehicles enter, counterclockwise from east.
        end_rad: (N,) directions in which they leave.
    """
    both = np.concatenate([start_rad, end_rad])
    turned = np.arctan2(np.sin(4 * both).sum(), np.cos(4 * both).sum()) / 4
    arms = np.rint((np.stack([start_rad + np.pi, end_rad]) - turned) / (np.pi / 2)).astype(np.int64) % 4
    return [f"{COMPASS[origin]}-to-{COMPASS[target]}" for origin, target in arms.T]


def find_lanes(points: pl.DataFrame) -> LaneLayout:
    """Number the lanelets along a carriageway from the left.

    In each piece of PIECE_M lanes are counted from the left; a lanelet's lane is the greatest number that it has in
    more than a tenth of its pieces, since a lane to its left may be out of use. A lanelet is there in all pieces
    between its first and its last.

    Args:
        points: lanelet, along_m, right_m of points of the lane's middle, and width_m there.
    """
    seen = (
        points.drop_nulls()
        .with_columns(piece=(pl.col("along_m") / PIECE_M).floor().cast(pl.Int64))
        .group_by("lanelet", "piece")
        .agg(pl.col("right_m", "width_m").median())
    )
    if seen.is_empty():
        return NO_LANES
    piece = pl.col("piece")
    whole = seen.group_by("lanelet").agg(piece=pl.int_ranges(piece.min(), piece.max() + 1)).explode("piece")
    lanes = (
        whole.join(seen, on=["lanelet", "piece"], how="left")
        .sort("lanelet", "piece")
        .with_columns(pl.col("right_m", "width_m").interpolate().over("lanelet"))
        .sort("piece", "right_m", "lanelet")
        .with_columns(rank=(pl.col("right_m").diff() > APART_M).fill_null(value=False).cum_sum().over("piece") + 1)
    )
    rank = pl.col("rank").quantile(0.9, "higher").cast(pl.Int16)
    numbers = lanes.group_by("lanelet").agg(lane=rank).sort("lanelet")
    lanes = lanes.join(numbers, on="lanelet").group_by("lane", "piece").agg(pl.col("right_m", "width_m").median())
    pieces = lanes["piece"].n_unique()
    shares = dict(lanes.group_by("lane").agg(pl.len() / pieces).iter_rows())
    # A lane that begins or ends on the left is a main one, as there are main lanes to its right.
    main = max((lane for lane, share in shares.items() if share >= MAIN_SHARE), default=1)
    return LaneLayout(
        numbers,
        main,
        sorted(lane for lane in shares if lane > main),
        lanes.filter(lane=1).select((pl.col("right_m") - pl.col("width_m") / 2).median()).item(),
        _find_markings(lanes.filter(pl.col("lane") <= main)),
    )


def _find_markings(lanes: pl.DataFrame) -> list[float] | None:
    """Find the markings of lanes by their middles and widths in pieces; None where a lane drifts off the axis."""
    middle = pl.col("right_m")
    each = (
        lanes.group_by("lane")
        .agg(
            drift=middle.quantile(0.9, "linear") - middle.quantile(0.1, "linear"),
            left=(middle - pl.col("width_m") / 2).median(),
            right=(middle + pl.col("width_m") / 2).median(),
        )
        .sort("lane")
    )
    if each.is_empty() or float(each.select(pl.col("drift").max()).item()) > MAX_DRIFT_M:
        return None
    left, right = each["left"].to_list(), each["right"].to_list()
    inner = [(a + b) / 2 for a, b in zip(right[:-1], left[1:], strict=True)]
    markings = [round(y - left[0], 3) for y in (left[0], *inner, right[-1])]
    return markings if all(b > a for a, b in pairwise(markings)) else None
