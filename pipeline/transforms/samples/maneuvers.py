"""Maneuver labels of the entries on a protocol's clock."""

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.resample import bound_segments
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS

LANE_WINDOW_S = 4
"""The lane now is compared with the lane this long before and after."""
BRAKE_HISTORY_S = 3
BRAKE_FUTURE_S = 5
BRAKE_RATIO = (4, 5)
"""0.8 as a fraction: `brake` where the mean speed ahead is less than this share of the mean speed behind."""
UNITS_PER_M = 1e7
"""Displacements are compared as whole tenths of a micrometre: a millimetre and a thousandth of a foot are both whole
numbers of them, so that rounding does not decide whether a ratio is 0.8 exactly."""


def label_maneuvers(clock: pl.DataFrame, *, rate_hz: int) -> pl.DataFrame:
    """Label every entry on the clock with its lateral and its longitudinal maneuver (DESIGN section 7).

    The windows follow the code of convolutional social pooling (Deo and Trivedi 2018, preprocess_data.m), not its
    text: the lane now against the lane 4 s before and 4 s after, and the mean speed (displacement / elapsed) over the
    next 5 s against that over the last 3 s. They are clamped to the track; where the track has gaps, to the gap-free
    segment that the entry stands in, since what lies across a gap is not bridged.

    - lateral: `right` where the lane number grows over either window (tested first), else `left` where it falls over
      either, else `keep`. Lane 1 is the driver's leftmost.
    - longitudinal: `brake` where mean speed ahead / mean speed behind < 0.8, else `normal`. An empty window on either
      side, or a history without forward progress (standing, or pushed backwards by noise), is `normal`.

    Args:
        clock: x_m, lane, segment as `put_on_clock` leaves them; lane without nulls.
        rate_hz: ticks per second of the clock.

    Returns:
        One row per entry, in the same order: lateral_maneuver, longitudinal_maneuver (Enums).

    Raises:
        ValueError: a lane is null.
    """
    if clock["lane"].null_count():
        raise ValueError(f"{clock['lane'].null_count()} of {clock.height} entries have no lane: maneuvers need one")
    row = np.arange(clock.height)
    first, last = bound_segments(clock)

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
            "lateral_maneuver": _name(lateral, LATERAL_MANEUVERS),
            "longitudinal_maneuver": _name(brake.astype(np.uint8), LONGITUDINAL_MANEUVERS),
        }
    )


def _name(codes: NDArray[np.uint8], names: tuple[str, ...]) -> pl.Series:
    return pl.Series(codes, dtype=pl.UInt8).cat.to(pl.Enum(names))
