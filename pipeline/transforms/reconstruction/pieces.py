"""Pieces of tracks on a regular clock: the entries of a vehicle without a long gap, short gaps filled."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Flags, Floats, Integers, expand_ranges, find_run_starts

LEAST_ENTRIES = 4
"""Recorded entries that a piece needs: a third difference has four positions."""


@dataclass(frozen=True)
class Pieces:
    """All pieces of a subset, one after the other, with one point per frame; N points, P pieces.

    Args:
        tracks: the recorded entries that the points stand for, sorted by vehicle and frame.
        first: (P,) first point of each piece.
        size: (P,) points of each piece.
        row: (N,) row of `tracks` at each point, or that of the entry before a filled one.
        frame: (N,) frame of each point.
        recorded: (N,) whether the point was recorded; the others fill gaps.
        rate_hz: points per second.
    """

    tracks: pl.DataFrame
    first: Integers
    size: Integers
    row: Integers
    frame: Integers
    recorded: Flags
    rate_hz: float

    @property
    def points(self) -> int:
        """Number of points of all pieces."""
        return len(self.row)

    def interpolate(self, column: str) -> Floats:
        """Return a column of the tracks at every point, (N,): linear between recorded entries."""
        values = self.tracks[column].to_numpy().astype(np.float64)
        if not self.points:
            return np.empty(0)
        following = np.minimum(self.row + 1, len(values) - 1)
        frames = self.tracks["frame"].to_numpy().astype(np.int64)
        step = np.maximum(frames[following] - frames[self.row], 1)
        share = np.where(self.recorded, 0.0, (self.frame - frames[self.row]) / step)
        here = values[self.row]
        return np.where(self.recorded, here, here + share * (values[following] - here))


@dataclass(frozen=True)
class Skip:
    """Entries left out for one reason; see the table `reconstruction_skips`."""

    reason: str
    vehicles: int
    entries: int
    left_out: str


def cut_pieces(tracks: pl.DataFrame, facts: Mapping[str, Any], max_gap_s: float) -> tuple[Pieces, list[Skip]]:
    """Cut tracks at gaps longer than `max_gap_s` and fill shorter ones; also list what is left out.

    Args:
        tracks: vehicle_id, frame and other columns of one subset, in any order.
        facts: the subset's row of `subsets`.
        max_gap_s: longest time between two entries that is filled.
    """
    rate_hz = float(facts["frame_rate_hz"])
    tracks = tracks.sort("vehicle_id", "frame")
    skips: list[Skip] = []

    def drop(reason: str, out: Flags, left_out: str) -> None:
        nonlocal tracks
        if out.any():
            skips.append(Skip(reason, tracks.filter(out)["vehicle_id"].n_unique(), int(out.sum()), left_out))
            tracks = tracks.filter(~out)

    if not facts["freeway"]:
        drop("arterial", np.ones(tracks.height, bool), "everything: vehicles stop, turn and reverse there")
    vehicle, frame = (tracks[name].to_numpy().astype(np.int64) for name in ("vehicle_id", "frame"))
    starts = find_run_starts(vehicle)
    entries = np.diff(starts, append=len(vehicle))
    steps = np.diff(frame, prepend=0)
    steps[starts] = 1
    gaps = np.add.reduceat((steps > 1).astype(np.int64), starts) if starts.size else entries
    alone = entries == 1
    gappy = ~alone & (2 * gaps > entries - 1)
    flawed = np.repeat(alone, entries), np.repeat(gappy, entries)
    drop("one_entry", flawed[0], "everything: one position has no motion")
    drop("constant_gaps", flawed[1][~flawed[0]], "everything: most frames of the track are missing")
    first, last = _bound_pieces(tracks, rate_hz, max_gap_s)
    short = last - first + 1 < LEAST_ENTRIES
    left_out = f"everything: fewer than {LEAST_ENTRIES} entries without a gap of more than {max_gap_s:g} s"
    drop("too_few_entries", np.repeat(short, last - first + 1), left_out)
    return _fill_gaps(tracks, *_bound_pieces(tracks, rate_hz, max_gap_s), rate_hz), skips


def _bound_pieces(tracks: pl.DataFrame, rate_hz: float, max_gap_s: float) -> tuple[Integers, Integers]:
    """Return the first and the last row of each piece of sorted tracks."""
    vehicle, frame = (tracks[name].to_numpy().astype(np.int64) for name in ("vehicle_id", "frame"))
    begins = np.ones(len(vehicle), bool)
    begins[1:] = (np.diff(vehicle) != 0) | (np.diff(frame) > round(max_gap_s * rate_hz))
    first = np.flatnonzero(begins)
    return first, np.append(first[1:], len(vehicle))[: len(first)] - 1


def _fill_gaps(tracks: pl.DataFrame, first: Integers, last: Integers, rate_hz: float) -> Pieces:
    """Lay the rows of each piece out on consecutive frames."""
    frames = tracks["frame"].to_numpy().astype(np.int64)
    size = frames[last] - frames[first] + 1
    frame, _ = expand_ranges(frames[first], size)
    begins = np.cumsum(size) - size
    point = np.repeat(begins - frames[first], last - first + 1) + frames
    recorded = np.zeros(len(frame), bool)
    recorded[point] = True
    return Pieces(tracks, begins, size, np.cumsum(recorded) - 1, frame, recorded, rate_hz)
