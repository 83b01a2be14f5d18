"""Penalised smoothing of many series at once, by one banded system of equations.

Whittaker (1923) and Eilers (2003, A Perfect Smoother, Analytical Chemistry 75, eq. 4): the positions x minimise

    sum over entries of w_i (x_i - z_i)^2  +  weight * sum of (third difference of x / dt^3)^2

z are the recorded positions, dt the time between frames. With the weight in s6 the cut-off frequency does not depend
on the frame rate: the smoother passes the share 1 / (1 + weight (2 pi f)^6) of a motion of frequency f (Hz).
Huber's weights w (1964, Robust estimation of a location parameter) by iteratively reweighted least squares make the
distance robust: linear instead of quadratic beyond a limit.
"""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers, expand_ranges

THIRD_DIFFERENCE = (-1.0, 3.0, -3.0, 1.0)
ROUNDS = 5
"""Rounds of reweighting."""


@dataclass(frozen=True)
class Series:
    """Where the pieces lie among N points, and the time between points.

    Args:
        first: (P,) first point of each piece.
        size: (P,) points of each piece.
        rate_hz: points per second.
    """

    first: Integers
    size: Integers
    rate_hz: float

    def lie_within(self, reach: int) -> Flags:
        """Test, at each of the N points, whether the point `reach` later belongs to the same piece."""
        left = np.repeat(self.first + self.size, self.size) - np.arange(int(self.size.sum()))
        return np.asarray(left > reach, np.bool_)


def select_pieces(series: Series, pieces: Integers) -> tuple[Integers, Series]:
    """Return the points of some pieces, and these pieces one after the other."""
    size = series.size[pieces]
    points, _ = expand_ranges(series.first[pieces], size)
    return points, Series(np.cumsum(size) - size, size, series.rate_hz)


def make_penalty(series: Series, weight_s6: float) -> Floats:
    """Return the (4, N) lower diagonals of weight * D'D, D being the third derivative within pieces."""
    count = int(series.size.sum())
    bands = np.zeros((4, count))
    if count < 4:
        return bands
    rows = series.lie_within(3)[: count - 3] * (weight_s6 * series.rate_hz**6)
    for a, left in enumerate(THIRD_DIFFERENCE):
        for b, right in enumerate(THIRD_DIFFERENCE[a:]):
            bands[b, a : a + count - 3] += left * right * rows
    return bands


def multiply_bands(bands: Floats, x: Floats) -> Floats:
    """Multiply the symmetric matrix of the (4, N) lower diagonals by x (N,)."""
    product: Floats = bands[0] * x
    for offset in range(1, min(4, len(x))):
        lower = bands[offset, :-offset]
        product[offset:] += lower * x[:-offset]
        product[:-offset] += lower * x[offset:]
    return product


def solve_bands(bands: Floats, right: Floats) -> Floats:
    """Solve the symmetric, positive definite system of the (4, N) lower diagonals."""
    from scipy.linalg import solveh_banded

    solved: Floats = solveh_banded(bands, right, lower=True, check_finite=False)
    return solved


def smooth(penalty: Floats, recorded: Floats, weights: Floats) -> Floats:
    """Return the positions x (N,) that minimise the weighted squared distance plus the penalty.

    The correction x - z is solved for, since it is small: positions of hundreds of metres would lose digits.
    """
    bands = penalty.copy()
    bands[0] += weights
    return recorded + solve_bands(bands, -multiply_bands(penalty, recorded))


def smooth_robustly(penalty: Floats, recorded: Floats, weights: Floats, limit_m: float) -> tuple[Floats, Floats]:
    """Smooth with Huber's distance; return the positions and the final weights, (N,) each.

    Args:
        penalty: see `make_penalty`.
        recorded: positions.
        weights: 1 where recorded, 0 where a gap is filled.
        limit_m: residual beyond which the distance is linear.
    """
    x = smooth(penalty, recorded, weights)
    robust = weights
    for _ in range(ROUNDS):
        robust = weights * np.minimum(1.0, limit_m / np.maximum(np.abs(recorded - x), limit_m))
        x = smooth(penalty, recorded, robust)
    return x, robust


def differentiate(series: Series, x: Floats) -> tuple[Floats, Floats]:
    """Return the speed and the acceleration at each point, (N,) each.

    Both are central differences: v_i = (x_(i+1) - x_(i-1)) / 2dt, a_i = (v_(i+1) - v_(i-1)) / 2dt. At the ends each
    piece goes on along the parabola through its three outermost points. So a_i = (s_(i-1) + 2 s_i + s_(i+1)) / 4, the
    mean of compact second differences s_i = (x_(i+1) - 2 x_i + x_(i-1)) / dt^2, and keeps any bound that they keep.
    """
    rate = series.rate_hz
    first, last = series.first, series.first + series.size - 1
    second = np.zeros(len(x))
    second[1:-1] = (x[2:] - 2 * x[1:-1] + x[:-2]) * rate**2
    second[first], second[last] = second[first + 1], second[last - 1]
    speed = np.zeros(len(x))
    speed[1:-1] = (x[2:] - x[:-2]) * (rate / 2)
    speed[first] = (x[first + 1] - x[first]) * rate - second[first] / (2 * rate)
    speed[last] = (x[last] - x[last - 1]) * rate + second[last] / (2 * rate)
    before, after = np.roll(second, 1), np.roll(second, -1)
    before[first], after[last] = second[first], second[last]
    return speed, (before + 2 * second + after) / 4
