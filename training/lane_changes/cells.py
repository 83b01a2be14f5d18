"""Nine cells around the place where a vehicle would be at a horizon if it kept its velocity: 3 lanes by 3 rows.

Columns are lanes: the vehicle's own, and one lane's width to either side. Rows lie along the road: around the
constant-velocity place, behind and ahead. A place outside all nine is in no cell, where no prediction is right.

Source: Choi et al. 2021, https://doi.org/10.3390/electronics10040420.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Singles
from tracklake.schemas.tensors import NOMINAL_LANE_M

Codes = npt.NDArray[np.int8]
"""Columns: -1 left, 0 own, 1 right. Rows: -1 behind, 0 middle, 1 ahead. -2 and 2: outside on that side."""

OUTSIDE = 2
"""Absolute value of the codes of places outside all cells."""
LEAST_ROW_M = 1.0
"""Smallest length of a row, m."""
ROW_S = 1.0
"""Length of a row in time, s: the distance by which target and ego approach or separate meanwhile."""


def find_columns(side_m: npt.NDArray[np.floating], lanes: Singles) -> Codes:
    """Find the columns of places across the road, in the shape of `side_m`.

    `side_m` (B, ...) is measured to the right of each vehicle's place at the moment of prediction, m; `lanes` (B, 3, 3)
    is as in `ObservedScene`. An unknown own lane is NOMINAL_LANE_M wide around the vehicle.
    """
    known = lanes[:, 1, 2] > 0
    axes = tuple(range(1, side_m.ndim))
    centre = np.expand_dims(np.where(known, lanes[:, 1, 0], 0.0), axes)
    width = np.expand_dims(np.where(known, lanes[:, 1, 1], NOMINAL_LANE_M), axes)
    return _round_steps((side_m - centre) / width)


def find_rows(along_m: npt.NDArray[np.floating], middle_m: npt.NDArray[np.floating], length_m: Singles) -> Codes:
    """Find the rows (B, T) of places (B, T) from constant-velocity places (B, T) and the length of a row (B,), m."""
    return _round_steps((along_m - middle_m) / length_m[:, None])


def measure_rows(relative_speed_mps: Singles, ego: npt.NDArray[Any]) -> Singles:
    """Compute the length of a row, m: (B,), from the target's speed minus the ego's; `ego` is 0 where there is none."""
    length_m = np.maximum(LEAST_ROW_M, np.where(ego > 0, np.abs(relative_speed_mps) * ROW_S, 0.0))
    return length_m.astype(np.float32)


def number_cells(column: Codes, row: Codes) -> Codes:
    """Number cells from 0 to 8, from left to right, in each column from behind to ahead; -1 outside."""
    inside = (np.abs(column) < OUTSIDE) & (np.abs(row) < OUTSIDE)
    return np.where(inside, 3 * (column + 1) + row + 1, -1).astype(np.int8)


def _round_steps(steps: npt.NDArray[np.floating]) -> Codes:
    """Convert steps from the middle's centre to codes: [-0.5, 0.5) is 0."""
    codes: Codes = np.clip(np.floor(steps + 0.5), -OUTSIDE, OUTSIDE).astype(np.int8)
    return codes
