"""The vehicles that a drive's tracker follows at one tick, and their correction by messages, LiDAR and camera.

Positions and velocities are in the ego's frame of odometry (ego.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tracklake.pipeline.transforms.onboard.kalman import (
    ACCELERATION,
    ACCELERATION_MPS2,
    HEADING_OFFSET,
    HEADING_OFFSET_RAD,
    POSITION,
    STATES,
    VELOCITY,
    update,
)
from tracklake.pipeline.transforms.onboard.measurements import Camera, CameraMeasurement
from tracklake.pipeline.transforms.onboard.relative import USUAL_ACCURACY_M, RelativeMessages
from tracklake.schemas.arrays import Flags, Floats, Integers

TENTATIVE = -1
"""vehicle_id of a track from LiDAR that is not confirmed yet."""
OWN_SHARE, RANDOM_SHARE = 0.8, 0.15
"""Parts of a position's stated accuracy: errors that receivers near each other do not share, which change slowly, and
errors that change from message to message."""
SENT_SPEED_MPS, SENT_ACCEL_MPS2, SENT_HEADING_RAD, SIDEWAYS_MPS = 0.3, 0.5, 0.01, 0.1
"""Standard deviations of what messages state, the heading's apart from its slow offset, and of sideways motion."""
AGED_ACCEL_MPS2 = 1.0
"""Acceleration that carrying a message on to the tick does not know of, as a standard deviation."""
OUTLIER_MESSAGE, OUTLIER_CLUSTER = 20.5, 13.8
"""Squared Mahalanobis distances beyond which a message (five values) or cluster (two) counts less: 1 in 1,000."""
BIRTH_AHEAD_MPS, BIRTH_SIDEWAYS_MPS = 15.0, 4.0
"""Standard deviations of a new LiDAR track's velocity about the ego's, along its axis and across."""
SLOW_MPS = 2.0
"""Speed under which the direction of motion says nothing of a vehicle's heading, in m/s."""
UNKNOWN = 1e9
"""Variance of a value that was not sent."""


@dataclass
class Tracks:
    """The V vehicles of one tick, in the order of `chain`.

    Args:
        chain: (V,) number of the filter, never used again.
        vehicle_id: (V,) station, id from FIRST_LIDAR_ID on, or TENTATIVE.
        state: (V, 9) with covariance (V, 9, 9).
        offset_m: (V,) standard deviation of the offset of messages.
        own_m: (V,) standard deviation of the part of it that is due to the vehicle's own receiver.
        heading_rad: (V,) in the frame of odometry; the last one holds at a standstill.
        size_m: (V, 3) length, width and height; NaN unknown.
        sized: (V,) whether length and width came in messages.
        message_s: (V,) when its last message was generated; NaN none yet.
        heard: (V,) tick of its last message; -1 none yet.
        seen: (V,) last tick at which LiDAR measured it; -1 never.
        scans: (V,) LiDAR scans since its birth, and the hits among them.
        lean: (V,) by how much the centre moves ahead per half metre that the vehicle is longer, by its last LiDAR hit.
        rival: (V,) station that a LiDAR track is taken for, and the votes for it in a row.
        strikes: (V,) messages in a row that contradict the state.
    """

    chain: Integers
    vehicle_id: Integers
    state: Floats
    covariance: Floats
    offset_m: Floats
    own_m: Floats
    heading_rad: Floats
    steering_angle_deg: Floats
    size_m: Floats
    sized: Flags
    message_s: Floats
    heard: Integers
    seen: Integers
    scans: Integers
    hits: Integers
    rival: Integers
    rivalry: Integers
    lean: Floats
    strikes: Integers

    def select(self, rows: Integers | Flags) -> "Tracks":
        """Return some of the tracks."""
        return Tracks(**{each.name: getattr(self, each.name)[rows] for each in fields(self)})

    @classmethod
    def concatenate(cls, parts: Sequence["Tracks"]) -> "Tracks":
        """Return the tracks of all parts, one after the other."""
        return cls(**{each.name: np.concatenate([getattr(one, each.name) for one in parts]) for each in fields(cls)})


def make_tracks(chain: Integers, vehicle_id: Integers, state: Floats, covariance: Floats, offset_m: Floats) -> Tracks:
    """Return new tracks of which nothing but their state is known."""
    count = len(chain)
    never = np.full(count, -1)
    return Tracks(
        chain=chain,
        vehicle_id=vehicle_id,
        state=state,
        covariance=covariance,
        offset_m=offset_m,
        own_m=np.full(count, OWN_SHARE * USUAL_ACCURACY_M),
        heading_rad=np.arctan2(state[:, 3], state[:, 2]),
        steering_angle_deg=np.full(count, np.nan),
        size_m=np.full((count, 3), np.nan),
        sized=np.zeros(count, dtype=bool),
        message_s=np.full(count, np.nan),
        heard=never,
        seen=never.copy(),
        scans=np.zeros(count, dtype=np.int64),
        hits=np.zeros(count, dtype=np.int64),
        rival=never.copy(),
        rivalry=np.zeros(count, dtype=np.int64),
        lean=np.zeros(count),
        strikes=np.zeros(count, dtype=np.int64),
    )


