"""Maneuver labels of the entries on a protocol's clock."""

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import bound_runs
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS

LANE_WINDOW_S = 4
"""Time before and after an entry at which lanes are compared with its own, in s."""
BRAKE_HISTORY_S = 3
"""Window of the past mean speed, in s."""
BRAKE_FUTURE_S = 5
"""Window of the future mean speed, in s."""
BRAKE_RATIO = (4, 5)
"""Ratio of future to past mean speed below which a vehicle brakes: 0.8 as a fraction."""
UNITS_PER_M = 1e7
"""Units of displacement per m. A millimetre and a thousandth of a foot are whole numbers of units, so rounding does not
decide whether a ratio is exactly 0.8."""


def label_maneuvers(clock: pl.DataFrame, *, rate_hz: int) -> pl.DataFrame:
    """Label every entry on the clock with its lateral and its longitudinal maneuver (DESIGN section 7).

    The windows follow the code of convolutional social pooling (Deo and Trivedi 2018, preprocess_data.m), not the
    paper's text: the lane now against the lane 4 s before and 4 s after, and the mean speed (displacement / time) over
    the next 5 s against that over the last 3 s. Windows are clamped to the entry's gap-free segment.

    - lateral: `right` if the lane number grows over either window (tested first), else `left` if it falls over
      either, else `keep`. Lane 1 is the driver's leftmost.
    - longitudinal: `brake` if mean speed ahead / mean speed behind < 0.8, else `normal`. An empty window on either
      side, or a history without forward progress (standing, or pushed backwards by noise), is `normal`.

    The clock has x_m, lane (without nulls) and segment, from `put_on_clock`. Returns lateral_maneuver and
    longitudinal_maneuver (Enums) of every entry, in its order.

    Raises:
        ValueError: a lane is null.
    """
    if clock["lane"].null_count():
        raise ValueError(f"{clock['lane'].null_count()} of {clock.height} entries have no lane: maneuvers need one")
    row = np.arange(clock.height)
    first, last = bound_runs(clock["segment"].to_numpy())

    lane = clock["lane"].to_numpy()
    lane_before = lane[np.maximum(row - LANE_WINDOW_S * rate_hz, first)]
    lane_after = lane[np.minimum(row + LANE_WINDOW_S * rate_hz, last)]
    right = (lane_after > lane) | (lane > lane_before)
    left = (lane_after < lane) | (lane < lane_before)
    lateral = np.where(right, np.uint8(2), left.astype(np.uint8))

    x_m = clock["x_m"].to_numpy()
    behind = np.maximum(row - BRAKE_HISTORY_S * rate_hz, first)
    ahead = np.minimum(row + BRAKE_FUTURE_S * rate_hz, last)
    driven = np.rint((x_m - x_m[behind]) * UNITS_PER_M).astype(np.int64)
    to_drive = np.rint((x_m[ahead] - x_m) * UNITS_PER_M).astype(np.int64)
    share, whole = BRAKE_RATIO
    brake = (ahead > row) & (driven > 0) & (whole * to_drive * (row - behind) < share * driven * (ahead - row))
    return pl.DataFrame(
        {
            "lateral_maneuver": _to_enum(lateral, LATERAL_MANEUVERS),
            "longitudinal_maneuver": _to_enum(brake.astype(np.uint8), LONGITUDINAL_MANEUVERS),
        }
    )


def _to_enum(codes: NDArray[np.uint8], names: tuple[str, ...]) -> pl.Series:
    return pl.Series(codes, dtype=pl.UInt8).cat.to(pl.Enum(names))
