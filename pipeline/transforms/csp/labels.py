"""Maneuver codes as convolutional social pooling's script gives them: windows of rows, clamped to the track."""

import numpy as np
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries

LANE_ROWS = 40
"""The lane now is compared with the lane so many rows before and after."""
BRAKE_ROWS_BEHIND = 30
BRAKE_ROWS_AHEAD = 50
BRAKE_RATIO = 0.8
KEEP, LEFT, RIGHT = 1, 2, 3
NORMAL, BRAKE = 1, 2

Codes = NDArray[np.uint8]


def code_maneuvers(entries: CspEntries) -> tuple[Codes, Codes]:
    """Give every entry its lateral and its longitudinal code (preprocess_data.m, 'Parse fields').

    - lateral: 3 (right) where the lane number grows over either window (tested first), else 2 (left) where it falls
      over either, else 1 (keep).
    - longitudinal: 2 (brake) where vFut / vHist < 0.8, displacements per row over the next 50 and the last 30 rows; at
      the first and the last row of a track 1 (normal). All in single precision, and as IEEE divides: standing still
      so far, a vehicle brakes if it goes backwards next (-Inf), and else does not (Inf, NaN).

    Windows count rows, as the script does: where a track skips frames they last longer.

    Args:
        entries: of one subset.

    Returns:
        Two arrays (N,): 1 keep, 2 left, 3 right; 1 normal, 2 brake.
    """
    row = np.arange(entries.height)
    first, last = entries.bound_tracks()

    lane = entries.lane
    before, after = lane[np.maximum(row - LANE_ROWS, first)], lane[np.minimum(row + LANE_ROWS, last)]
    right = (after > lane) | (lane > before)
    left = (after < lane) | (lane < before)
    lateral = np.where(right, np.uint8(RIGHT), np.where(left, np.uint8(LEFT), np.uint8(KEEP)))

    y_ft = entries.y_ft
    behind, ahead = np.maximum(row - BRAKE_ROWS_BEHIND, first), np.minimum(row + BRAKE_ROWS_AHEAD, last)
    with np.errstate(divide="ignore", invalid="ignore"):
        past = (y_ft - y_ft[behind]) / (row - behind).astype(np.float32)
        future = (y_ft[ahead] - y_ft) / (ahead - row).astype(np.float32)
        # Single 0.8 is greater than double 0.8 and no single lies between: either comparison says the same.
        slower = future / past < np.float32(BRAKE_RATIO)
    brake = slower & (ahead > row) & (behind < row)
    return lateral, np.where(brake, np.uint8(BRAKE), np.uint8(NORMAL))