def make_no_tracks() -> Tracks:
    """Return tracks of no vehicle."""
    none = np.empty(0, dtype=np.int64)
    return make_tracks(none, none, np.empty((0, STATES)), np.empty((0, STATES, STATES)), np.empty(0))


def turn(vectors: Floats, angle_rad: Floats | float) -> Floats:
    """Turn (N, 2) vectors of a frame that is turned clockwise by an angle into the frame that it is turned in."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    return np.stack(
        (vectors[..., 0] * cosine - vectors[..., 1] * sine, vectors[..., 0] * sine + vectors[..., 1] * cosine), -1
    )


def turn_covariance(covariance: Floats, angle_rad: float) -> Floats:
    """Turn (N, 2, 2) covariances likewise."""
    return turn(np.swapaxes(turn(covariance, angle_rad), 1, 2), angle_rad)


def compute_offset_m(accuracy_m: Floats, range_m: Floats, heading_sigma_rad: float) -> Floats:
    """Return the standard deviation of messages' slow offsets: two receivers, and the error of the ego's heading."""
    return np.sqrt(2 * (OWN_SHARE * accuracy_m) ** 2 + (range_m * heading_sigma_rad) ** 2)


def start_from_messages(
    messages: RelativeMessages, place_m: Floats, yaw_rad: float, offset_m: Floats
) -> tuple[Floats, Floats]:
    """Return first states and covariances of vehicles heard for the first time, at `place_m` (N, 2).

    The position is that of the message without its offset, which is unknown: the two errors are one and the same.
    """
    count = len(place_m)
    state, covariance = np.zeros((count, STATES)), np.zeros((count, STATES, STATES))
    heading = messages.heading_rad + yaw_rad
    ahead = np.nan_to_num(np.stack((np.cos(heading), np.sin(heading)), 1))
    state[:, POSITION] = place_m
    state[:, VELOCITY] = np.nan_to_num(messages.speed_mps)[:, None] * ahead
    state[:, ACCELERATION] = np.nan_to_num(messages.accel_mps2)[:, None] * ahead
    known = ~np.isnan(heading) & ~np.isnan(messages.speed_mps)
    speed_variance = np.where(known, 1.0 + (HEADING_OFFSET_RAD * np.nan_to_num(messages.speed_mps)) ** 2, 20.0**2)
    for axis in range(2):
        covariance[:, axis, axis] = offset_m**2 + (RANDOM_SHARE * messages.accuracy_m) ** 2
        covariance[:, 6 + axis, 6 + axis] = offset_m**2
        covariance[:, axis, 6 + axis] = covariance[:, 6 + axis, axis] = -(offset_m**2)
        covariance[:, 2 + axis, 2 + axis] = speed_variance
        covariance[:, 4 + axis, 4 + axis] = ACCELERATION_MPS2**2
    covariance[:, HEADING_OFFSET, HEADING_OFFSET] = HEADING_OFFSET_RAD**2
    return state, covariance


def start_from_lidar(
    place_m: Floats, covariance_m2: Floats, velocity_mps: Floats, yaw_rad: float
) -> tuple[Floats, Floats]:
    """Return first states and covariances of vehicles that LiDAR sees for the first time, at `place_m` (N, 2).

    They are taken to drive with about `velocity_mps`, (N, 2).
    """
    count = len(place_m)
    state, covariance = np.zeros((count, STATES)), np.zeros((count, STATES, STATES))
    state[:, POSITION] = place_m
    state[:, VELOCITY] = velocity_mps
    covariance[:, POSITION, POSITION] = covariance_m2
    spread = np.diag([BIRTH_AHEAD_MPS**2, BIRTH_SIDEWAYS_MPS**2])
    covariance[:, VELOCITY, VELOCITY] = turn_covariance(spread[None], yaw_rad)
    for axis in range(2):
        covariance[:, 4 + axis, 4 + axis] = ACCELERATION_MPS2**2
        covariance[:, 6 + axis, 6 + axis] = 2 * (OWN_SHARE * USUAL_ACCURACY_M) ** 2
    covariance[:, HEADING_OFFSET, HEADING_OFFSET] = HEADING_OFFSET_RAD**2
    return state, covariance


def update_by_messages(
    tracks: Tracks, rows: Integers, messages: RelativeMessages, place_m: Floats, yaw_rad: float
) -> None:
    """Correct the tracks `rows` by a message each: position with its offset, speed, heading and acceleration.

    The heading says that the vehicle does not move across it, but for the offset of the heading.
    """
    count = len(rows)
    heading = messages.heading_rad + yaw_rad
    sine, cosine = np.nan_to_num(np.sin(heading)), np.nan_to_num(np.cos(heading))
    speed = np.nan_to_num(messages.speed_mps)
    ahead, across = np.stack((cosine, sine), 1), np.stack((-sine, cosine), 1)
    observation = np.zeros((count, 5, STATES))
    for axis in range(2):
        observation[:, axis, axis] = observation[:, axis, 6 + axis] = 1.0
    observation[:, 2, VELOCITY], observation[:, 4, ACCELERATION] = ahead, ahead
    observation[:, 3, VELOCITY], observation[:, 3, HEADING_OFFSET] = across, speed
    measured = np.stack((place_m[:, 0], place_m[:, 1], speed, np.zeros(count), np.nan_to_num(messages.accel_mps2)), 1)
    aged_m2 = (AGED_ACCEL_MPS2 * messages.age_s**2 / 2) ** 2 + (SENT_SPEED_MPS * messages.age_s) ** 2
    random_m2 = (RANDOM_SHARE * messages.accuracy_m) ** 2 + aged_m2
    no_heading, no_speed = np.isnan(heading), np.isnan(messages.speed_mps)
    variance = np.stack(
        (
            random_m2,
            random_m2,
            np.where(no_heading | no_speed, UNKNOWN, SENT_SPEED_MPS**2),
            np.where(no_heading | no_speed, UNKNOWN, (SENT_HEADING_RAD * speed) ** 2 + SIDEWAYS_MPS**2),
            np.where(no_heading | np.isnan(messages.accel_mps2), UNKNOWN, SENT_ACCEL_MPS2**2),
        ),
        1,
    )
    noise = variance[:, :, None] * np.eye(5)
    tracks.state[rows], tracks.covariance[rows], distance = update(
        tracks.state[rows], tracks.covariance[rows], measured, observation, noise, limit=OUTLIER_MESSAGE
    )
    tracks.strikes[rows] = np.where(distance > OUTLIER_MESSAGE, tracks.strikes[rows] + 1, 0)


def update_by_places(tracks: Tracks, rows: Integers, place_m: Floats, covariance_m2: Floats) -> None:
    """Correct the tracks `rows` by a measured position each, (N, 2)."""
    observation = np.broadcast_to(np.eye(2, STATES), (len(rows), 2, STATES))
    tracks.state[rows], tracks.covariance[rows], _ = update(
        tracks.state[rows], tracks.covariance[rows], place_m, observation, covariance_m2, limit=OUTLIER_CLUSTER
    )


def lengthen(tracks: Tracks, rows: Integers, longer_m: Floats) -> Floats:
    """Return by how much (..., N, 2) the centres of the tracks `rows` move, in m, if they are longer by (..., N)."""
    heading = tracks.heading_rad[rows]
    shift: Floats = (tracks.lean[rows] * longer_m / 2)[..., None] * np.stack((np.cos(heading), np.sin(heading)), -1)
    return shift


def update_by_camera(
    tracks: Tracks, found: CameraMeasurement, camera: Camera, ego_m: Floats, yaw_rad: float
) -> tuple[Integers, Integers]:
    """Correct tracks by the bearing and range of camera boxes; return rows of the tracks and numbers of their boxes."""
    boxes = np.flatnonzero(found.row >= 0)
    rows = found.row[boxes]
    lens_m = ego_m + turn(np.array([camera.x_m, camera.y_m]), yaw_rad)
    away_m = tracks.state[rows, POSITION] - lens_m
    range_m = np.maximum(np.hypot(*away_m.T), 1.0)
    observation = np.zeros((len(rows), 2, STATES))
    observation[:, 0, POSITION] = np.stack((-away_m[:, 1], away_m[:, 0]), 1) / range_m[:, None] ** 2
    observation[:, 1, POSITION] = away_m / range_m[:, None]
    off = found.bearing_rad[boxes] + yaw_rad - np.arctan2(away_m[:, 1], away_m[:, 0])
    off = np.mod(off + np.pi, 2 * np.pi) - np.pi
    residual = np.stack((off, np.nan_to_num(found.range_m[boxes] - range_m)), 1)
    variance = np.stack((found.bearing_variance_rad2[boxes], found.range_variance_m2[boxes]), 1)
    noise = np.nan_to_num(variance, nan=UNKNOWN)[:, :, None] * np.eye(2)
    linear = residual + np.squeeze(observation @ tracks.state[rows][..., None], -1)
    tracks.state[rows], tracks.covariance[rows], _ = update(
        tracks.state[rows], tracks.covariance[rows], linear, observation, noise, limit=OUTLIER_CLUSTER
    )
    return rows, boxes
