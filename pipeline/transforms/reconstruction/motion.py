"""Positions along the road within the bounds of motion.

Pieces whose smoothed track breaks a bound are solved again, as quadratic programs under the bounds. Bounds hold for
compact differences, of which the written speeds and accelerations are means (see `differentiate`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.transforms.number_store import NumberStore
from tracklake.pipeline.transforms.reconstruction.bounds import Limits, find_breaks, measure_motion
from tracklake.pipeline.transforms.reconstruction.programs import Rows, solve_programs
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, make_penalty, select_pieces
from tracklake.schemas.arrays import Floats, Integers

MARGIN = 0.99
"""Share of each bound that programs use, so that the written values keep the whole of it."""
CREEP_MPS = 2e-6
"""Least speed that programs use, in m/s, so that rounding moves nothing backward: 2 mm in a quarter of an hour."""
BATCH_POINTS = 20_000
"""Points of the programs that are solved together; more would not fit a processor's cache."""
ROUNDS = 10
"""Most times that a piece is solved, since the greatest acceleration depends on the speed that comes out."""


@dataclass(frozen=True)
class Problem:
    """Smoothed pieces, and what their programs minimise.

    Args:
        series: the pieces.
        smoothed: (N,) positions without bounds.
        weights: (N,) weights of the recorded positions.
        weight_s6: weight of the penalty.
    """

    series: Series
    smoothed: Floats | NumberStore
    weights: Floats | NumberStore
    weight_s6: float

    def solve(
        self, pieces: Integers, x: Floats | NumberStore, make_rows: Callable[[Series, Integers], list[Rows]]
    ) -> None:
        """Write the positions of some pieces within their rows into x; a piece without a solution stays as it is."""
        if not pieces.size:
            return
        batch = (np.cumsum(self.series.size[pieces]) - 1) // BATCH_POINTS
        for number in np.unique(batch):
            self._solve_together(pieces[batch == number], x, make_rows)

    def _solve_together(
        self, pieces: Integers, x: Floats | NumberStore, make_rows: Callable[[Series, Integers], list[Rows]]
    ) -> None:
        """Solve the programs of some pieces at once, and those without a solution again by themselves."""
        points, series = select_pieces(self.series, pieces)
        bands = make_penalty(series, self.weight_s6)
        bands[0] += self.weights[points]
        way, solved = solve_programs(bands, make_rows(series, points), series.first, series.size)
        done = np.repeat(solved, series.size)
        x[points[done]] = (self.smoothed[points] + way)[done]
        if len(pieces) > 1:
            for piece in pieces[~solved]:
                self._solve_together(np.array([piece]), x, make_rows)


def bound_motion(problem: Problem, limit: Callable[[Floats], Limits]) -> tuple[Floats, Limits]:
    """Return positions (N,) within the bounds of motion, and the bounds at their speeds.

    Args:
        problem: the smoothed pieces.
        limit: positions (N,) to the bounds at their speeds.
    """
    x = np.array(problem.smoothed[:])
    limits = limit(x)
    for _ in range(ROUNDS):
        pieces = find_broken_pieces(problem.series, x, limits)
        if not pieces.size:
            break

        def make_rows(series: Series, points: Integers, limits: Limits = limits) -> list[Rows]:
            return make_motion_rows(series, problem.smoothed[points], limits.at(points))

        problem.solve(pieces, x, make_rows)
        limits = limits.lower_to(limit(x))
    return x, limits


def find_broken_pieces(series: Series, x: Floats, limits: Limits) -> Integers:
    """Find the pieces with a point that breaks a bound of motion."""
    broken = np.logical_or.reduce(list(find_breaks(measure_motion(series, x), limits).values()))
    return np.flatnonzero(np.logical_or.reduceat(broken, series.first))


def make_motion_rows(series: Series, x: Floats, limits: Limits) -> list[Rows]:
    """Return the rows that keep pieces within the bounds of motion.

    The bound of a compact difference is the least of those of the points that it has a part in.

    Args:
        series: the pieces that are solved.
        x: (N,) their smoothed positions.
        limits: bounds at their points.
    """
    rate, accel, braking, jerk = series.rate_hz, limits.accel_mps2, limits.braking_mps2, limits.jerk_mps3
    one, two, three = series.lie_within(1)[:-1], series.lie_within(2)[:-2], series.lie_within(3)[:-3]
    second, third = np.diff(x, 2) * rate**2, np.diff(x, 3) * rate**3
    least = MARGIN * np.minimum(accel[1:-1], np.minimum(accel[:-2], accel[2:]))
    up, down = (rate**2, -2 * rate**2, rate**2), (-(rate**2), 2 * rate**2, -(rate**2))
    rise, fall = (-(rate**3), 3 * rate**3, -3 * rate**3, rate**3), (rate**3, -3 * rate**3, 3 * rate**3, -(rate**3))
    first, last = series.first, series.first + series.size - 3
    every = np.ones(len(first), bool)
    starting = (-3 * x[first] + 4 * x[first + 1] - x[first + 2]) * (rate / 2) - CREEP_MPS
    ending = (x[last] - 4 * x[last + 1] + 3 * x[last + 2]) * (rate / 2) - CREEP_MPS
    return [
        Rows((rate, -rate), np.diff(x) * rate - CREEP_MPS, one, 1.0),
        Rows(up, least - second, two, 1.0),
        Rows(down, MARGIN * braking[1:-1] + second, two, 1.0),
        Rows(rise, MARGIN * jerk[:-3] - third, three, 5.0),
        Rows(fall, MARGIN * jerk[:-3] + third, three, 5.0),
        Rows((1.5 * rate, -2 * rate, 0.5 * rate), starting, every, 1.0, at=first),
        Rows((-0.5 * rate, 2 * rate, -1.5 * rate), ending, every, 1.0, at=last),
    ]
