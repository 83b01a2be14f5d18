"""Headings of vehicles, from the velocities that a source records."""

import numpy as np
from numpy.typing import NDArray

from tracklake.schemas.arrays import Floats

SMOOTHED_S = 0.2
"""Time over which velocities are averaged, in s: the entries within half of it before and after."""
MOVING_MPS = 2.0
"""Least smoothed speed at which the velocity tells where a vehicle points, in m/s."""


def find_headings(
    vehicle: NDArray[np.integer], frame: NDArray[np.integer], forward_mps: Floats, right_mps: Floats, rate_hz: float
) -> tuple[Floats, Floats]:
    """Find the cosine and the sine of each entry's heading, which is 0 along the road and positive to the right.

    It is the direction of the velocity, averaged over the entries within 0.1 s before and after; frame gaps are not
    bridged. Below 2 m/s, and where a vehicle drives backwards, its last heading holds; before the first one it is 0.

    All arrays are (N,): `vehicle` sorted, `frame` increasing within a vehicle, velocities in the direction of travel
    and to the driver's right.
    """
    count = len(vehicle)
    if not count:
        return np.empty(0), np.empty(0)
    reach = int(SMOOTHED_S / 2 * rate_hz + 1e-6)
    window = np.arange(-reach, reach + 1)
    # The ends of tracks and the rows beside gaps lack some entries of the window.
    begins = np.flatnonzero((vehicle[1:] != vehicle[:-1]) | (frame[1:] - frame[:-1] != 1)) + 1
    edges = np.concatenate([[0], begins, [count]])
    row = np.unique(np.clip(edges[:, None] + window, 0, count - 1))
    other = np.clip(row[:, None] + window, 0, count - 1)
    # So many rows and frames apart, two entries of a vehicle have no gap between them.
    linked = (other == row[:, None] + window) & (frame[other] - frame[row, None] == window)
    linked &= vehicle[other] == vehicle[row, None]
    entries = np.full(count, float(len(window)))
    entries[row] = linked.sum(axis=1)
    forward, right = (np.convolve(values, np.ones(len(window)))[reach:][:count] for values in (forward_mps, right_mps))
    forward[row], right[row] = (np.sum(linked * values[other], axis=1) for values in (forward_mps, right_mps))
    speed = np.sqrt(forward**2 + right**2)
    tells = (speed >= MOVING_MPS * entries) & (forward > 0)
    held = np.flatnonzero(~tells)
    speed[held] = 1.0
    cosine, sine = forward / speed, right / speed
    if held.size:
        last = np.maximum.accumulate(np.where(tells, np.arange(count), 0))[held]
        known = tells[last] & (vehicle[last] == vehicle[held])
        cosine[held] = np.where(known, cosine[last], 1.0)
        sine[held] = np.where(known, sine[last], 0.0)
    return cosine, sine
