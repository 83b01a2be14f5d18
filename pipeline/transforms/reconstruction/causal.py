"""Causal Kalman filter of recorded tracks: each entry is estimated from itself and earlier entries of its vehicle.

Along the road the acceleration is constant but for white-noise jerk, across it the speed is constant but for
white-noise acceleration (Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and Navigation,
6.2; the filter: 5.2.4). Noise levels are constants or the caller's, never estimated from the track: that would use its
future.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats, Integers

NOISE_X_M, NOISE_Y_M = 0.25, 0.1
"""Standard deviation of recorded positions along and across the road, in m: highD states less than 0.1 m (Krajewski et
al. 2018), NGSIM's video has a resolution of about 0.6 m (Punzo et al. 2011)."""
JERK_M2PS5 = 1.0
"""Spectral density of the jerk along the road: accelerations change by about 1 m/s2 in a second."""
LATERAL_ACCEL_M2PS3 = 0.25
"""Spectral density of the acceleration across the road: lateral speeds change by about 0.5 m/s in a second."""
START_SPEED_MPS, START_ACCEL_MPS2 = (15.0, 15.0), (0.0, 1.5)
"""Speed and acceleration along the road before anything is known of them: mean and standard deviation."""
START_LATERAL_SPEED_MPS = (0.0, 0.5)
"""Speed across the road before anything is known of it: mean and standard deviation."""
LONGEST_GAP_S = 2.0
"""Longest gap over which a track is predicted, in s; after a longer one the filter begins again."""
OUTLIER_SIGMAS = 3.0
"""Distance from the prediction, in standard deviations, from which on a position counts less."""
SPEED_RANGE_MPS = (-40.0, 100.0)
"""Least and greatest speed that tables of tracks admit: a jump of some 50 m in the recording gives no greater one."""


@dataclass(frozen=True)
class Motion:
    """Model of motion along one axis: a state of `order` derivatives (position, speed, ...).

    Args:
        density: spectral density of the white noise that drives the highest derivative.
        noise_m: standard deviation of recorded positions.
        start: mean and standard deviation of each derivative at a track's first entry.
    """

    density: float
    noise_m: float
    start: tuple[tuple[float, float], ...]

    @property
    def order(self) -> int:
        """Number of the state's parts."""
        return 1 + len(self.start)

    def make_transitions(self, step_s: Floats) -> tuple[Floats, Floats]:
        """Return the transition and the covariance of what is added, (U, n, n) each, of (U,) steps."""
        order = self.order
        move, added = np.zeros((2, len(step_s), order, order))
        for row in range(order):
            for column in range(order):
                left, right = order - 1 - row, order - 1 - column
                scale = factorial(left) * factorial(right) * (left + right + 1)
                added[:, row, column] = self.density * step_s ** (left + right + 1) / scale
                if column >= row:
                    move[:, row, column] = step_s ** (column - row) / factorial(column - row)
        return move, added


def filter_tracks(
    tracks: pl.DataFrame, facts: Mapping[str, Any], *, noise_x_m: float = NOISE_X_M, noise_y_m: float = NOISE_Y_M
) -> pl.DataFrame:
    """Estimate positions, speeds and accelerations of every entry from entries up to it.

    The first entry of a track, and the first after a gap of more than LONGEST_GAP_S, has no row: its position is the
    recorded one, and its speed is not known yet.

    Args:
        tracks: vehicle_id, frame, x_m, y_m of one subset, in any order.
        facts: the subset's row of `subsets`; frame_rate_hz is read.
        noise_x_m: standard deviation of recorded positions along the road.
        noise_y_m: standard deviation of recorded positions across the road.

    Returns:
        vehicle_id, frame, x_m, y_m, speed_mps, accel_mps2, lateral_speed_mps, sorted by the first two.
    """
    entries = tracks.select("vehicle_id", "frame", "x_m", "y_m").sort("vehicle_id", "frame")
    frames = np.diff(entries["frame"].to_numpy().astype(np.int64), prepend=0)
    same = np.diff(entries["vehicle_id"].to_numpy().astype(np.int64), prepend=-1) == 0
    rate_hz = float(facts["frame_rate_hz"])
    begins = ~(same & (frames <= LONGEST_GAP_S * rate_hz))
    step_s, step = np.unique(np.where(begins, 0, frames) / rate_hz, return_inverse=True)
    along = Motion(JERK_M2PS5, noise_x_m, (START_SPEED_MPS, START_ACCEL_MPS2))
    across = Motion(LATERAL_ACCEL_M2PS3, noise_y_m, (START_LATERAL_SPEED_MPS,))
    starts = np.flatnonzero(begins)
    x = filter_axis(entries["x_m"].to_numpy(), along, starts, step_s, step)
    y = filter_axis(entries["y_m"].to_numpy(), across, starts, step_s, step)
    return entries.select(
        "vehicle_id",
        "frame",
        x_m=pl.Series(x[:, 0]),
        y_m=pl.Series(y[:, 0]),
        speed_mps=pl.Series(x[:, 1], dtype=pl.Float32).clip(*SPEED_RANGE_MPS),
        accel_mps2=pl.Series(x[:, 2], dtype=pl.Float32),
        lateral_speed_mps=pl.Series(y[:, 1], dtype=pl.Float32),
    ).filter(~begins)


def filter_axis(position_m: Floats, motion: Motion, starts: Integers, step_s: Floats, step: Integers) -> Floats:
    """Filter the positions of many tracks along one axis: the k-th entries of all tracks at once.

    Args:
        position_m: (N,) recorded positions, track by track.
        motion: model of the motion.
        starts: (T,) first row of each track.
        step_s: (U,) different times between two entries.
        step: (N,) position in `step_s` of the time since the entry before.

    Returns:
        (N, n) states: position and its derivatives.
    """
    lengths = np.diff(starts, append=len(position_m))
    longest_first = np.argsort(-lengths, kind="stable")
    first, lengths = starts[longest_first], lengths[longest_first]
    states = np.empty((len(position_m), motion.order))
    means, sigmas = np.array([(0.0, motion.noise_m), *motion.start]).T
    state = np.tile(means, (len(starts), 1))
    state[:, 0] = position_m[first]
    covariance = np.tile(np.diag(sigmas**2), (len(starts), 1, 1))
    states[first] = state
    move, added = motion.make_transitions(step_s)
    for number in range(1, int(lengths.max(initial=0))):
        active = int(np.searchsorted(-lengths, -number))  # tracks with more than `number` entries
        rows = first[:active] + number
        transition = move[step[rows]]
        state = (transition @ state[:active, :, None])[..., 0]
        covariance = transition @ covariance[:active] @ transition.transpose(0, 2, 1) + added[step[rows]]
        state, covariance = _correct(state, covariance, position_m[rows], motion.noise_m**2)
        states[rows] = state
    return states


def _correct(state: Floats, covariance: Floats, measured: Floats, variance: float) -> tuple[Floats, Floats]:
    """Correct (V, n) states and (V, n, n) covariances by (V,) positions; outliers count less, by a larger variance."""
    surprise = measured - state[:, 0]
    column = covariance[:, :, 0]
    allowed = OUTLIER_SIGMAS**2 * (column[:, 0] + variance)
    noise = variance * np.maximum(surprise**2 / allowed, 1.0)
    gain = column / (column[:, 0] + noise)[:, None]
    return state + gain * surprise[:, None], covariance - gain[:, :, None] * column[:, None, :]
