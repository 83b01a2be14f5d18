"""Fully tracked vehicles: when each crossed a position, and how fast and in which lane it was there."""

from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class References:
    """The fully tracked vehicles' entries, vehicle after vehicle, and when each vehicle first crossed the cut-off.

    A row is an index into the entries; R vehicles.
    """

    vehicle_id: Ints
    """(R,)"""
    frame: Ints
    x_m: Floats
    farthest_m: Floats
    """Running maximum of x_m within a track: it rises, and first reaches a position when the track does."""
    speed_mps: Floats
    lane: Floats
    """NaN where unknown."""
    first: Ints
    """(R,) each vehicle's first row."""
    last: Ints
    """(R,) its last row."""
    left_cutoff: Floats
    """(R,) frame of the first crossing of the cut-off; NaN where it is never reached."""

    @classmethod
    def gather(cls, tracks: pl.DataFrame, vehicle_starts: pl.DataFrame, cutoff_m: float) -> "References":
        """Pick the fully tracked vehicles out of the tracks.

        Args:
            tracks: vehicle_id, frame, x_m, lane, speed_mps of one subset, sorted by vehicle_id, frame.
            vehicle_starts: vehicle_id, fully_tracked.
            cutoff_m: where their tracks should begin.
        """
        wanted = vehicle_starts.filter("fully_tracked").select("vehicle_id")
        entries = tracks.join(wanted, on="vehicle_id", how="semi", maintain_order="left").with_columns(
            farthest_m=pl.col("x_m").cum_max().over("vehicle_id")
        )
        vehicle_id = entries["vehicle_id"].cast(pl.Int64).to_numpy()
        first = np.flatnonzero(np.diff(vehicle_id, prepend=vehicle_id[:1] - 1))
        references = cls(
            vehicle_id=vehicle_id[first],
            frame=entries["frame"].cast(pl.Int64).to_numpy(),
            x_m=entries["x_m"].to_numpy(),
            farthest_m=entries["farthest_m"].to_numpy(),
            speed_mps=entries["speed_mps"].cast(pl.Float64).to_numpy(),
            lane=entries["lane"].cast(pl.Float64).fill_null(float("nan")).to_numpy(),
            first=first,
            last=np.append(first, vehicle_id.size)[1:] - 1,
            left_cutoff=np.full(first.size, np.nan),
        )
        reach = references.find_reaching(cutoff_m)
        begin, end = references.first[reach], references.last[reach]
        references.left_cutoff[reach] = references.cross(begin, references.find_row(begin, end, cutoff_m), cutoff_m)[0]
        return references

    def find_reaching(self, x_m: float) -> Ints:
        """The vehicles (0 to R - 1) that come as far as x_m."""
        return np.flatnonzero(self.farthest_m[self.last] >= x_m)

    def drive_to(self, x_m: float) -> tuple[Floats, Floats]:
        """Frames from the cut-off to x_m and speeds there, of those vehicles that reach it (x_m beyond the cut-off)."""
        reach = self.find_reaching(x_m)
        begin = self.first[reach]
        arrived, nearer = self.cross(begin, self.find_row(begin, self.last[reach], x_m), x_m)
        return arrived - self.left_cutoff[reach], self.speed_mps[nearer]

    def find_row(self, low: Ints, high: Ints, x_m: float | Floats) -> Ints:
        """The first row of low ... high (of one track each) at or past x_m; high where there is none.

        The three are broadcast.
        """
        low, high, _ = np.broadcast_arrays(low, high, x_m)
        while (low < high).any():  # binary search in all tracks at once: as many rounds as the longest one needs
            middle = (low + high) // 2
            there = self.farthest_m[middle] >= x_m
            low, high = np.where(there, low, np.minimum(middle + 1, high)), np.where(there, middle, high)
        return low

    def cross(self, first: Ints, after: Ints, x_m: float | Floats) -> tuple[Floats, Ints]:
        """First crossings of x_m: frame (between entries: linear) and row of the nearer entry (the earlier of equals).

        Args:
            first: first rows of the tracks.
            after: their first rows at or past x_m, from `find_row`.
            x_m: broadcast against both.
        """
        before = np.maximum(after - 1, first)  # the same entry where a track starts on x_m exactly
        step_m = self.x_m[after] - self.x_m[before]
        short_m = x_m - self.x_m[before]
        share = np.divide(short_m, step_m, out=np.zeros_like(step_m), where=step_m > 0)
        frame = self.frame[before] + share * (self.frame[after] - self.frame[before])
        return frame, np.where(short_m <= self.x_m[after] - x_m, before, after)
