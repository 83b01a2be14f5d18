"""Who drives around whom, from positions: the ids and headways that the publishers' files carry."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import polars as pl

Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Number = TypeVar("Number", bound=np.generic)

NOBODY = -1


@dataclass(frozen=True)
class Surroundings:
    """Row numbers of the vehicles around each row, NOBODY (-1) where there are none; all of shape (rows,).

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
    """Look around in every frame.

    Args:
        tracks: columns vehicle, frame, lane, x, length; x is the front, increasing in the direction of travel.
    """
    frame, lane, vehicle, front, length = (
        tracks[name].to_numpy().astype(np.float64) for name in ("frame", "lane", "vehicle", "x", "length")
    )
    order = np.lexsort((vehicle, front, lane, frame))
    same_lane = (np.diff(frame[order]) == 0) & (np.diff(lane[order]) == 0)
    leader, follower = np.full(len(order), NOBODY), np.full(len(order), NOBODY)
    leader[order[:-1][same_lane]] = order[1:][same_lane]
    follower[order[1:][same_lane]] = order[:-1][same_lane]
    left = _beside(frame, lane, front, length, -1)
    right = _beside(frame, lane, front, length, +1)
    return Surroundings(leader, follower, *left, *right)


def _beside(frame: Floats, lane: Floats, front: Floats, length: Floats, side: int) -> list[Integers]:
    """Preceding, alongside and following rows in the lane next to one's own.

    Positions become distances along one long line on which every (frame, lane) has its own stretch, so that one
    binary search serves all frames.
    """
    if not len(frame):
        return [np.empty(0, np.int64)] * 3
    stretch = float(np.ptp(front)) + 2 * float(length.max()) + 1_000.0
    lanes = lane.max() + 3
    own = (frame * lanes + lane) * stretch
    target = own + side * stretch
    rear = front - length
    by_front, by_rear = np.argsort(own + front, kind="stable"), np.argsort(own + rear, kind="stable")
    ahead = np.searchsorted((own + rear)[by_rear], target + front, side="left")
    preceding = _valid(by_rear, ahead, own, target)
    behind = np.searchsorted((own + front)[by_front], target + rear, side="left") - 1
    following = _valid(by_front, behind, own, target)
    # Alongside: of the nearest fronts at and behind, at and ahead of the own front, those that overlap lengthwise.
    near = np.searchsorted((own + front)[by_front], target + front, side="left")
    alongside = np.full(len(frame), NOBODY)
    least = np.full(len(frame), np.inf)
    for step in (-1, 0):
        candidate = _valid(by_front, near + step, own, target)
        beside = (candidate >= 0) & (front[candidate] >= rear) & (rear[candidate] <= front)
        distance = np.abs(front[candidate] - length[candidate] / 2 - front + length / 2)
        closer = beside & (distance < least)
        alongside[closer], least[closer] = candidate[closer], distance[closer]
    return [preceding, alongside, following]


def _valid(order: Integers, place: Integers, own: Floats, target: Floats) -> Integers:
    """Rows at these places of a sorted order, NOBODY where the place lies outside the searched lane and frame."""
    inside = (place >= 0) & (place < len(order))
    rows = order[np.clip(place, 0, len(order) - 1)]
    found: Integers = np.where(inside & (own[rows] == target), rows, NOBODY)
    return found


def pick(values: npt.NDArray[Number], rows: Integers) -> npt.NDArray[Number]:
    """The values at those rows, zero where there is no row."""
    found: npt.NDArray[Number] = np.where(rows >= 0, values[rows], np.zeros(1, dtype=values.dtype))
    return found
