"""Lane changes as maneuvers with a beginning and an end, and which of them every row belongs to.

What is said here of a row uses rows after it: it is for training and for scores, never for a prediction.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Flags, Integers
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.positions import locate_rows
from tracklake.training.data.tensor_folder import TensorFolder

KEEP, LEFT, RIGHT = (LATERAL_MANEUVERS.index(name) for name in ("keep", "left", "right"))

START_S = 4.0
"""T_d: how long before its end a maneuver begins. The publication gives none; the samples' lateral maneuvers are looked
for within 4 s, too."""
TOLERANCE_M = 0.1
"""A vehicle this near the target lane's centre has reached it."""


@dataclass(frozen=True)
class Maneuvers:
    """E lane changes of a tensor folder, in the order of its rows.

    Args:
        start_row: (E,) the first row of the maneuver.
        end_row: (E,) its last row, T_e; increasing.
        lateral: (E,) position in `schemas.columns.LATERAL_MANEUVERS`: left or right.
    """

    start_row: Integers
    end_row: Integers
    lateral: Bytes


def count_start_ticks(protocol: Protocol, start_s: float) -> int:
    """T_d in ticks."""
    return round(start_s * protocol.rate_hz)


def find_maneuvers(folder: TensorFolder, *, start_s: float = START_S, tolerance_m: float = TOLERANCE_M) -> Maneuvers:
    """Every lane change of every run, from T_e - T_d to T_e.

    A lane changes where it differs from that of the row before in the same run; a change from or to an unknown lane
    (0) is none. T_e is the first row from then on at which the vehicle is at the new lane's centre (within the
    tolerance) or beyond it, as seen in the direction of the change. It is sought until the vehicle leaves the lane, the
    run ends or T_d has passed; where it does not come to that, T_e is the row nearest to the centre among these, the
    first of them. So every maneuver holds the row at which its lane changes. No maneuver begins before its run.

    Lanes lie between their markings; where none are known, they are NOMINAL_LANE_M wide from the carriageway's left
    edge on.

    Args:
        folder: whose runs.
        start_s: T_d.
        tolerance_m: how near the centre is at the centre.

    Source: Choi et al. 2021, https://doi.org/10.3390/electronics10040420 (keeping, left and right by T_e and T_d).
    """
    lane, rows, ticks = folder.lane, len(folder.lane), count_start_ticks(folder.protocol, start_s)
    run_begins = np.zeros(rows + 1, dtype=np.bool_)
    run_begins[folder.run_first_row] = True
    stay_begins = run_begins.copy()
    stay_begins[1:-1] |= lane[1:] != lane[:-1]
    stays = np.flatnonzero(stay_begins)  # each stretch of a run in one lane; one more at the end
    first = stays[:-1]
    changes = np.flatnonzero(~run_begins[first] & (lane[first] > 0) & (lane[first - 1] > 0))
    if not len(changes):
        nothing = np.empty(0, dtype=np.int64)
        return Maneuvers(nothing, nothing, np.empty(0, dtype=np.uint8))

    first, last = first[changes], np.minimum(stays[changes + 1] - 1, first[changes] + ticks)
    to_right = lane[first] > lane[first - 1]
    looked_at, change = _spread(first, last)
    begins = np.searchsorted(change, np.arange(len(first)))
    offset = _find_offsets(folder, looked_at)
    there = np.where(to_right[change], offset, -offset) >= -tolerance_m
    distance = np.abs(offset)
    nearest = distance == np.minimum.reduceat(distance, begins)[change]
    reached = np.minimum.reduceat(np.where(there, looked_at, rows), begins)
    end = np.where(reached < rows, reached, np.minimum.reduceat(np.where(nearest, looked_at, rows), begins))
    start = np.maximum(end - ticks, folder.run_first_row[folder.runs_of(end)])
    return Maneuvers(start, end, np.where(to_right, RIGHT, LEFT).astype(np.uint8))


def label_rows(folder: TensorFolder, maneuvers: Maneuvers) -> Bytes:
    """(N,) the maneuver of every row, as its position in LATERAL_MANEUVERS.

    Where two maneuvers overlap, the earlier one holds until its end.
    """
    labels = np.full(len(folder.lane), KEEP, dtype=np.uint8)
    if len(maneuvers.end_row):
        after_the_last = np.concatenate([[0], maneuvers.end_row[:-1] + 1])
        rows, which = _spread(np.maximum(maneuvers.start_row, after_the_last), maneuvers.end_row)
        labels[rows] = maneuvers.lateral[which]
    return labels


def find_judged(folder: TensorFolder, row: npt.NDArray[np.integer], *, start_s: float = START_S) -> Flags:
    """(B,) rows of which a label can be known: their run goes on for T_d, so that a change would have been seen.

    Nearer to a track's end keeping cannot be told from a change that comes too late to be recorded. Such rows are left
    out whatever their label, or changes would be too frequent among them.
    """
    last = folder.run_first_row[folder.runs_of(row) + 1] - 1
    judged: Flags = last - row >= count_start_ticks(folder.protocol, start_s)
    return judged


def _find_offsets(folder: TensorFolder, row: Integers) -> npt.NDArray[np.float64]:
    """(B,) how far each row's vehicle is right of the centre of the lane it is in, m."""
    subset, lane, lanes = folder.run_subset[folder.runs_of(row)], folder.lane[row].astype(np.intp), folder.lanes
    centre = lanes.centre_m[subset, np.minimum(lane, lanes.centre_m.shape[1] - 1)]
    centre = np.where(np.isnan(centre), (lane - 0.5) * NOMINAL_LANE_M, centre)
    y_m = locate_rows(folder, row)[:, 1]
    offset: npt.NDArray[np.float64] = y_m.astype(np.float64) - centre
    return offset


def _spread(first: Integers, last: Integers) -> tuple[Integers, Integers]:
    """The rows first to last of each range one after the other, and the range that each is of."""
    counts = last - first + 1
    which = np.repeat(np.arange(len(first)), counts)
    return np.arange(len(which)) + np.repeat(first - (np.cumsum(counts) - counts), counts), which
