"""Which features a forest is given: those that correlate with its classes, and not with each other."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes
from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.training.lane_changes.features import NAMES


@dataclass(frozen=True)
class Coefficient:
    """What speaks for and against a feature.

    Args:
        feature: its name.
        keep: Pearson's correlation coefficient of the feature with 1 where the class is this one, else 0 (the
            point-biserial one); 0 where either does not vary.
        left: likewise.
        right: likewise.
        chosen: whether the forest is given it.
        reason: why not; empty where it is.
    """

    feature: str
    keep: float
    left: float
    right: float
    chosen: bool
    reason: str

    @property
    def strength(self) -> float:
        """The greatest of the three, whatever their signs."""
        return max(abs(self.keep), abs(self.left), abs(self.right))

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


def choose_features(feature: Floats, maneuver: Bytes, *, least: float, most: float) -> list[Coefficient]:
    """Every candidate with its coefficients, from the strongest to the weakest; of two alike, the first in FEATURES.

    In that order a feature is chosen where its strength is `least` or more, and no feature chosen before correlates
    with it, either way, by more than `most`.

    Args:
        feature: (B, features) in the order of FEATURES.
        maneuver: (B,) position in LATERAL_MANEUVERS.
        least: see above.
        most: see above.
    """
    classes = (maneuver[:, None] == np.arange(len(LATERAL_MANEUVERS))).astype(np.float64)
    values = feature.astype(np.float64)
    coefficient, between = correlate(values, classes), np.abs(correlate(values, values))
    chosen: list[int] = []
    table = []
    for number in np.argsort(-np.abs(coefficient).max(axis=1), kind="stable"):
        reason = ""
        if np.abs(coefficient[number]).max() < least:
            reason = f"below {least:g}"
        elif twins := [other for other in chosen if between[number, other] > most]:
            reason = f"as {NAMES[twins[0]]} ({between[number, twins[0]]:.3f})"
        else:
            chosen.append(int(number))
        keep, left, right = map(float, coefficient[number])
        table.append(Coefficient(NAMES[number], keep, left, right, chosen=not reason, reason=reason))
    return table


def correlate(left: npt.NDArray[np.float64], right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(P, Q) Pearson's coefficients of columns (B, P) with columns (B, Q); 0 where one does not vary."""
    left, right = _standardise(left), _standardise(right)
    return np.clip(left.T @ right, -1, 1)


def _standardise(columns: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Columns of mean 0 and length 1; of zeros where they do not vary."""
    if not len(columns):
        return columns
    centred = columns - columns.mean(axis=0)
    length = np.sqrt((centred**2).sum(axis=0))
    varies = length > 1e-9 * np.sqrt(len(columns)) * np.maximum(1.0, np.abs(columns).max(axis=0))
    return np.where(varies, centred, 0.0) / np.where(varies, length, 1.0)
