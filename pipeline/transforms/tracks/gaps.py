"""The gap to the leader, by a look-up of the leader's row; a join would take five times as long."""

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.resample import join_key
from tracklake.schemas.arrays import find_run_starts

NO_LEADER = -1
"""Id that no vehicle has, for entries without a leader."""


def add_gaps(tracks: pl.DataFrame, vehicles: pl.DataFrame, *, use_recorded_headway: bool) -> pl.DataFrame:
    """Add gap_m: the leader's front - the leader's length - the own front, rounded to 1 mm.

    `tracks` have vehicle_id, frame, x_m, leader_id, headway_recorded_m of one subset, sorted by the first two. Without
    a known length_m of the leader there is no gap. With `use_recorded_headway` a leader without an entry at that frame
    has a gap of the recorded headway (front to front) - its length.
    """
    ids, frames, x_m = (tracks[name].to_numpy() for name in ("vehicle_id", "frame", "x_m"))
    leader = tracks["leader_id"].fill_null(NO_LEADER).to_numpy()
    lengths = vehicles.select("vehicle_id", pl.col("length_m").cast(pl.Float64).fill_null(np.nan))
    known = np.union1d(np.append(ids, NO_LEADER) if not ids.size else ids[find_run_starts(ids)], lengths["vehicle_id"])
    at = np.minimum(np.searchsorted(known, leader), len(known) - 1)
    is_known = known[at] == leader
    row, is_present = _find_rows(ids, frames, known, at)
    is_present &= is_known
    headway_m = np.where(is_present, x_m[row] - x_m, np.nan) if ids.size else np.empty(0)
    if use_recorded_headway:
        recorded_m = tracks["headway_recorded_m"].cast(pl.Float64).fill_null(np.nan).to_numpy()
        headway_m = np.where(is_present, headway_m, recorded_m)
    length_m = np.full(len(known), np.nan)
    length_m[np.searchsorted(known, lengths["vehicle_id"])] = lengths["length_m"]
    gap_m = np.where(is_known, headway_m - length_m[at], np.nan)
    return tracks.with_columns(pl.Series("gap_m", gap_m, nan_to_null=True).round(3))


def find_rows(
    ids: npt.NDArray[np.int32], frames: npt.NDArray[np.int32], wanted: npt.NDArray[np.integer]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Find the row of vehicle `wanted[i]` at the frame of entry i, (N,), and whether there is one.

    The entries are sorted by vehicle and frame.
    """
    known = ids[find_run_starts(ids)]
    at = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    row, is_present = _find_rows(ids, frames, known, at)
    return row, is_present & (known[at] == wanted) if ids.size else is_present


def _find_rows(
    ids: npt.NDArray[np.int32], frames: npt.NDArray[np.int32], known: npt.NDArray[np.int32], at: npt.NDArray[np.intp]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Find the row of vehicle `known[at]` at each entry's frame, and whether there is one.

    In a track without gaps the row follows from the track's first row and frame; only tracks with gaps are searched.
    """
    if not ids.size:
        return np.empty(0, np.intp), np.empty(0, bool)
    first_row = find_run_starts(ids)
    last_row = np.append(first_row[1:], len(ids)) - 1
    vehicle = np.searchsorted(known, ids[first_row])
    low, high, shift = np.ones(len(known), np.intp), np.zeros(len(known), np.intp), np.zeros(len(known), np.intp)
    low[vehicle], high[vehicle], shift[vehicle] = first_row, last_row, first_row - frames[first_row]
    row = shift[at] + frames
    is_present = (row >= low[at]) & (row <= high[at])
    row[~is_present] = 0
    is_present &= frames[row] == frames
    has_gaps = np.zeros(len(known), bool)
    has_gaps[vehicle] = frames[last_row] - frames[first_row] > last_row - first_row
    unsure = np.flatnonzero(has_gaps[at] & ~is_present) if has_gaps.any() else np.empty(0, np.intp)
    if unsure.size:
        keys, wanted = join_key(ids, frames), join_key(known[at[unsure]], frames[unsure])
        found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        row[unsure], is_present[unsure] = found, keys[found] == wanted
    return row, is_present
