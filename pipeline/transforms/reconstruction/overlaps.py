"""Overlaps of reconstructed vehicles with any vehicle ahead, frame by frame."""

import numpy as np

from tracklake.schemas.arrays import Floats, Integers


def measure_overlaps(
    frame: Integers, lane: Integers, x: Floats, y: Floats, length_m: Floats, width_m: Floats
) -> Floats:
    """Return how deep each point (N,) is in a vehicle ahead of it, whether its leader or not, as -m; else NaN.

    The depth is the lesser of the two along and across the road. Vehicles of unknown widths overlap in one lane only.
    Points whose x is NaN overlap nothing; all points of a frame are given.
    """
    known = np.flatnonzero(np.isfinite(x))
    order = known[np.lexsort((x[known], frame[known]))]
    found = np.full(len(x), np.nan)
    ahead, step = np.arange(1, len(order)), 1
    while ahead.size:
        first, second = order[ahead], order[ahead - step]
        gap_m = x[first] - length_m[first] - x[second]
        near = (frame[first] == frame[second]) & (gap_m < 0)
        ahead, first, second, gap_m = ahead[near], first[near], second[near], gap_m[near]
        apart_m = np.abs(y[first] - y[second]) - (width_m[first] + width_m[second]) / 2
        apart_m = np.where(np.isnan(apart_m), np.where(lane[first] == lane[second], -np.inf, np.inf), apart_m)
        found[second] = np.fmin(found[second], np.where(apart_m < 0, np.maximum(gap_m, apart_m), np.nan))
        step += 1
        ahead = ahead[ahead >= step]
    return found
