"""Assignment of vehicles that send messages to vehicles that LiDAR sees, where it is not obvious.

Messages may be off by more than a lane, so a cluster beside the place that a message names can be another vehicle's. A
station whose place is uncertain is therefore held back from LiDAR while others are near: its neighbors become tracks of
LiDAR alone, and stations and tracks are compared as a whole (track-to-track association; Bar-Shalom, Li and
Kirubarajan 2001). All messages are off by the error of the ego's own position alike: the assignment is sought together
with that common shift, and made only where the next best one is clearly worse.
"""

import numpy as np

from tracklake.pipeline.transforms.onboard.kalman import OFFSET, POSITION
from tracklake.pipeline.transforms.onboard.tracks import TENTATIVE, Tracks
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.perception import FIRST_LIDAR_ID

LOOSE_M2 = 1.0
"""Sum of the variances of x and y from which on a station's place is uncertain, in m2."""
NEAR, SAME = 13.8, 18.5
"""Squared Mahalanobis distances that two places can have (1 in 1,000), and two places with velocities."""
CLEAR = 4.0
"""Squared Mahalanobis distance by which the next best assignment must be worse."""
MOST_SHIFTS = 60
"""Common shifts that are tried at most."""
STRIKES = 10
"""Messages in a row that contradict LiDAR before the two are taken for different vehicles."""
FARTHEST_OFFSET = 4.5
"""Offset of messages, in standard deviations, that is not believed."""


def is_station(tracks: Tracks) -> Flags:
    """Tell which tracks are of vehicles that send messages."""
    return (tracks.vehicle_id >= 0) & (tracks.vehicle_id < FIRST_LIDAR_ID)


def is_loose(tracks: Tracks) -> Flags:
    """Tell which tracks are of stations whose place is uncertain."""
    return is_station(tracks) & (tracks.covariance[:, 0, 0] + tracks.covariance[:, 1, 1] > LOOSE_M2)


def find_held(tracks: Tracks, tick: int) -> Flags:
    """Tell which stations LiDAR may not be assigned to at a tick: uncertain ones near other vehicles."""
    loose = is_loose(tracks)
    held = loose & (tracks.held_until >= tick)
    rows = np.flatnonzero(loose)
    if rows.size and len(loose) > 1:
        away = tracks.state[rows, None, POSITION] - tracks.state[None, :, POSITION]
        total = tracks.covariance[rows, None, POSITION, POSITION] + tracks.covariance[None, :, POSITION, POSITION]
        near = _square(away, total) < NEAR
        near[np.arange(rows.size), rows] = False
        held[rows] |= near.any(1)
    return held


def match_stations(tracks: Tracks, heard: Flags) -> Integers:
    """Return (N, 2) rows of LiDAR tracks and stations that are clearly one vehicle by the present states.

    Args:
        tracks: tracks of a tick.
        heard: (V,) whether a message arrived lately.
    """
    lidar = np.flatnonzero(tracks.vehicle_id >= FIRST_LIDAR_ID)
    stations = np.flatnonzero(is_loose(tracks) & heard)
    none = np.empty((0, 2), dtype=np.int64)
    if not lidar.size or not stations.size:
        return none
    away, total = _compare(tracks, lidar, stations)
    near = _square(away[..., :2], total[..., :2, :2]) < NEAR
    lidar, stations = lidar[near.any(1)], stations[near.any(0)]
    if not lidar.size:
        return none
    away, total = away[near.any(1)][:, near.any(0)], total[near.any(1)][:, near.any(0)]
    common_m2 = float(np.median(tracks.offset_m[stations]) ** 2) / 2
    known_m, rest_m2 = _find_common_shift(tracks, common_m2)
    total[..., [0, 1], [0, 1]] -= np.minimum(common_m2, 0.5 * tracks.offset_m[stations] ** 2)[None, :, None]
    pairs, cost = _try_shifts(away, total, known_m, rest_m2)
    best = int(np.argmin(cost))
    rivals = np.where(pairs == pairs[best], np.inf, cost[:, None]).min(0)  # the best that has another partner, (S,)
    good = np.flatnonzero((pairs[best] >= 0) & (rivals - cost[best] >= CLEAR))
    return np.stack((lidar[pairs[best, good]], stations[good]), 1)


