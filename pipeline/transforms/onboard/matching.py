"""Assignment of vehicles that send messages to vehicles that LiDAR sees, where it is not obvious.

Messages may be off by more than a lane, so a cluster at the place that they name can be another vehicle's, and their
own vehicle may be hidden. Clusters are therefore not assigned to stations whose place is uncertain: they become
tracks of LiDAR alone, and stations and tracks are compared as a whole (track-to-track association; Bar-Shalom, Li and
Kirubarajan 2001). All messages are off alike by the errors of the ego's own position and heading: stations that LiDAR
sees tell them, the assignment is sought together with what remains unknown of the former, and it is made only where the
next best one is clearly worse.
"""

import numpy as np

from tracklake.pipeline.transforms.onboard.boxes import CAR_SIZE_M, TRUCK_HEIGHT_M
from tracklake.pipeline.transforms.onboard.kalman import OFFSET, POSITION, VELOCITY
from tracklake.pipeline.transforms.onboard.tracks import TENTATIVE, Tracks, lengthen
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.perception import FIRST_LIDAR_ID

LOOSE_M2 = 1.0
"""Sum of the variances of x and y from which on a station's place is uncertain, in m2."""
LOST_M = 0.9
"""Standard deviation of a place across the road from which on a vehicle may be in the next lane, in m: half of half a
lane."""
NEAR, UNSEEN = 13.8, 9.0
"""Squared Mahalanobis distances: of two places (1 in 1,000), and of a place and velocity that is as likely as that the
station is hidden and the track is of a vehicle that sends nothing, at 1 vehicle per 175 m2 of which half are hidden."""
TALL_WIDTH_M = 1.95
"""Width that all vehicles have that are taller than TRUCK_HEIGHT_M, in m: vans are 2.0 m wide, trucks 2.5 m."""
CLEAR, SURE = 3.0, 9.21
"""Squared Mahalanobis distances by which the next best assignment must be worse: the best one is 4 times and 100 times
as likely."""
SURE_VOTES = 2
"""Votes for a pair that is sure; one that is only clear has one, because it may change as more stations are settled."""
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


def is_lost(tracks: Tracks, tick: int) -> Flags:
    """Tell which tracks that LiDAR does not see may be in the next lane: what it sees there may be another vehicle."""
    across = np.stack((-np.sin(tracks.heading_rad), np.cos(tracks.heading_rad)), 1)
    variance = np.einsum("ni,nij,nj->n", across, tracks.covariance[:, POSITION, POSITION], across)
    lost: Flags = (tracks.seen < tick) & (variance > LOST_M**2)
    return lost


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


def match_stations(tracks: Tracks, heard: Flags, ego_m: Floats, heading_sd_rad: float) -> Integers:
    """Return rows of LiDAR tracks and stations that are clearly one vehicle by the present states, and votes: (N, 3).

    Args:
        tracks: tracks of a tick.
        heard: (V,) whether a message arrived lately.
        ego_m: (2,) place of the ego.
        heading_sd_rad: standard deviation of the ego's heading.
    """
    lidar = np.flatnonzero(tracks.vehicle_id >= FIRST_LIDAR_ID)
    lidar = lidar[~_find_doubles(tracks, lidar)]
    stations = np.flatnonzero(is_loose(tracks) & heard)
    none = np.empty((0, 3), dtype=np.int64)
    if not lidar.size or not stations.size:
        return none
    state, covariance, effect, spread = _expect_offsets(tracks, stations, ego_m, heading_sd_rad)
    away = tracks.state[lidar, None, :4] - state
    away[..., :2] += np.swapaxes(compute_size_shift(tracks, lidar, stations), 0, 1)
    total = tracks.covariance[lidar, None, :4, :4] + covariance
    total[..., [0, 1], [0, 1]] += 0.2**2
    fits = ~((tracks.size_m[lidar, 2] > TRUCK_HEIGHT_M)[:, None] & (tracks.size_m[stations, 1] < TALL_WIDTH_M))
    common = effect @ spread @ np.swapaxes(effect, 1, 2)
    near = fits & (_square(away[..., :2], total[..., :2, :2] + common) < NEAR)
    lidar, stations, effect = lidar[near.any(1)], stations[near.any(0)], effect[near.any(0)]
    if not lidar.size:
        return none
    away, total, fits = (each[near.any(1)][:, near.any(0)] for each in (away, total, fits))
    pairs, cost = _try_shifts(away, total, fits, effect, spread)
    best = pairs[int(np.argmin(cost))]
    taken = (pairs[:, :, None] == best).any(1)  # (K, S): whether some station has the track that is the best for each
    rival = (pairs != best) & ((pairs >= 0) | taken)
    lead = np.where(rival, cost[:, None], np.inf).min(0) - cost.min()
    good = np.flatnonzero((best >= 0) & (lead >= CLEAR))
    return np.stack((lidar[best[good]], stations[good], np.where(lead[good] >= SURE, SURE_VOTES, 1)), 1)


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


