"""Storage of positions in tensors: float32, or int16 in whole steps from the subset's centre."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats, Singles
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import STEPS_M

REACH = 2**15 - 1
"""Largest number of steps in int16."""
_ALONG, _ACROSS = "along the road", "across it"


@dataclass(frozen=True)
class Stored:
    """Stored positions, (N, 2) float32 in m or int16 steps from a centre; rounding errors along and across."""

    steps: Singles | npt.NDArray[np.int16]
    centre_m: tuple[float, float]
    max_error_m: tuple[float, float]
    squared_error_m2: tuple[float, float]


def find_centre(medians_m: Sequence[float], storage: str) -> tuple[float, float]:
    """Return the origin of stored positions: the medians in whole steps, so that positions on their grid are exact."""
    step = np.array(STEPS_M[storage])
    along, across = np.round(np.array(medians_m) / step) * step
    return float(along), float(across)


def store_positions(
    x_m: Floats,
    y_m: Floats,
    *,
    storage: str,
    where: str,
    centre_m: tuple[float, float] | None = None,
    earlier_m2: tuple[float, float] = (0.0, 0.0),
) -> Stored:
    """Round (N,) positions along the direction of travel and across it to one of POSITION_STORAGES; measure the error.

    Args:
        x_m: positions along the direction of travel.
        y_m: positions across it.
        storage: one of POSITION_STORAGES.
        where: the subset, for messages.
        centre_m: origin of int16 positions; None: that of these.
        earlier_m2: sums of the squared errors of rows before these.

    Raises:
        TracklakeError: a position lies farther from the median than int16 reaches in the storage's steps.

    Source: DESIGN section 9 (decimetres around the median; centimetres only where they fit, else refused).
    """
    given = np.stack([x_m, y_m], axis=-1).astype(np.float64, copy=False)
    if storage not in STEPS_M:
        steps: Singles | npt.NDArray[np.int16] = given.astype(np.float32)
        centre = np.zeros(2)
        read = steps.astype(np.float64)
    else:
        step = np.array(STEPS_M[storage])
        if centre_m is None:
            centre_m = find_centre(np.median(given, axis=0).tolist(), storage) if len(given) else (0.0, 0.0)
        centre = np.array(centre_m)
        counted = np.round((given - centre) / step)
        for axis, name in enumerate((_ALONG, _ACROSS)):
            farthest = float(np.abs(counted[:, axis]).max(initial=0.0))
            if farthest > REACH:
                raise TracklakeError(
                    f"{where}: positions {name} reach {farthest * step[axis]:.2f} m from the median; int16 in steps of "
                    f"{step[axis]:g} m reaches {REACH * step[axis]:.2f} m. Set `tensor_positions` to int16-decimetres "
                    "or float32."
                )
        steps = counted.astype(np.int16)
        read = (centre + counted * step).astype(np.float32).astype(np.float64)
    error = np.abs(read - given)
    worst, squares = error.max(axis=0, initial=0.0), np.vstack([earlier_m2, error**2]).sum(axis=0)
    return Stored(
        steps=steps,
        centre_m=(float(centre[0]), float(centre[1])),
        max_error_m=(float(worst[0]), float(worst[1])),
        squared_error_m2=(float(squares[0]), float(squares[1])),
    )