def _compare(tracks: Tracks, lidar: Integers, stations: Integers) -> tuple[Floats, Floats]:
    """Return (L, S, 4) differences of places and velocities, LiDAR minus station, and their (L, S, 4, 4) covariances.

    Where LiDAR has seen the rear only, the centre follows from the length, which the station knows.
    """
    away = tracks.state[lidar, None, :4] - tracks.state[None, stations, :4]
    away[..., :2] += compute_size_shift(tracks, lidar, stations)
    total = tracks.covariance[lidar, None, :4, :4] + tracks.covariance[None, stations, :4, :4]
    total[..., [0, 1], [0, 1]] += 0.2**2
    return away, total


def compute_size_shift(tracks: Tracks, lidar: Integers, stations: Integers) -> Floats:
    """Return by how much (L, S, 2) centres that LiDAR found move, in m, if the vehicles have the stations' lengths."""
    sent, used = tracks.size_m[stations, 0], tracks.size_m[lidar, 0]
    longer = np.nan_to_num(sent[None, :] - used[:, None]) * tracks.sized[stations][None, :] / 2
    sign = np.select([tracks.side[lidar] == 0, tracks.side[lidar] == 1], [1.0, -1.0], 0.0)[:, None]
    heading = tracks.heading_rad[stations][None, :]
    shift: Floats = (longer * sign)[..., None] * np.stack((np.cos(heading), np.sin(heading)), -1)
    return shift


def _find_common_shift(tracks: Tracks, common_m2: float) -> tuple[Floats, float]:
    """Return the shift that stations' messages have in common, by those that LiDAR sees, and its variance."""
    settled = is_station(tracks) & ~is_loose(tracks)
    offsets = tracks.state[settled, OFFSET]
    count = len(offsets)
    return offsets.sum(0) / (count + 1), common_m2 / (count + 1)


def _try_shifts(away: Floats, total: Floats, known_m: Floats, rest_m2: float) -> tuple[Integers, Floats]:
    """Assign stations to LiDAR tracks under each of several common shifts.

    Returns:
        (K, S) LiDAR track of each station, -1 for none, and the (K,) costs: squared Mahalanobis distances, those of the
        shifts included; a station without a track costs SAME.
    """
    from scipy.optimize import linear_sum_assignment

    stations = away.shape[1]
    shifts = np.concatenate((known_m[None], -away[..., :2].reshape(-1, 2)))
    prior = ((shifts - known_m) ** 2).sum(1) / rest_m2
    chosen = np.argsort(prior, kind="stable")[:MOST_SHIFTS]
    shifts, cost = shifts[chosen], prior[chosen]
    moved = np.broadcast_to(away, (len(shifts), *away.shape)).copy()
    moved[..., :2] += shifts[:, None, None]
    distance = np.minimum(_square(moved, np.broadcast_to(total, (len(shifts), *total.shape))), SAME)
    pairs = np.full((len(shifts), stations), -1)
    for number, square in enumerate(distance):
        rows, columns = linear_sum_assignment(square)
        good = square[rows, columns] < SAME
        pairs[number, columns[good]] = rows[good]
        cost[number] += square[rows[good], columns[good]].sum() + SAME * (stations - good.sum())
    return pairs, cost


def find_contradicted(tracks: Tracks) -> Flags:
    """Tell which stations were assigned another vehicle's clusters: their messages contradict what LiDAR sees."""
    far = np.hypot(*tracks.state[:, OFFSET].T) > FARTHEST_OFFSET * tracks.offset_m
    contradicted: Flags = is_station(tracks) & ~is_loose(tracks) & (far | (tracks.strikes >= STRIKES))
    return contradicted


def merge_stations(tracks: Tracks, pairs: Integers) -> Tracks:
    """Let stations take over the LiDAR tracks that they are: (N, 2) rows of LiDAR track and station."""
    lidar, station = pairs.T
    diagonal = np.arange(len(lidar))
    tracks.state[lidar, POSITION] += compute_size_shift(tracks, lidar, station)[diagonal, diagonal]
    for name in ("vehicle_id", "offset_m", "steering_angle_deg", "sized", "message_s", "heard"):
        getattr(tracks, name)[lidar] = getattr(tracks, name)[station]
    own = tracks.size_m[station]
    tracks.size_m[lidar] = np.where(np.isnan(own), tracks.size_m[lidar], own)
    tracks.rival[lidar], tracks.rivalry[lidar], tracks.strikes[lidar] = TENTATIVE, 0, 0
    keep = np.ones(len(tracks.chain), dtype=bool)
    keep[station] = False
    return tracks.take(keep)


def _square(away: Floats, covariance: Floats) -> Floats:
    """Return squared Mahalanobis distances of (..., n) differences with (..., n, n) covariances."""
    squared: Floats = np.einsum("...i,...i->...", away, np.linalg.solve(covariance, away[..., None])[..., 0])
    return squared
