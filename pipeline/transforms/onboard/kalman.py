"""Kalman filter and RTS smoother over many vehicles at once, and the model of motion that they share.

The state of a vehicle, in a frame that stands still on the ground (see ego.py), has nine parts:

    position x, y (m) | velocity (m/s) | acceleration (m/s2) | offset of its messages (m) | offset of its heading (rad)

Acceleration fades out (Singer 1970), driven by white noise. The offset of messages is what GPS of the vehicle and of
the ego are off by together: it fades out over OFFSET_TIME_S (a Gauss-Markov process). LiDAR measures the position
itself, messages position plus offset; so a vehicle that LiDAR has seen stays well placed once it is hidden.
Equations: Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, 5.2, 6.2
and 8.6.
"""

import numpy as np

from tracklake.schemas.arrays import Floats, Integers

STATES = 9
"""Number of the parts of a vehicle's state."""
POSITION, VELOCITY, ACCELERATION, OFFSET = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)
"""Parts of the state that are vectors (x, y)."""
HEADING_OFFSET = 8
"""Index of the heading that the vehicle sends minus its true one, in rad."""
ACCELERATION_TIME_S, ACCELERATION_MPS2 = 2.0, 1.2
"""Time over which an acceleration fades out, in s, and its standard deviation."""
OFFSET_TIME_S = 45.0
"""Time over which the offset of messages fades out, in s."""
HEADING_OFFSET_RAD, HEADING_OFFSET_TIME_S = 0.03, 60.0
"""Standard deviation of the offset of headings, in rad, and the time over which it fades out, in s."""

ODOMETRY_M, ODOMETRY_RAD = 0.01, np.radians(0.02)
"""Errors of the ego's own motion from tick to tick, in m and rad, as standard deviations."""


def make_transition(step_s: float) -> Floats:
    """Return the (9, 9) matrix that takes a state `step_s` seconds on."""
    transition = np.eye(STATES)
    for axis in range(2):
        transition[axis, 2 + axis] = step_s
        transition[axis, 4 + axis] = step_s**2 / 2
        transition[2 + axis, 4 + axis] = step_s
        transition[4 + axis, 4 + axis] = np.exp(-step_s / ACCELERATION_TIME_S)
        transition[6 + axis, 6 + axis] = np.exp(-step_s / OFFSET_TIME_S)
    transition[HEADING_OFFSET, HEADING_OFFSET] = np.exp(-step_s / HEADING_OFFSET_TIME_S)
    return transition


def make_noise(step_s: float, offset_m: Floats, odometry_m: Floats) -> Floats:
    """Return the (V, 9, 9) covariance of what a step adds.

    Args:
        step_s: length of the step.
        offset_m: (V,) standard deviation of the offset of messages.
        odometry_m: (V,) error of the ego's own motion over the step, at the vehicle's distance.
    """
    noise = np.zeros((len(offset_m), STATES, STATES))
    jerk = 2 * ACCELERATION_MPS2**2 / ACCELERATION_TIME_S
    powers = np.array(
        [
            [step_s**5 / 20, step_s**4 / 8, step_s**3 / 6],
            [step_s**4 / 8, step_s**3 / 3, step_s**2 / 2],
            [step_s**3 / 6, step_s**2 / 2, step_s],
        ]
    )
    for axis in range(2):
        noise[:, axis:6:2, axis:6:2] = jerk * powers
        noise[:, axis, axis] += odometry_m**2
        noise[:, 6 + axis, 6 + axis] = offset_m**2 * -np.expm1(-2 * step_s / OFFSET_TIME_S)
    fading = -np.expm1(-2 * step_s / HEADING_OFFSET_TIME_S)
    noise[:, HEADING_OFFSET, HEADING_OFFSET] = HEADING_OFFSET_RAD**2 * fading
    return noise


def predict(state: Floats, covariance: Floats, transition: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Take (V, n) states and their (V, n, n) covariances one step on."""
    return state @ transition.T, transition @ covariance @ transition.T + noise


def update(
    state: Floats, covariance: Floats, measured: Floats, observation: Floats, noise: Floats, *, limit: float = np.inf
) -> tuple[Floats, Floats, Floats]:
    """Correct states by measurements.

    Args:
        state: (V, n) before.
        covariance: (V, n, n) of the state.
        measured: (V, m) values.
        observation: (V, m, n) matrices that make the expected values of a state.
        noise: (V, m, m) covariance of the values.
        limit: squared Mahalanobis distance from which on a measurement counts less: its noise grows so that it has
            this distance (to first order), and an outlier does no harm.

    Returns:
        States, covariances, and the (V,) squared Mahalanobis distances of the measurements.
    """
    residual = measured - np.squeeze(observation @ state[..., None], -1)
    crossed = covariance @ np.swapaxes(observation, 1, 2)
    expected = observation @ crossed
    total = expected + noise
    distance = np.einsum("vi,vi->v", residual, np.linalg.solve(total, residual[..., None])[..., 0])
    if (distance > limit).any():
        total = expected + noise * np.maximum(distance / limit, 1.0)[:, None, None]
    gain = np.swapaxes(np.linalg.solve(total, np.swapaxes(crossed, 1, 2)), 1, 2)
    corrected = covariance - gain @ total @ np.swapaxes(gain, 1, 2)
    corrected = (corrected + np.swapaxes(corrected, 1, 2)) / 2
    return state + np.squeeze(gain @ residual[..., None], -1), corrected, distance


def compute_smoother_gains(covariance: Floats, transition: Floats, noise: Floats) -> Floats:
    """Return the (N, n, n) gains of the RTS smoother for filtered covariances and the noise of the step after them."""
    carried = transition @ covariance
    predicted = carried @ transition.T + noise
    return np.swapaxes(np.linalg.solve(predicted, carried), 1, 2)


def smooth(state: Floats, gains: Floats, transition: Floats, step_of_row: Integers, chain: Integers) -> Floats:
    """Return the (N, n) means of the RTS smoother (Rauch, Tung and Striebel 1965) over many vehicles at once.

    Args:
        state: (N, n) filtered states, sorted by step, then by chain.
        gains: (N, n, n) of `compute_smoother_gains`.
        transition: (n, n) matrix of a step.
        step_of_row: (N,) step of each row.
        chain: (N,) number of the filter that the row is of; a filter's rows follow each other without a gap.
    """
    smoothed = state.copy()
    starts = np.flatnonzero(np.diff(step_of_row, prepend=-1))
    ends = np.append(starts[1:], len(state))
    for first, middle, last in zip(starts[-2::-1], ends[-2::-1], ends[:0:-1], strict=True):
        if step_of_row[middle] != step_of_row[first] + 1:
            continue
        now, after = chain[first:middle], chain[middle:last]
        place = np.searchsorted(after, now)
        here = np.flatnonzero(after[np.minimum(place, len(after) - 1)] == now)
        rows, later = first + here, middle + place[here]
        change = smoothed[later] - state[rows] @ transition.T
        smoothed[rows] += np.squeeze(gains[rows] @ change[..., None], -1)
    return smoothed
