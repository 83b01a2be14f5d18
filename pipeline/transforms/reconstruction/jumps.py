"""Jumps of recorded positions, as where one camera hands a vehicle over to the next.

A jump is one step that differs from the steps around it by more than a vehicle or the noise can explain. What lies
behind it is displaced by that difference. The displacements of a track are counted from their median, so that the
positions stay where most of its entries are.
"""

import numpy as np

from tracklake.pipeline.transforms.number_store import NumberStore, find_median
from tracklake.pipeline.transforms.reconstruction.smoothing import Series
from tracklake.schemas.arrays import Flags, Floats

LEAST_JUMP_M = 0.3
"""Least difference of a step from the steps around it, in m, that is a jump: at 10 Hz, 30 m/s2 there and back."""
LEAST_NOISE_RATIO = 6.0
"""Least ratio of a jump to the standard deviation of a step's difference from its neighbours."""
AROUND_S = 0.5
"""Time to either side from which the steps around a jump are taken, in s."""
CRAWL_MPS, CRAWL_JUMP_M = 1.0, 1.0
"""Speed around a jump, in m/s, below which it is at least this long, in m: NGSIM records vehicles that crawl in steps,
which are no jumps."""
MOST_NEAR = 2
"""Steps around a jump, itself included, that may differ by as much; a wrong position has a jump before and after."""
NORMAL_MAD = 1.4826


def find_displacements(
    series: Series, z: Floats, recorded: Flags, least_m: float | None, before_m: float = 0.0
) -> tuple[Floats, float]:
    """Return by how much jumps have displaced each position (N,), 0 for most entries of a track; and all jumps' sum.

    Args:
        series: the pieces.
        z: (N,) recorded positions, interpolated in gaps.
        recorded: (N,) which of them were recorded.
        least_m: see `find_least_jump`; None: there are no jumps.
        before_m: sum of the jumps of the pieces before these, so that rounding is as if all were given at once.
    """
    displaced = np.zeros(len(z))
    if least_m is None or not len(z):
        return displaced, before_m
    steps, beside = _measure_steps(series, z, recorded)
    candidates = np.flatnonzero(np.abs(beside) > least_m / 2)
    reach = round(AROUND_S * series.rate_hz)
    piece = np.searchsorted(series.first, candidates, side="right") - 1
    window = candidates[:, None] + np.arange(-reach, reach + 1)
    inside = (window >= series.first[piece][:, None]) & (window < (series.first + series.size - 1)[piece][:, None])
    around = np.where(inside, steps[np.clip(window, 0, len(steps) - 1)], np.nan)
    usual = np.nanmedian(around, axis=1)
    excess = steps[candidates] - usual
    near = (np.abs(around - usual[:, None]) > np.abs(excess)[:, None] / 2).sum(axis=1)
    enough = (usual * series.rate_hz > CRAWL_MPS) | (np.abs(excess) > CRAWL_JUMP_M)
    jumps = (np.abs(excess) > least_m) & enough & (near <= MOST_NEAR)
    if not jumps.any():
        return displaced, before_m
    displaced[candidates[jumps] + 1] = excess[jumps]
    total = np.cumsum(np.append(before_m, displaced))[1:]
    after_m = float(total[-1])
    total -= np.repeat(total[series.first], series.size)
    for number in np.unique(piece[jumps]):
        own = slice(series.first[number], series.first[number] + series.size[number])
        total[own] -= np.median(total[own][recorded[own]])
    return total, after_m


def measure_differences(series: Series, z: Floats, recorded: Flags) -> Floats:
    """Return how far steps differ from the mean of the two beside them, where all three are recorded."""
    beside = _measure_steps(series, z, recorded)[1]
    return np.abs(beside[~np.isnan(beside)])


def find_least_jump(differences: NumberStore, at_once: int) -> float | None:
    """Return the least jump in m among steps of such differences; None where there are none."""
    if not differences.size:
        return None
    return max(LEAST_JUMP_M, LEAST_NOISE_RATIO * NORMAL_MAD * find_median(differences, at_once))


def _measure_steps(series: Series, z: Floats, recorded: Flags) -> tuple[Floats, Floats]:
    """Return the steps between recorded positions, and how far each differs from the mean of the two beside it."""
    known = series.lie_within(1)[:-1] & recorded[:-1] & recorded[1:]
    steps = np.where(known, np.diff(z), np.nan)
    beside = np.full(len(steps), np.nan)
    beside[1:-1] = steps[1:-1] - (steps[:-2] + steps[2:]) / 2
    return steps, beside
