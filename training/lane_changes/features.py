"""Features of a lane change: the target's motion and place, and its relation to the vehicle behind.

The target is the sample. The publication's ego, the car with the sensors, is the vehicle behind it: the nearest one
behind in the target's own lane or, if there is none, the nearest one behind in a lane beside. Features come from
`ObservedScene` alone, which holds what is known at the moment of prediction.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Flags, Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.lane_forest import FEATURE_NAMES, FEATURE_NUMBER, FEATURES, NEGATED, SAME, Coefficient
from tracklake.training.data.observed import ObservedScene
from tracklake.training.lane_changes.cells import find_columns

FIT_S = 1.0
"""Length of the history to which the parabola for speeds and accelerations is fitted, s."""
LEAST_SPEED_MPS = 1.0
"""Lowest speed used for headings and yaw rates, m/s: at standstill they would be noise."""
LEAST_KNOWN = 2
"""Smallest number of known positions of an ego."""


def describe_targets(observed: ObservedScene[Any], rate_hz: int) -> Singles:
    """Compute all candidates of B targets: (B, features) in the order of FEATURES."""
    scenes = np.arange(len(observed.history))
    known = observed.history_mask.sum(axis=2)
    ego, found = find_egos(observed, known)
    target_motion = fit_motion(observed.history[:, 0], known[:, 0], rate_hz)
    ego_motion = fit_motion(observed.history[scenes, ego], known[scenes, ego], rate_hz)
    ego_at = observed.history[scenes, ego, -1].astype(np.float64)
    centre, width = observed.lanes[:, 1, 0].astype(np.float64), observed.lanes[:, 1, 1].astype(np.float64)
    speed, accel, lateral_speed, _, heading, yaw_rate = target_motion - ego_motion
    ego_column = find_columns(ego_at[:, 1], observed.lanes)
    relative = (found, ego_column, -ego_at[:, 0], -ego_at[:, 1], speed, accel, lateral_speed, heading, yaw_rate)
    columns = (
        *target_motion,
        -observed.history[:, 0, 0, 1].astype(np.float64),
        -centre,
        width / 2 - centre,
        width / 2 + centre,
        observed.lanes[:, 0, 2],
        observed.lanes[:, 2, 2],
        *(np.where(found, value, 0.0) for value in relative),
    )
    return np.stack(columns, axis=1).astype(np.float32)


def find_egos(observed: ObservedScene[Any], known: npt.NDArray[np.integer]) -> tuple[Integers, Flags]:
    """Find the vehicle behind each of B targets, from the number of known positions of the V vehicles (B, V).

    Returns:
        Position in the scene, (B,), 0 where there is no ego; and whether there is one, (B,).
    """
    ahead, side = observed.history[:, :, -1, 0], observed.history[:, :, -1, 1]
    column = find_columns(side, observed.lanes)
    behind = observed.vehicle_mask & (known >= LEAST_KNOWN) & (ahead < 0) & (np.abs(column) <= 1)
    behind[:, 0] = False
    own, beside = (np.where(behind & lanes, -ahead, np.inf) for lanes in (column == 0, column != 0))
    own_found, found = np.isfinite(own).any(axis=1), behind.any(axis=1)
    ego = np.where(own_found, own.argmin(axis=1), beside.argmin(axis=1))
    return np.where(found, ego, 0), found


def mirror_targets(features: Singles) -> Singles:
    """Compute the features (B, features) of the same targets on a road mirrored sideways."""
    mirrored = features.copy()
    for number, feature in enumerate(FEATURES):
        if feature.mirrored == NEGATED:
            mirrored[:, number] = -features[:, number]
        elif feature.mirrored != SAME:
            mirrored[:, number] = features[:, FEATURE_NUMBER[feature.mirrored]]
    return mirrored


def shift_targets(features: Singles, shift_m: npt.NDArray[np.floating]) -> Singles:
    """Compute the features (B, features) with the ego moved along the road, and nothing else.

    Lengths (B,) are added to the gaps, m, where there is an ego; no gap shrinks to less than half.
    """
    shifted = features.copy()
    gap = features[:, FEATURE_NUMBER["gap_m"]]
    moved = np.maximum(gap + shift_m, gap / 2)
    shifted[:, FEATURE_NUMBER["gap_m"]] = np.where(features[:, FEATURE_NUMBER["ego"]] > 0, moved, gap)
    return shifted


def fit_motion(history: Singles, known: npt.NDArray[np.integer], rate_hz: int) -> Floats:
    """Fit the last FIT_S of histories (M, H, 2), of which the last `known` (M,) positions are known.

    Returns:
        Speed and acceleration along the road, the same across it, heading and yaw rate: (6, M).
    """
    ticks = min(history.shape[1], round(FIT_S * rate_hz) + 1)
    weights = weigh_positions(ticks, rate_hz)[np.minimum(known, ticks)]  # (M, 2, ticks)
    recent = history[:, -ticks:].astype(np.float64)
    (speed, lateral_speed), (accel, lateral_accel) = np.einsum("mot,mtd->odm", weights, recent)
    floored = np.maximum(speed, LEAST_SPEED_MPS)
    yaw_rate = (floored * lateral_accel - lateral_speed * accel) / (floored**2 + lateral_speed**2)
    return np.stack([speed, accel, lateral_speed, lateral_accel, np.arctan2(lateral_speed, floored), yaw_rate])


def weigh_positions(ticks: int, rate_hz: int) -> Floats:
    """Compute the weights of the last positions that give speed and acceleration now: (ticks + 1, 2, ticks).

    The first axis counts known positions. The fit is a least-squares parabola; with two, a line; with fewer, no motion.
    """
    weights = np.zeros((ticks + 1, 2, ticks))
    for known in range(2, ticks + 1):
        time_s = np.arange(1 - known, 1) / rate_hz
        solved = np.linalg.pinv(np.vander(time_s, min(3, known), increasing=True))  # rows: place, speed, half accel
        weights[known, : len(solved) - 1, ticks - known :] = solved[1:]
    weights[:, 1] *= 2
    return weights


def choose_features(
    feature: Singles, maneuver: Bytes, *, least: float, most: float, names: Sequence[str] = FEATURE_NAMES
) -> list[Coefficient]:
    """Choose features that correlate with the classes and not with each other, of all candidates (B, features).

    A chosen feature has a strength of at least `least`. Of two that correlate by more than `most`, the stronger stays.

    Returns:
        All candidates from the strongest to the weakest, equally strong ones in the order of `names`.
    """
    codes = np.arange(len(LATERAL_MANEUVERS))
    values, classes = standardise_columns(feature), standardise_columns(maneuver[:, None] == codes)
    coefficient, between = np.clip(values.T @ classes, -1, 1), np.minimum(np.abs(values.T @ values), 1)
    strength = np.abs(coefficient).max(axis=1)
    chosen: list[int] = []
    table = []
    for number in np.argsort(-strength, kind="stable"):
        reason = ""
        if strength[number] < least:
            reason = f"below {least:g}"
        elif twins := [other for other in chosen if between[number, other] > most]:
            reason = f"as {names[twins[0]]} ({between[number, twins[0]]:.3f})"
        else:
            chosen.append(int(number))
        keep, left, right = map(float, coefficient[number])
        table.append(Coefficient(names[number], keep, left, right, chosen=not reason, reason=reason))
    return table


def standardise_columns(numbers: npt.NDArray[Any]) -> Floats:
    """Scale columns (B, P) to mean 0 and length 1; columns that do not vary become zeros."""
    columns = numbers.astype(np.float64)
    if not len(columns):
        return columns
    centred = columns - columns.mean(axis=0)
    length = np.sqrt((centred**2).sum(axis=0))
    varies = length > 1e-9 * np.sqrt(len(columns)) * np.maximum(1.0, np.abs(columns).max(axis=0))
    return np.where(varies, centred, 0.0) / np.where(varies, length, 1.0)
