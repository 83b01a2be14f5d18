"""What a lane change is foretold by: the target vehicle's motion and place, and its relation to the vehicle behind.

The target is the sample. The publication's ego, the car with the sensors, is the vehicle behind it: the nearest behind
in the target's own lane, or where there is none, the nearest behind in a lane beside. Only what may be seen at the
moment of prediction goes in (`ObservedScene`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Integers
from tracklake.schemas.arrays import Singles as Floats
from tracklake.training.data.observed import ObservedScene
from tracklake.training.lane_changes.cells import find_columns

FIT_S = 1.0
"""Speeds and accelerations are those of a parabola fitted to this much history."""
LEAST_SPEED_MPS = 1.0
"""Headings and yaw rates are computed as if nobody drove slower: at standstill they would be noise."""
LEAST_KNOWN = 2
"""Positions that must be known of a vehicle behind for it to be the ego."""
SAME, NEGATED = "same", "negated"


@dataclass(frozen=True)
class Feature:
    """One number of a target.

    Args:
        name: unit included.
        meaning: sign included; lateral ones are positive to the right.
        mirrored: what it is on the mirrored road: the same, negated, or the feature of this name.
    """

    name: str
    meaning: str
    mirrored: str = SAME


FEATURES = (
    Feature("speed_mps", "along the road"),
    Feature("accel_mps2", "along the road"),
    Feature("lateral_speed_mps", "across the road", NEGATED),
    Feature("lateral_accel_mps2", "across the road", NEGATED),
    Feature("heading_rad", "of the velocity, from the direction of travel", NEGATED),
    Feature("yaw_rate_radps", "change of the heading; stands in for the steering", NEGATED),
    Feature("moved_m", "across the road since the history's beginning", NEGATED),
    Feature("offset_m", "from the centre of its lane", NEGATED),
    Feature("left_marking_m", "from the vehicle's centre to the lane's left edge", "right_marking_m"),
    Feature("right_marking_m", "from the vehicle's centre to the lane's right edge", "left_marking_m"),
    Feature("left_lane", "1 where there is a lane to the left", "right_lane"),
    Feature("right_lane", "1 where there is a lane to the right", "left_lane"),
    Feature("ego", "1 where there is a vehicle behind; where there is none, all that follows is 0"),
    Feature("ego_column", "the lane of the vehicle behind: -1 left, 0 own, 1 right", NEGATED),
    Feature("gap_m", "how far the target is ahead of it, front to front"),
    Feature("side_m", "how far the target is to the right of it", NEGATED),
    Feature("relative_speed_mps", "the target's speed less the ego's; the following likewise"),
    Feature("relative_accel_mps2", "along the road"),
    Feature("relative_lateral_speed_mps", "across the road", NEGATED),
    Feature("relative_heading_rad", "of the velocities", NEGATED),
    Feature("relative_yaw_rate_radps", "of the headings' changes", NEGATED),
)
"""All candidates; which of them a forest uses is chosen when it is fitted."""

NAMES = tuple(feature.name for feature in FEATURES)
NUMBER = {name: number for number, name in enumerate(NAMES)}


def describe_targets(observed: ObservedScene[Any], rate_hz: int) -> Floats:
    """(B, features) the candidates of B targets, in the order of FEATURES, float32.

    Args:
        observed: of NumPy arrays.
        rate_hz: ticks per second of the histories.
    """
    scenes = np.arange(len(observed.history))
    known = observed.history_mask.sum(axis=2)
    ego, found = find_egos(observed, known)
    target_motion = _Motion.fit(observed.history[:, 0], known[:, 0], rate_hz)
    ego_motion = _Motion.fit(observed.history[scenes, ego], known[scenes, ego], rate_hz)
    ego_at = observed.history[scenes, ego, -1].astype(np.float64)
    centre, width = _read_own_lane(observed)
    relative = (
        found,
        find_columns(ego_at[:, 1], observed.lanes),
        -ego_at[:, 0],
        -ego_at[:, 1],
        target_motion.speed - ego_motion.speed,
        target_motion.accel - ego_motion.accel,
        target_motion.lateral_speed - ego_motion.lateral_speed,
        target_motion.heading - ego_motion.heading,
        target_motion.yaw_rate - ego_motion.yaw_rate,
    )
    described = np.stack(
        [
            target_motion.speed,
            target_motion.accel,
            target_motion.lateral_speed,
            target_motion.lateral_accel,
            target_motion.heading,
            target_motion.yaw_rate,
            -observed.history[:, 0, 0, 1].astype(np.float64),
            -centre,
            width / 2 - centre,
            width / 2 + centre,
            observed.lanes[:, 0, 2],
            observed.lanes[:, 2, 2],
            *(np.where(found, value, 0.0) for value in relative),
        ],
        axis=1,
    )
    return described.astype(np.float32)


def find_egos(observed: ObservedScene[Any], known: npt.NDArray[np.integer]) -> tuple[Integers, npt.NDArray[np.bool_]]:
    """The vehicle behind each target: (B,) its place in the scene, and (B,) whether there is one (else 0, the target).

    Args:
        observed: scenes.
        known: (B, V) positions known of each vehicle.
    """
    ahead, side = observed.history[:, :, -1, 0], observed.history[:, :, -1, 1]
    column = find_columns(side, observed.lanes)
    behind = observed.vehicle_mask & (known >= LEAST_KNOWN) & (ahead < 0) & (np.abs(column) <= 1)
    behind[:, 0] = False
    own, beside = (np.where(behind & of, -ahead, np.inf) for of in (column == 0, column != 0))
    own_found, found = np.isfinite(own).any(axis=1), behind.any(axis=1)
    ego = np.where(own_found, own.argmin(axis=1), beside.argmin(axis=1))
    return np.where(found, ego, 0), found


def mirror_targets(features: Floats) -> Floats:
    """(B, features) of the same targets on a road mirrored sideways."""
    mirrored = features.copy()
    for number, feature in enumerate(FEATURES):
        if feature.mirrored == NEGATED:
            mirrored[:, number] = -features[:, number]
        elif feature.mirrored != SAME:
            mirrored[:, number] = features[:, NUMBER[feature.mirrored]]
    return mirrored


def shift_targets(features: Floats, shift_m: npt.NDArray[np.floating]) -> Floats:
    """(B, features) with the ego moved along the road, and nothing else.

    All features are relative, so that moving target and ego together would change none of them. Moved alone, the ego
    follows at another distance; it stays behind: no gap becomes smaller than half of what it was.

    Args:
        features: all candidates.
        shift_m: (B,) what is added to the gap, m; of no effect where there is no ego.
    """
    shifted = features.copy()
    gap = features[:, NUMBER["gap_m"]]
    moved = np.maximum(gap + shift_m, gap / 2)
    shifted[:, NUMBER["gap_m"]] = np.where(features[:, NUMBER["ego"]] > 0, moved, gap)
    return shifted


@dataclass(frozen=True)
class _Motion:
    """(M,) each, float64: along and across the road, and of the heading."""

    speed: npt.NDArray[np.float64]
    accel: npt.NDArray[np.float64]
    lateral_speed: npt.NDArray[np.float64]
    lateral_accel: npt.NDArray[np.float64]
    heading: npt.NDArray[np.float64]
    yaw_rate: npt.NDArray[np.float64]

    @classmethod
    def fit(cls, history: Floats, known: npt.NDArray[np.integer], rate_hz: int) -> "_Motion":
        """By least squares over the last FIT_S of histories (M, H, 2) of which the last `known` (M,) are known."""
        ticks = min(history.shape[1], round(FIT_S * rate_hz) + 1)
        weights = weigh_positions(ticks, rate_hz)[np.minimum(known, ticks)]  # (M, 2, ticks)
        (speed, lateral_speed), (accel, lateral_accel) = np.einsum(
            "mot,mtd->odm", weights, history[:, -ticks:].astype(np.float64)
        )
        floored = np.maximum(speed, LEAST_SPEED_MPS)
        yaw_rate = (floored * lateral_accel - lateral_speed * accel) / (floored**2 + lateral_speed**2)
        return cls(speed, accel, lateral_speed, lateral_accel, np.arctan2(lateral_speed, floored), yaw_rate)


def weigh_positions(ticks: int, rate_hz: int) -> npt.NDArray[np.float64]:
    """(ticks + 1, 2, ticks) weights of the last positions that give speed and acceleration now, by how many are known.

    The parabola of least squares; with two known, a line (no acceleration); with fewer, no motion.
    """
    weights = np.zeros((ticks + 1, 2, ticks))
    for known in range(2, ticks + 1):
        time_s = np.arange(1 - known, 1) / rate_hz
        solved = np.linalg.pinv(np.vander(time_s, min(3, known), increasing=True))  # rows: place, speed, half accel
        weights[known, : len(solved) - 1, ticks - known :] = solved[1:]
    weights[:, 1] *= 2
    return weights


def _read_own_lane(observed: ObservedScene[Any]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(B,) the centre's offset from the target and the width of the target's own lane; 0 where it is unknown."""
    own = observed.lanes[:, 1].astype(np.float64)
    return own[:, 0], own[:, 1]
