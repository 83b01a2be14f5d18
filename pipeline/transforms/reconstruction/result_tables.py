"""Tables of a reconstruction: entries, how far they moved, what could not be kept, and what was left out."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.number_store import NumberStore, find_middle
from tracklake.pipeline.transforms.reconstruction.bounds import Runs
from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.noise import Noise
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces, Skip
from tracklake.pipeline.transforms.reconstruction.shares import AllPieces
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate
from tracklake.schemas.arrays import Flags, Floats
from tracklake.schemas.columns import Table
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

MOVED_M = 0.001
"""Least distance from the smoothed position, in m, at which an entry counts as moved by the bounds."""


@dataclass(frozen=True)
class Axis:
    """One coordinate at every point of some pieces, (N,) each: as recorded, smoothed, and within the bounds."""

    recorded: Floats
    smoothed: Floats
    x: Floats

    @property
    def moved(self) -> Flags:
        """Whether bounds moved the point, (N,)."""
        return np.asarray(np.abs(self.x - self.smoothed) > MOVED_M, np.bool_)


def list_entries(pieces: Pieces, series: Series, along: Axis, across: Axis, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write the points as rows of `reconstructed`."""
    if not pieces.points:
        return RECONSTRUCTED.empty()
    speed, accel = differentiate(series, along.x)
    lateral_speed, _ = differentiate(series, across.x)
    moved_m = np.hypot(along.x - along.recorded, across.x - across.recorded)
    frame = pl.DataFrame(
        {
            "vehicle_id": pieces.tracks["vehicle_id"].to_numpy()[pieces.row],
            "frame": pieces.frame,
            "time_s": pieces.interpolate("time_s"),
            "x_m": along.x,
            "y_m": across.x,
            "speed_mps": speed,
            "accel_mps2": accel,
            "lateral_speed_mps": lateral_speed,
            "moved_m": pl.Series(np.where(pieces.recorded, moved_m, np.nan)).fill_nan(None),
            "imputed": ~pieces.recorded,
            "constrained": along.moved | across.moved,
        }
    )
    return _conform(RECONSTRUCTED, frame, facts)


@dataclass
class Tally:
    """What the quality of a subset is computed from, added up over its entries.

    Args:
        moved_m: how far recorded entries moved.
    """

    moved_m: NumberStore
    counts: dict[str, int] = field(default_factory=dict)

    def add(self, entries: pl.DataFrame) -> None:
        """Count the entries of some vehicles."""
        moved = entries["moved_m"].drop_nulls()
        self.moved_m.append(moved.to_numpy())
        own = {
            "vehicles_reconstructed": entries["vehicle_id"].n_unique(),
            "entries": len(moved),
            "imputed_entries": int(entries["imputed"].sum()),
            "constrained_entries": int(entries["constrained"].sum()),
            "over_half_m": int((moved > 0.5).sum()),
            "over_2_m": int((moved > 2.0).sum()),
        }
        self.counts = {name: self.counts.get(name, 0) + count for name, count in own.items()}


def summarise(
    tally: Tally,
    vehicles: int,
    noise: Mapping[str, Noise],
    unkept: int,
    facts: Mapping[str, Any],
    config: ReconstructionConfig,
    at_once: int,
) -> pl.DataFrame:
    """Write the row of `reconstruction_quality`.

    Args:
        tally: figures of the entries.
        vehicles: number of vehicles of the subset.
        noise: noise by coordinate; empty where nothing was done.
        unkept: number of runs that break a bound.
        facts: the subset's row of `subsets`.
        config: settings.
        at_once: number of entries that are held in memory.
    """
    over_half_m, over_2_m = tally.counts.pop("over_half_m"), tally.counts.pop("over_2_m")
    along, across, moved = noise.get("x_m"), noise.get("y_m"), tally.counts["entries"]
    middle = find_middle(tally.moved_m, at_once) if moved else np.empty(0)
    frame = pl.DataFrame(
        {
            "vehicles": [vehicles],
            **{name: [count] for name, count in tally.counts.items()},
            "noise_x_m": [along and along.noise_m],
            "noise_y_m": [across and across.noise_m],
            "noise_is_set": [config.noise_x_m is not None or config.noise_y_m is not None],
            "weight_x_s6": [along and along.weight_s6],
            "weight_y_s6": [across and across.weight_s6],
            "median_moved_m": [pl.Series(middle, dtype=pl.Float32).median()],
            "moved_over_half_m_share": [over_half_m / moved if moved else None],
            "moved_over_2_m_share": [over_2_m / moved if moved else None],
            "bounds_not_kept": [unkept],
        }
    )
    return _conform(RECONSTRUCTION_QUALITY, frame, facts)


def list_unkept(pieces: AllPieces, runs: Runs, first_point: int = 0) -> pl.DataFrame:
    """Write runs that break a bound as rows of `unkept_bounds`, their points numbered from `first_point`."""
    first, last = runs.first + first_point, runs.last + first_point
    return pl.DataFrame(
        {
            "vehicle_id": pieces.vehicle_id[pieces.find_pieces(first)],
            "bound": pl.Series([runs.bound] * len(first), dtype=pl.String),
            "first_frame": pieces.find_frames(first),
            "last_frame": pieces.find_frames(last),
            "entries": last - first + 1,
            "worst": runs.worst,
        }
    )


def join_unkept(frames: list[pl.DataFrame], facts: Mapping[str, Any]) -> pl.DataFrame:
    """Join rows of `unkept_bounds`."""
    return _conform(UNKEPT_BOUNDS, pl.concat(frames), facts) if frames else UNKEPT_BOUNDS.empty()


def list_skips(skips: list[Skip], facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write what was left out as rows of `reconstruction_skips`."""
    names = ("reason", "vehicles", "entries", "left_out")
    frame = pl.DataFrame([{name: getattr(skip, name) for name in names} for skip in skips])
    return _conform(RECONSTRUCTION_SKIPS, frame, facts) if skips else RECONSTRUCTION_SKIPS.empty()


def _conform(table: Table, frame: pl.DataFrame, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Add the subset's place and put a frame into its table's columns and order."""
    place = [pl.lit(facts[name]).alias(name) for name in ("dataset", "subset")]
    return table.conform(frame.with_columns(place).lazy()).sort(table.key).collect()
