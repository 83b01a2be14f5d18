"""Maneuver codes of convolutional social pooling's script, from windows of rows clamped to the track."""

import numpy as np
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries

LANE_ROWS = 40
"""Rows before and after an entry whose lanes are compared with its own."""
BRAKE_ROWS_BEHIND = 30
"""Rows of the past speed's window."""
BRAKE_ROWS_AHEAD = 50
"""Rows of the future speed's window."""
BRAKE_RATIO = 0.8
"""Ratio of future to past speed below which a vehicle brakes."""
KEEP, LEFT, RIGHT = 1, 2, 3
NORMAL, BRAKE = 1, 2

Codes = NDArray[np.uint8]


def code_maneuvers(entries: CspEntries) -> tuple[Codes, Codes]:
    """Compute the lateral and the longitudinal code of every entry (preprocess_data.m, 'Parse fields').

    - lateral: 3 (right) if the lane number grows over either window (tested first), else 2 (left) if it falls over
      either, else 1 (keep).
    - longitudinal: 2 (brake) if vFut / vHist < 0.8, displacements per row over the next 50 and the last 30 rows; 1
      (normal) at the first and the last row of a track. All in single precision with IEEE division: a vehicle that
      stood still brakes if it moves backwards next (-Inf), and otherwise does not (Inf, NaN).

    Windows count rows, as in the script, so they last longer where a track skips frames.
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
        # Single 0.8 is greater than double 0.8 and no single lies between, so both comparisons agree.
        slower = future / past < np.float32(BRAKE_RATIO)
    brake = slower & (ahead > row) & (behind < row)
    return lateral, np.where(brake, np.uint8(BRAKE), np.uint8(NORMAL))
