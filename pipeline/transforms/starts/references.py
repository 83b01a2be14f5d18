"""Fully tracked vehicles: frame, speed and lane at which each crossed a position."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats, Integers, find_run_starts


@dataclass(frozen=True)
class References:
    """The (N,) entries of R fully tracked vehicles, one vehicle after the other; a row is an index of an entry.

    `first` and `last` are rows of the vehicles.

    Args:
        farthest_m: (N,) running maximum of x_m within a track.
        lane: (N,) lane; NaN = unknown.
        left_cutoff: (R,) frame of the first crossing of the cut-off; NaN if it is never reached.
    """

    vehicle_id: Integers
    frame: Integers
    x_m: Floats
    farthest_m: Floats
    speed_mps: Floats
    lane: Floats
    first: Integers
    last: Integers
    left_cutoff: Floats

    @classmethod
    def from_tracks(cls, tracks: pl.DataFrame, vehicle_starts: pl.DataFrame, cutoff_m: float) -> "References":
        """Select the fully tracked vehicles among tracks sorted by vehicle_id, frame (with x_m, lane, speed_mps)."""
        wanted = vehicle_starts.filter("fully_tracked").select("vehicle_id")
        entries = tracks.join(wanted, on="vehicle_id", how="semi", maintain_order="left").with_columns(
            farthest_m=pl.col("x_m").cum_max().over("vehicle_id")
        )
        vehicle_id = entries["vehicle_id"].cast(pl.Int64).to_numpy()
        first = find_run_starts(vehicle_id)
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
        after = references.find_row(begin, end, cutoff_m)
        references.left_cutoff[reach] = references.find_crossings(begin, after, cutoff_m)[0]
        return references

    def find_reaching(self, x_m: float) -> Integers:
        """Find the vehicles (0 to R - 1) that reach x_m."""
        return np.flatnonzero(self.farthest_m[self.last] >= x_m)

    def measure_drives(self, x_m: float) -> tuple[Floats, Floats]:
        """Measure the frames from the cut-off to x_m (beyond it) and the speeds there, of vehicles that reach it."""
        reach = self.find_reaching(x_m)
        begin = self.first[reach]
        arrived, nearer = self.find_crossings(begin, self.find_row(begin, self.last[reach], x_m), x_m)
        return arrived - self.left_cutoff[reach], self.speed_mps[nearer]

    def find_row(self, low: Integers, high: Integers, x_m: float | Floats) -> Integers:
        """Find the first row of low ... high (of one track each) at or past x_m; high if there is none.

        The three arguments are broadcast.
        """
        low, high, _ = np.broadcast_arrays(low, high, x_m)
        while (low < high).any():  # binary search in all tracks at once
            middle = (low + high) // 2
            reached = self.farthest_m[middle] >= x_m
            low, high = np.where(reached, low, np.minimum(middle + 1, high)), np.where(reached, middle, high)
        return low

    def find_crossings(self, first: Integers, after: Integers, x_m: float | Floats) -> tuple[Floats, Integers]:
        """Find first crossings of x_m: the interpolated frame and the row of the nearer entry (the earlier of equals).

        `first` are first rows of the tracks, `after` first rows at or past x_m, from `find_row`; x_m is broadcast
        against both.
        """
        before = np.maximum(after - 1, first)  # the same entry where a track starts on x_m exactly
        step_m = self.x_m[after] - self.x_m[before]
        short_m = x_m - self.x_m[before]
        share = np.divide(short_m, step_m, out=np.zeros_like(step_m), where=step_m > 0)
        frame = self.frame[before] + share * (self.frame[after] - self.frame[before])
        return frame, np.where(short_m <= self.x_m[after] - x_m, before, after)
