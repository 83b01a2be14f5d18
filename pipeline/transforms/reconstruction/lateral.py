"""Positions across the road: bounded lateral acceleration, one way through a lane change."""

from functools import partial

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.reconstruction.motion import MARGIN, Problem
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces
from tracklake.pipeline.transforms.reconstruction.programs import Rows
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate
from tracklake.schemas.arrays import Floats, Integers

REACH_S = 4.0
"""Longest time from the beginning of a lane change to the crossing of the marking, and from there to its end, in s."""
NO_LANE = -1


def find_lane_changes(pieces: Pieces, series: Series, y: Floats) -> Integers:
    """Return, for each step to the next point (N,), its direction within a lane change: +1 right, -1 left, 0 none.

    A lane change begins where the track is farthest to the side it comes from, within REACH_S before the lane changes,
    and ends where it is farthest to the other side within REACH_S after; neither reaches beyond the middle of the time
    to the next or the last lane change.
    """
    lane = pieces.tracks["lane"].cast(pl.Int64).fill_null(NO_LANE).to_numpy()[pieces.row]
    direction = np.zeros(len(y), np.int64)
    step = np.flatnonzero((lane[1:] != lane[:-1]) & (lane[1:] != NO_LANE) & (lane[:-1] != NO_LANE))
    step = step[series.lie_within(1)[step]]
    if not step.size:
        return direction
    side = np.sign(lane[step + 1] - lane[step])
    piece = np.searchsorted(series.first, step, side="right") - 1
    reach = round(REACH_S * series.rate_hz)
    same = np.diff(piece) == 0
    middle = (step[1:] + step[:-1]) // 2
    low, high = series.first[piece].copy(), series.first[piece] + series.size[piece] - 1
    low[1:][same], high[:-1][same] = middle[same] + 1, middle[same]
    offsets = np.arange(reach + 1)
    before = np.maximum(step[:, None] - offsets, low[:, None])
    after = np.minimum(step[:, None] + 1 + offsets, high[:, None])
    begin = before[np.arange(len(step)), np.argmin(side[:, None] * y[before], axis=1)]
    end = after[np.arange(len(step)), np.argmax(side[:, None] * y[after], axis=1)]
    change = np.zeros(len(y) + 1, np.int64)
    np.add.at(change, begin, side)
    np.add.at(change, end, -side)
    return np.asarray(np.sign(np.cumsum(change[:-1])), np.int64)


def bound_lateral(problem: Problem, direction: Integers, accel_mps2: float) -> Floats:
    """Return lateral positions (N,) that go one way through lane changes, with bounded accelerations.

    Args:
        problem: the smoothed pieces.
        direction: see `find_lane_changes`.
        accel_mps2: greatest lateral acceleration, of either sign.
    """
    y = np.array(problem.smoothed[:])
    back = np.zeros(len(y), bool)
    back[:-1] = direction[:-1] * np.diff(y) < 0
    broken = back | (np.abs(differentiate(problem.series, y)[1]) > accel_mps2)
    pieces = np.flatnonzero(np.logical_or.reduceat(broken, problem.series.first))
    problem.solve(pieces, y, partial(_make_rows, problem, direction, accel_mps2))
    return y


def _make_rows(
    problem: Problem, direction: Integers, accel_mps2: float, series: Series, points: Integers
) -> list[Rows]:
    rate, y = series.rate_hz, problem.smoothed[points]
    steps, second = np.diff(y) * rate, np.diff(y, 2) * rate**2
    within, two, side = series.lie_within(1)[:-1], series.lie_within(2)[:-2], direction[points][:-1]
    return [
        Rows((rate, -rate), steps, within & (side > 0), 1.0),
        Rows((-rate, rate), -steps, within & (side < 0), 1.0),
        Rows((rate**2, -2 * rate**2, rate**2), MARGIN * accel_mps2 - second, two, 1.0),
        Rows((-(rate**2), 2 * rate**2, -(rate**2)), MARGIN * accel_mps2 + second, two, 1.0),
    ]
