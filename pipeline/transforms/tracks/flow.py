"""Flow of a carriageway by Edie's generalised definition."""

from dataclasses import dataclass

import polars as pl

from tracklake.schemas.arrays import divide_sum, sum_exactly


def compute_flow(tracks: pl.DataFrame, *, lanes: int | None, rate_hz: float, seconds: float) -> float | None:
    """Compute vehicles per hour and lane: distance driven on the main lanes / (length * lanes * time) (Edie 1963).

    An entry drives its recorded speed for 1 / frame rate, as in the macro `flow_density`, whose lanes 1 to `lanes` have
    this mean over the whole recording.

    `tracks` have x_m, lane, speed_mps of one subset; `seconds` is the length of the recording. None where the lanes or
    the section's length are unknown.
    """
    if lanes is None:
        return None
    on_main_lane = pl.col("lane").is_between(1, lanes)
    length_m, is_known, speeds_mps = tracks.select(
        pl.col("x_m").max() - pl.col("x_m").min(),
        pl.col("lane").is_not_null().any(),
        pl.col("speed_mps").filter(on_main_lane).cast(pl.Float64).sum(),
    ).row(0)
    if not (length_m and is_known):
        return None
    return float(3600 * speeds_mps / rate_hz / (length_m * lanes * seconds))


@dataclass
class FlowTally:
    """What the flow of a subset needs to know of its slices; see `compute_flow`."""

    speeds: int = 0
    least_m: float = float("inf")
    most_m: float = float("-inf")
    has_lanes: bool = False

    def add(self, tracks: pl.DataFrame, lanes: int | None) -> None:
        """Add a slice: x_m, lane, speed_mps of its own entries."""
        if tracks.is_empty() or lanes is None:
            return
        on_main_lane = tracks.filter(pl.col("lane").is_between(1, lanes))
        least_m, most_m, is_known = tracks.select(
            least=pl.col("x_m").min(), most=pl.col("x_m").max(), known=pl.col("lane").is_not_null().any()
        ).row(0)
        self.speeds += sum_exactly(on_main_lane["speed_mps"].cast(pl.Float64).to_numpy())
        self.least_m, self.most_m = min(self.least_m, least_m), max(self.most_m, most_m)
        self.has_lanes |= is_known

    def compute(self, *, lanes: int | None, rate_hz: float, seconds: float) -> float | None:
        """Compute vehicles per hour and lane."""
        length_m = self.most_m - self.least_m
        if lanes is None or not (self.has_lanes and length_m > 0):
            return None
        return 3600 * divide_sum(self.speeds, 1) / rate_hz / (length_m * lanes * seconds)
