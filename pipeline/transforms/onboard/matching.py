"""Assignment of vehicles that send messages to vehicles that LiDAR sees, where it is not obvious.

Messages may be off by more than a lane, so a cluster at the place that they name can be another vehicle's, and their
own vehicle may be hidden. Clusters are therefore not assigned to stations whose place is uncertain: they become
tracks of LiDAR alone, and stations and tracks are compared as a whole (track-to-track association; Bar-Shalom, Li and
Kirubarajan 2001). All messages are off by the error of the ego's own position alike: the assignment is sought together
with that common shift, and made only where the next best one is clearly worse.
"""

import numpy as np

from tracklake.pipeline.transforms.onboard.boxes import CAR_SIZE_M
from tracklake.pipeline.transforms.onboard.kalman import OFFSET, POSITION, VELOCITY
from tracklake.pipeline.transforms.onboard.tracks import TENTATIVE, Tracks
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.perception import FIRST_LIDAR_ID

LOOSE_M2 = 1.0
"""Sum of the variances of x and y from which on a station's place is uncertain, in m2."""
NEAR, UNSEEN = 13.8, 9.0
"""Squared Mahalanobis distances: of two places (1 in 1,000), and of a place and velocity that is as likely as that the
station is hidden and the track is of a vehicle that sends nothing, at 1 vehicle per 175 m2 of which half are hidden."""
CLEAR = 3.0
"""Squared Mahalanobis distance by which the next best assignment must be worse."""
MOST_SHIFTS = 60
"""Common shifts that are tried at most."""
STRIKES = 10
"""Messages in a row that contradict LiDAR before the two are taken for different vehicles."""
FARTHEST_OFFSET = 3.7
"""Offset of messages, in standard deviations, that is not believed."""


def is_station(tracks: Tracks) -> Flags:
    """Tell which tracks are of vehicles that send messages."""
    return (tracks.vehicle_id >= 0) & (tracks.vehicle_id < FIRST_LIDAR_ID)


def is_loose(tracks: Tracks) -> Flags:
    """Tell which tracks are of stations whose place is uncertain."""
    return is_station(tracks) & (tracks.covariance[:, 0, 0] + tracks.covariance[:, 1, 1] > LOOSE_M2)


def guess_velocities(tracks: Tracks, place_m: Floats, usual_mps: Floats) -> Floats:
    """Return first velocities of LiDAR tracks at (N, 2) places: of the nearest uncertain station, or the usual one.

    A station that drives against the ego's direction is thus found by LiDAR as well.
    """
    guess = np.tile(usual_mps, (len(place_m), 1))
    rows = np.flatnonzero(is_loose(tracks))
    if rows.size and len(place_m):
        away = place_m[:, None] - tracks.state[None, rows, POSITION]
        distance = _square(away, np.broadcast_to(tracks.covariance[rows, POSITION, POSITION], (*away.shape, 2)))
        nearest = distance.argmin(1)
        near = distance.min(1) < NEAR
        guess[near] = tracks.state[rows[nearest[near]], VELOCITY]
    return guess


def match_stations(tracks: Tracks, heard: Flags) -> Integers:
    """Return (N, 2) rows of LiDAR tracks and stations that are clearly one vehicle by the present states.

    Args:
        tracks: tracks of a tick.
        heard: (V,) whether a message arrived lately.
    """
    lidar = np.flatnonzero(tracks.vehicle_id >= FIRST_LIDAR_ID)
    lidar = lidar[~_find_doubles(tracks, lidar)]
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
    own_m2 = tracks.covariance[stations][:, [0, 1], [0, 1]]  # less than the shift's where LiDAR saw the station before
    total[..., [0, 1], [0, 1]] -= np.minimum(common_m2, 0.4 * own_m2)[None]
    pairs, cost = _try_shifts(away, total, known_m, rest_m2)
    best = int(np.argmin(cost))
    rivals = np.where(pairs == pairs[best], np.inf, cost[:, None]).min(0)  # the best that has another partner, (S,)
    good = np.flatnonzero((pairs[best] >= 0) & (rivals - cost[best] >= CLEAR))
    return np.stack((lidar[pairs[best, good]], stations[good]), 1)


def _find_doubles(tracks: Tracks, lidar: Integers) -> Flags:
    """Tell which LiDAR tracks are where a car would overlap a station whose place is certain: returns of that station.

    They are no other station's, which may be hidden.
    """
    certain = np.flatnonzero(is_station(tracks) & ~is_loose(tracks))
    x_m, y_m = np.moveaxis(tracks.state[lidar, None, POSITION] - tracks.state[certain, POSITION], -1, 0)
    cos, sin = np.cos(tracks.heading_rad[certain]), np.sin(tracks.heading_rad[certain])
    length_m, width_m = ((tracks.size_m[certain, :2] + CAR_SIZE_M) / 2).T
    over = (np.abs(x_m * cos + y_m * sin) < length_m) & (np.abs(y_m * cos - x_m * sin) < width_m)
    doubles: Flags = over.any(1)
    return doubles


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
        shifts included; a station without a track costs UNSEEN.
    """
    from scipy.optimize import linear_sum_assignment

    stations = away.shape[1]
    shifts = np.concatenate((known_m[None], -away[..., :2].reshape(-1, 2)))
    prior = ((shifts - known_m) ** 2).sum(1) / rest_m2
    chosen = np.argsort(prior, kind="stable")[:MOST_SHIFTS]
    shifts, cost = shifts[chosen], prior[chosen]
    moved = np.broadcast_to(away, (len(shifts), *away.shape)).copy()
    moved[..., :2] += shifts[:, None, None]
    distance = np.minimum(_square(moved, np.broadcast_to(total, (len(shifts), *total.shape))), UNSEEN)
    pairs = np.full((len(shifts), stations), -1)
    for number, square in enumerate(distance):
        rows, columns = linear_sum_assignment(square)
        good = square[rows, columns] < UNSEEN
        pairs[number, columns[good]] = rows[good]
        cost[number] += square[rows[good], columns[good]].sum() + UNSEEN * (stations - good.sum())
    return pairs, cost


def find_contradicted(tracks: Tracks) -> Flags:
    """Tell which stations were assigned another vehicle's clusters: their messages contradict what LiDAR sees."""
    far = np.hypot(*tracks.state[:, OFFSET].T) > FARTHEST_OFFSET * tracks.offset_m
    contradicted: Flags = is_station(tracks) & (far | (~is_loose(tracks) & (tracks.strikes >= STRIKES)))
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