def compute_size_shift(tracks: Tracks, lidar: Integers, stations: Integers) -> Floats:
    """Return by how much (S, L, 2) centres that LiDAR found move, in m, if the vehicles have the stations' lengths."""
    sent, used = tracks.size_m[stations, 0], tracks.size_m[lidar, 0]
    longer = np.nan_to_num(sent[:, None] - used) * tracks.sized[stations][:, None]
    return lengthen(tracks, lidar, longer)


def _expect_offsets(
    tracks: Tracks, stations: Integers, ego_m: Floats, heading_sd_rad: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Correct stations by what the offsets of the messages of settled stations have in common.

    An offset is a shift c by the error of the ego's place, plus a turn about the ego by the error of its heading, plus
    the own error of the station's receiver. Bayesian regression over the settled stations tells shift and turn. What
    LiDAR has shown of a station's offset before counts on.

    Returns:
        (S, 4) places and velocities, their (S, 4, 4) covariances but for what remains unknown of shift and turn, the
        (S, 2, 3) effect of these on the offsets, and their (3, 3) covariance.
    """

    def observe(rows: Integers) -> Floats:
        away = tracks.state[rows, POSITION] - ego_m
        turns = np.stack((-away[:, 1], away[:, 0]), 1)[..., None]
        return np.concatenate((np.broadcast_to(np.eye(2), (len(rows), 2, 2)), turns), 2)

    settled = np.flatnonzero(is_station(tracks) & ~is_loose(tracks))
    ego_m2 = float(np.median(tracks.own_m[stations])) ** 2
    matrix = observe(settled)
    weight = 1 / (tracks.own_m[settled] ** 2 + tracks.covariance[settled][:, [6, 7], [6, 7]].mean(1))
    information = np.diag([1 / ego_m2, 1 / ego_m2, 1 / max(heading_sd_rad, 1e-4) ** 2])
    information = information + np.einsum("nai,naj,n->ij", matrix, matrix, weight)
    spread = np.linalg.inv(information)
    common = spread @ np.einsum("nai,na,n->i", matrix, tracks.state[settled, OFFSET], weight)
    matrix = observe(stations)
    prior = tracks.own_m[stations, None, None] ** 2 * np.eye(2)
    expected = matrix @ common
    before = tracks.covariance[stations, OFFSET, OFFSET]
    learned = np.linalg.inv(before) - np.eye(2) / tracks.offset_m[stations, None, None] ** 2
    after = np.linalg.inv(np.linalg.inv(prior) + learned)
    offset = tracks.state[stations, OFFSET]
    change = np.linalg.solve(before, offset[..., None]) + np.linalg.solve(prior, expected[..., None])
    change = after @ change - offset[..., None]
    gain = np.swapaxes(np.linalg.solve(before, tracks.covariance[stations, OFFSET, :4]), 1, 2)
    state = tracks.state[stations, :4] + (gain @ change)[..., 0]
    covariance = tracks.covariance[stations, :4, :4] - gain @ (before - after) @ np.swapaxes(gain, 1, 2)
    return state, covariance, matrix, spread


def _try_shifts(away: Floats, total: Floats, fits: Flags, effect: Floats, spread: Floats) -> tuple[Integers, Floats]:
    """Assign stations to LiDAR tracks under each of several common shifts.

    Args:
        away: (L, S, 4) differences of places and velocities, LiDAR minus station.
        total: (L, S, 4, 4) their covariances, without those of shift and turn.
        fits: (L, S) whether the sizes allow that it is one vehicle.
        effect: (S, 2, 3) effect of shift and turn on the offsets.
        spread: (3, 3) covariance of shift and turn.

    Returns:
        (K, S) LiDAR track of each station, -1 for none, and the (K,) costs: the likeliest assignment under each of the
        shifts, and the best of them without each of its pairs.
    """
    from scipy.optimize import linear_sum_assignment

    stations = away.shape[1]
    shifts = np.concatenate((np.zeros((1, 2)), -away[..., :2].reshape(-1, 2)))
    shifts = shifts[np.argsort((shifts**2).sum(1), kind="stable")[:MOST_SHIFTS]]
    moved = np.broadcast_to(away, (len(shifts), *away.shape)).copy()
    moved[..., :2] += shifts[:, None, None]
    turned = total.copy()
    turned[..., :2, :2] += effect[..., 2:] @ np.swapaxes(effect[..., 2:], 1, 2) * spread[2, 2]
    distance = np.minimum(_square(moved, np.broadcast_to(turned, (len(shifts), *total.shape))), UNSEEN)
    distance[:, ~fits] = UNSEEN
    pairs = np.full((len(shifts), stations), -1)
    for number, square in enumerate(distance):
        rows, columns = linear_sum_assignment(square)
        good = square[rows, columns] < UNSEEN
        pairs[number, columns[good]] = rows[good]
    precision = np.asarray(np.linalg.inv(total), dtype=np.float64)
    best = pairs[_weigh(pairs, away, precision, effect, spread).argmin()]
    without = np.where(np.eye(stations, dtype=bool), -1, best)
    pairs = np.concatenate((pairs, without))
    return pairs, _weigh(pairs, away, precision, effect, spread)


def _weigh(pairs: Integers, away: Floats, precision: Floats, effect: Floats, spread: Floats) -> Floats:
    """Return the (K,) costs of K assignments: squared Mahalanobis distances under the shift and turn that fit best.

    Those of shift and turn themselves are included; a station without a track costs UNSEEN.
    """
    assigned = pairs >= 0
    columns = np.arange(pairs.shape[1])
    off = away[pairs, columns] * assigned[..., None]  # (K, S, 4)
    inverse = precision[pairs, columns] * assigned[..., None, None]
    pull = (inverse @ off[..., None])[..., 0]
    stiffness = np.einsum("sai,ksab,sbj->kij", effect, inverse[..., :2, :2], effect) + np.linalg.inv(spread)
    total = np.einsum("sai,ksa->ki", effect, pull[..., :2])
    gained = (total * np.linalg.solve(stiffness, total[..., None])[..., 0]).sum(1)
    cost: Floats = (off * pull).sum((1, 2)) - gained + UNSEEN * (~assigned).sum(1)
    return cost


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
    for name in ("vehicle_id", "offset_m", "own_m", "steering_angle_deg", "sized", "message_s", "heard"):
        getattr(tracks, name)[lidar] = getattr(tracks, name)[station]
    own = tracks.size_m[station]
    tracks.size_m[lidar] = np.where(np.isnan(own), tracks.size_m[lidar], own)
    tracks.rival[lidar], tracks.rivalry[lidar], tracks.strikes[lidar] = TENTATIVE, 0, 0
    keep = np.ones(len(tracks.chain), dtype=bool)
    keep[station] = False
    return tracks.select(keep)


def _square(away: Floats, covariance: Floats) -> Floats:
    """Return squared Mahalanobis distances of (..., n) differences with (..., n, n) covariances."""
    squared: Floats = np.einsum("...i,...i->...", away, np.linalg.solve(covariance, away[..., None])[..., 0])
    return squared
