"""Methods of smoothing tracks that the literature uses, with which the reconstruction is compared.

Each takes positions of many tracks one after the other, and returns positions, speeds and accelerations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.signal

from tracklake.schemas.arrays import Floats, Integers


@dataclass(frozen=True)
class Motion:
    """Positions in m, speeds in m/s and accelerations in m/s2, (rows,) each."""

    x: Floats
    speed: Floats
    accel: Floats


@dataclass(frozen=True)
class Runs:
    """Runs of rows that are one vehicle's in consecutive frames: the first row and the number of rows of each."""

    begins: Integers
    lengths: Integers
    rate_hz: float


Smooth = Callable[[Floats, Runs, float], Motion]
"""Method of one parameter, by positions and runs."""


def find_runs(vehicle: Integers, frame: Integers, rate_hz: float) -> Runs:
    """Find the runs of rows that are sorted by vehicle and frame."""
    breaks = (np.diff(vehicle, prepend=vehicle[:1] - 1) != 0) | (np.diff(frame, prepend=frame[:1] - 2) != 1)
    begins = np.flatnonzero(breaks)
    return Runs(begins, np.diff(begins, append=len(vehicle)), rate_hz)


def differentiate(values: Floats, runs: Runs) -> Floats:
    """Compute rates of change between the rows before and after each, one-sided at the ends of runs."""
    rows = np.arange(len(values))
    first = np.repeat(runs.begins, runs.lengths)
    last = first + np.repeat(runs.lengths, runs.lengths) - 1
    before, after = np.maximum(rows - 1, first), np.minimum(rows + 1, last)
    rates: Floats = (values[after] - values[before]) * runs.rate_hz / np.maximum(after - before, 1)
    return rates


def average(values: Floats, runs: Runs, weights: Floats) -> Floats:
    """Average symmetrically with weights by distance in rows; the window shrinks towards the ends of a run."""
    rows = np.arange(len(values))
    first = np.repeat(runs.begins, runs.lengths)
    last = first + np.repeat(runs.lengths, runs.lengths) - 1
    reach = np.minimum(rows - first, last - rows)
    total, weight = values * weights[0], np.full(len(values), weights[0])
    for distance in range(1, len(weights)):
        inside = np.flatnonzero(reach >= distance)
        total[inside] += weights[distance] * (values[inside - distance] + values[inside + distance])
        weight[inside] += 2 * weights[distance]
    return total / weight


def average_moving(x: Floats, runs: Runs, seconds: float) -> Motion:
    """Average positions over a window of `seconds`, and differentiate the result twice."""
    smooth = average(x, runs, np.ones(1 + round(seconds * runs.rate_hz / 2)))
    speed = differentiate(smooth, runs)
    return Motion(smooth, speed, differentiate(speed, runs))


def average_exponentially(values: Floats, runs: Runs, seconds: float) -> Floats:
    """Average with exponential weights of width `seconds`, cut off at three widths (Thiemann et al. 2008)."""
    width = seconds * runs.rate_hz
    return average(values, runs, np.exp(-np.arange(1 + round(3 * width)) / width))


def fit_savitzky_golay(x: Floats, runs: Runs, seconds: float) -> Motion:
    """Fit cubic polynomials to windows of `seconds`; speeds and accelerations are the polynomials' derivatives."""
    window = 2 * round(seconds * runs.rate_hz / 2) + 1
    found = [np.empty(len(x)) for _ in range(3)]
    speed = differentiate(x, runs)
    plain = (x, speed, differentiate(speed, runs))
    for begin, length in zip(runs.begins, runs.lengths, strict=True):
        rows, own = slice(begin, begin + length), min(window, length - (length + 1) % 2)
        for order, values in enumerate(found):
            if own < 5:
                values[rows] = plain[order][rows]
            else:
                values[rows] = scipy.signal.savgol_filter(x[rows], own, 3, deriv=order, delta=1 / runs.rate_hz)
    return Motion(*found)


def smooth_kalman(x: Floats, runs: Runs, jerk_density: float) -> Motion:
    """Smooth by a Kalman filter of constant acceleration and its Rauch-Tung-Striebel backward pass.

    `jerk_density` is that of the white jerk, in m2/s5 for measurements of variance 1 m2; only the ratio counts.
    Gains depend on the row's number only, so that all runs are filtered at once.
    """
    step = 1 / runs.rate_hz
    transition = np.array([[1, step, step**2 / 2], [0, 1, step], [0, 0, 1]])
    process = jerk_density * np.array(
        [
            [step**5 / 20, step**4 / 8, step**3 / 6],
            [step**4 / 8, step**3 / 3, step**2 / 2],
            [step**3 / 6, step**2 / 2, step],
        ]
    )
    order = np.argsort(-runs.lengths, kind="stable")
    begins, lengths = runs.begins[order], runs.lengths[order]
    longest = int(lengths[0])
    alive = [int(np.searchsorted(-lengths, -number, side="left")) for number in range(longest)]
    covariance = np.diag([1.0, 1e4, 1e2])
    second = x[np.minimum(begins + 1, begins + lengths - 1)]
    state = np.stack([x[begins], (second - x[begins]) / step, np.zeros(len(begins))], axis=1)
    states, gains = [state], []
    for number in range(1, longest):
        predicted = transition @ covariance @ transition.T + process
        gains.append(np.linalg.solve(predicted, transition @ covariance).T)
        kalman = predicted[:, 0] / (predicted[0, 0] + 1)
        covariance = predicted - np.outer(kalman, predicted[0])
        state = state[: alive[number]] @ transition.T
        state = state + (x[begins[: alive[number]] + number] - state[:, 0])[:, None] * kalman
        states.append(state)
    found = np.empty((len(x), 3))
    later = states[-1]
    found[begins[: len(later)] + longest - 1] = later
    for number in range(longest - 2, -1, -1):
        now = states[number].copy()
        now[: len(later)] += (later - now[: len(later)] @ transition.T) @ gains[number].T
        later = now
        found[begins[: len(now)] + number] = now
    return Motion(found[:, 0], found[:, 1], found[:, 2])
