"""Nine cells around the place where a vehicle would be at a horizon if it kept its velocity: 3 lanes by 3 rows.

Columns are lanes: the vehicle's own, and one lane's width to either side. Rows lie along the road: the middle one
around the constant-velocity place, one behind, one ahead. A place outside of all nine has a column or row of its own,
which is no cell: it is counted, and a prediction is never right there.

Source: Choi et al. 2021, https://doi.org/10.3390/electronics10040420.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.tensors import NOMINAL_LANE_M

Codes = npt.NDArray[np.int8]
"""Columns: -1 left, 0 own, 1 right. Rows: -1 behind, 0 middle, 1 ahead. -2 and 2: outside on that side."""

OUTSIDE = 2
LEAST_ROW_M = 1.0
ROW_S = 1.0
"""A row is as long as the way that target and ego gain on each other in this time, and LEAST_ROW_M at least."""


def find_columns(side_m: npt.NDArray[np.floating], lanes: Floats) -> Codes:
    """(B, ...) the column of places that lie so far to the right of each vehicle (B, ...).

    Args:
        side_m: across the road, relative to the vehicle's place at the moment of prediction.
        lanes: (B, 3, 3) as in `ObservedScene`; where the own lane is unknown, one of NOMINAL_LANE_M around the vehicle
            is taken.
    """
    known = lanes[:, 1, 2] > 0
    axes = tuple(range(1, side_m.ndim))
    centre = np.expand_dims(np.where(known, lanes[:, 1, 0], 0.0), axes)
    width = np.expand_dims(np.where(known, lanes[:, 1, 1], NOMINAL_LANE_M), axes)
    return _number((side_m - centre) / width)


def find_rows(along_m: npt.NDArray[np.floating], middle_m: npt.NDArray[np.floating], length_m: Floats) -> Codes:
    """(B, T) the row of places along the road.

    Args:
        along_m: (B, T) places at the horizons.
        middle_m: (B, T) the constant-velocity places at the same.
        length_m: (B,) of a row.
    """
    return _number((along_m - middle_m) / length_m[:, None])


def measure_rows(relative_speed_mps: Floats, ego: npt.NDArray[Any]) -> Floats:
    """(B,) how long a row is: what the relative speed makes in 1 s, at least 1 m; 1 m where there is no ego.

    Args:
        relative_speed_mps: (B,) of target and ego.
        ego: (B,) whether there is one.
    """
    length: Floats = np.maximum(LEAST_ROW_M, np.where(ego > 0, np.abs(relative_speed_mps) * ROW_S, 0.0)).astype(
        np.float32
    )
    return length


def number_cells(column: Codes, row: Codes) -> Codes:
    """The cell of each column and row: 0 to 8, from left to right, in each column from behind to ahead; -1 outside."""
    inside = (np.abs(column) < OUTSIDE) & (np.abs(row) < OUTSIDE)
    return np.where(inside, 3 * (column + 1) + row + 1, -1).astype(np.int8)


def _number(steps: npt.NDArray[np.floating]) -> Codes:
    """Steps from the middle's centre as codes: [-0.5, 0.5) is 0."""
    codes: Codes = np.clip(np.floor(steps + 0.5), -OUTSIDE, OUTSIDE).astype(np.int8)
    return codes
