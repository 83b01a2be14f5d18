"""Neighbors of every row, from positions: the ids that the publishers' files carry."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.schemas.arrays import Integers

Number = TypeVar("Number", bound=np.generic)

NO_ROW = -1
"""Row number that means none."""
ENDS = (pl.col("x"), pl.col("x") - pl.col("length"))
"""Positions of a vehicle's front and rear."""


@dataclass(frozen=True)
class Surroundings:
    """Row numbers of the vehicles around each row, (rows,) each; NO_ROW = none.

    `leader` and `follower` are next in the own lane, by front positions. In the lanes beside it, `preceding` has its
    rear ahead of the own front, `following` its front behind the own rear, and `alongside` is the nearest between.
    """

    leader: Integers
    follower: Integers
    left_preceding: Integers
    left_alongside: Integers
    left_following: Integers
    right_preceding: Integers
    right_alongside: Integers
    right_following: Integers


def find_surroundings(tracks: pl.DataFrame) -> Surroundings:
    """Find the vehicles around each row, by vehicle, frame, lane, x (the front, in the direction of travel) and length.

    Positions are compared to three decimals, so that equal positions of a file are equal here.
    """
    frame, lane, vehicle = (tracks[name].to_numpy().astype(np.int64) for name in ("frame", "lane", "vehicle"))
    front, rear = (np.rint(tracks.select(place).to_series().to_numpy() * 1000).astype(np.int64) for place in ENDS)
    order = np.lexsort((vehicle, front, lane, frame))
    same_lane = (np.diff(frame[order]) == 0) & (np.diff(lane[order]) == 0)
    leader, follower = np.full(len(order), NO_ROW), np.full(len(order), NO_ROW)
    leader[order[:-1][same_lane]] = order[1:][same_lane]
    follower[order[1:][same_lane]] = order[:-1][same_lane]
    left = _find_beside(frame, lane, front, rear, -1)
    right = _find_beside(frame, lane, front, rear, +1)
    return Surroundings(leader, follower, *left, *right)


def _find_beside(frame: Integers, lane: Integers, front: Integers, rear: Integers, side: int) -> list[Integers]:
    """Find preceding, alongside and following rows in an adjacent lane.

    Positions become distances along one line on which every (frame, lane) has its own stretch, so that one binary
    search serves all frames.
    """
    if not len(frame):
        return [np.empty(0, np.int64)] * 3
    stretch = int(front.max() - rear.min()) + 1_000_000
    own = (frame * (int(lane.max()) + 3) + lane) * stretch - int(rear.min())
    target = own + side * stretch
    by_front, by_rear = np.argsort(own + front, kind="stable"), np.argsort(own + rear, kind="stable")
    fronts, rears = (own + front)[by_front], (own + rear)[by_rear]
    preceding = _select_inside(by_rear, np.searchsorted(rears, target + front, side="right"), own, target)
    following = _select_inside(by_front, np.searchsorted(fronts, target + rear, side="left") - 1, own, target)
    # Alongside: the nearest fronts behind and ahead of the own front that overlap lengthwise.
    near = np.searchsorted(fronts, target + front, side="left")
    alongside = np.full(len(frame), NO_ROW)
    least = np.full(len(frame), np.iinfo(np.int64).max)
    for step in (-1, 0):
        candidate = _select_inside(by_front, near + step, own, target)
        beside = (candidate >= 0) & (front[candidate] >= rear) & (rear[candidate] <= front)
        distance = np.abs(front[candidate] + rear[candidate] - front - rear)
        closer = beside & (distance < least)
        alongside[closer], least[closer] = candidate[closer], distance[closer]
    return [preceding, alongside, following]


def _select_inside(order: Integers, place: Integers, own: Integers, target: Integers) -> Integers:
    """Return the rows at positions of a sorted order, NO_ROW outside the searched lane and frame."""
    inside = (place >= 0) & (place < len(order))
    rows = order[np.clip(place, 0, len(order) - 1)]
    found: Integers = np.where(inside & (own[rows] == target), rows, NO_ROW)
    return found


def gather_values(values: npt.NDArray[Number], rows: Integers) -> npt.NDArray[Number]:
    """Gather the values at rows; 0 for NO_ROW."""
    found: npt.NDArray[Number] = np.where(rows >= 0, values[rows], np.zeros(1, dtype=values.dtype))
    return found
