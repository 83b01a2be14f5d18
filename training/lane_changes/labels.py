"""Lane changes as maneuvers with a start and an end, and the maneuver that every row belongs to.

Labels use rows after the labelled one: they are for training and for scores, never for a prediction.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Flags, Floats, Integers, expand_ranges
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.gathers import locate_rows
from tracklake.training.data.tensor_folder import TensorFolder

KEEP, LEFT, RIGHT = (LATERAL_MANEUVERS.index(name) for name in ("keep", "left", "right"))

START_S = 4.0
"""T_d, time from a maneuver's start to its end, s. The publication gives none; the samples' own lateral maneuvers are
sought within 4 s, too."""
TOLERANCE_M = 0.1
"""Distance from the target lane's centre at which a vehicle has reached it, m."""


@dataclass(frozen=True)
class Maneuvers:
    """Lane changes of a tensor folder, E of them, in the order of its rows.

    Args:
        start_row: (E,) first row of the maneuver.
        end_row: (E,) last row of the maneuver, at T_e; increasing.
        lateral: (E,) LEFT or RIGHT.
    """

    start_row: Integers
    end_row: Integers
    lateral: Bytes


def find_maneuvers(folder: TensorFolder, *, start_s: float = START_S, tolerance_m: float = TOLERANCE_M) -> Maneuvers:
    """Find every lane change of every run, from T_e - T_d to T_e.

    A lane changes where it differs from that of the row before in the same run; changes from or to an unknown lane (0)
    do not count. T_e is the first row from then on at which the vehicle is at the new lane's centre (within the
    tolerance) or beyond it, in the direction of the change. It is sought until the vehicle leaves the lane, the run
    ends or T_d has passed; if the centre is not reached by then, T_e is the first of the rows nearest to it. So every
    maneuver holds the row at which its lane changes. No maneuver starts before its run.

    Lanes lie between their markings; where none are known, they are NOMINAL_LANE_M wide from the carriageway's left
    edge on.

    Source: Choi et al. 2021, https://doi.org/10.3390/electronics10040420 (keeping, left and right by T_e and T_d).
    """
    lane, rows, ticks = folder.lane, len(folder.lane), _count_start_ticks(folder, start_s)
    run_begins = np.zeros(rows + 1, dtype=np.bool_)
    run_begins[folder.run_first_row] = True
    stay_begins = run_begins.copy()
    stay_begins[1:-1] |= lane[1:] != lane[:-1]
    stays = np.flatnonzero(stay_begins)  # first row of each stretch of a run in one lane, and the number of rows
    first = stays[:-1]
    changes = np.flatnonzero(~run_begins[first] & (lane[first] > 0) & (lane[first - 1] > 0))
    if not len(changes):
        none = np.empty(0, dtype=np.int64)
        return Maneuvers(none, none, none.astype(np.uint8))

    first, last = first[changes], np.minimum(stays[changes + 1] - 1, first[changes] + ticks)
    to_right = lane[first] > lane[first - 1]
    row, change = expand_ranges(first, last - first + 1)
    begins = np.searchsorted(change, np.arange(len(first)))
    offset = _find_offsets(folder, row)
    distance = np.abs(offset)
    is_reached = np.where(to_right[change], offset, -offset) >= -tolerance_m
    is_nearest = distance == np.minimum.reduceat(distance, begins)[change]
    reached, nearest = (np.minimum.reduceat(np.where(flags, row, rows), begins) for flags in (is_reached, is_nearest))
    end = np.where(reached < rows, reached, nearest)
    start = np.maximum(end - ticks, folder.run_first_row[folder.runs_of(end)])
    return Maneuvers(start, end, np.where(to_right, RIGHT, LEFT).astype(np.uint8))


def label_rows(folder: TensorFolder, maneuvers: Maneuvers) -> Bytes:
    """Label all N rows of a folder with KEEP, LEFT or RIGHT: (N,).

    Where two maneuvers overlap, the earlier one holds until its end.
    """
    labels = np.full(len(folder.lane), KEEP, dtype=np.uint8)
    free = np.concatenate([[0], maneuvers.end_row + 1])[:-1]  # first row after the maneuver before
    start = np.maximum(maneuvers.start_row, free)
    rows, which = expand_ranges(start, maneuvers.end_row - start + 1)
    labels[rows] = maneuvers.lateral[which]
    return labels


def find_labelled(folder: TensorFolder, row: npt.NDArray[np.integer], *, start_s: float = START_S) -> Flags:
    """Find rows (B,) whose label can be known: their run goes on for T_d, so that a change would have been recorded.

    Nearer to a track's end, keeping looks the same as a change that comes too late to be recorded. Such rows are left
    out whatever their label, or changes would be too frequent among them.
    """
    last = folder.run_first_row[folder.runs_of(row) + 1] - 1
    labelled: Flags = last - row >= _count_start_ticks(folder, start_s)
    return labelled


def _count_start_ticks(folder: TensorFolder, start_s: float) -> int:
    """Convert T_d to ticks of a folder."""
    return round(start_s * folder.protocol.rate_hz)


def _find_offsets(folder: TensorFolder, row: Integers) -> Floats:
    """Measure how far each row's vehicle is right of its lane's centre: (B,), m."""
    subset, lane, lanes = folder.run_subset[folder.runs_of(row)], folder.lane[row].astype(np.intp), folder.lanes
    centre = lanes.centre_m[subset, np.minimum(lane, lanes.centre_m.shape[1] - 1)]
    centre = np.where(np.isnan(centre), (lane - 0.5) * NOMINAL_LANE_M, centre)
    y_m = locate_rows(folder, row)[:, 1]
    offset: Floats = y_m.astype(np.float64) - centre
    return offset
