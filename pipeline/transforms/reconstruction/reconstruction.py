"""Reconstruction of a subset: physically possible tracks near the recorded ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.pieces import Pieces, Skip, cut_pieces
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate, make_penalty, smooth_robustly
from tracklake.schemas.arrays import Flags, Floats
from tracklake.schemas.columns import Table
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

DEFAULT_CONFIG = ReconstructionConfig()


@dataclass(frozen=True)
class Reconstruction:
    """Tables about one subset; each conforms to its declaration and is sorted by its key.

    Args:
        entries: rows of `reconstructed`.
        quality: the row of `reconstruction_quality`.
        skips: rows of `reconstruction_skips`.
        unkept: rows of `unkept_bounds`.
    """

    entries: pl.DataFrame
    quality: pl.DataFrame
    skips: pl.DataFrame
    unkept: pl.DataFrame


@dataclass(frozen=True)
class Axis:
    """One coordinate at every point of the pieces, and how it was found.

    Args:
        noise_m: standard deviation of the recorded positions' noise.
        weight_s6: weight of the squared third derivative.
        moved: whether bounds moved the point.
    """

    recorded: Floats
    x: Floats
    noise_m: float | None
    weight_s6: float | None
    moved: Flags


def reconstruct(
    tracks: pl.DataFrame,
    vehicles: pl.DataFrame,
    facts: Mapping[str, Any],
    config: ReconstructionConfig = DEFAULT_CONFIG,
) -> Reconstruction:
    """Reconstruct all tracks of one subset.

    Args:
        tracks: vehicle_id, frame, time_s, x_m, y_m, lane, leader_id, in any order.
        vehicles: vehicle_id, class, length_m, width_m; all but the first may be null.
        facts: the subset's row of `subsets`.
        config: settings.
    """
    pieces, skips = cut_pieces(tracks, facts, config.max_gap_s)
    series = Series(pieces.first, pieces.size, pieces.rate_hz)
    along = _smooth_axis(pieces, series, "x_m", config.noise_x_m, config.weight_x_s6)
    across = _smooth_axis(pieces, series, "y_m", config.noise_y_m, config.weight_y_s6)
    entries = _list_entries(pieces, series, along, across, facts)
    return Reconstruction(
        entries,
        _summarise(entries, vehicles, along, across, facts, config),
        _list_skips(skips, facts),
        UNKEPT_BOUNDS.empty(),
    )


def _smooth_axis(pieces: Pieces, series: Series, column: str, noise_m: float | None, weight_s6: float | None) -> Axis:
    recorded = pieces.interpolate(column)
    moved = np.zeros(pieces.points, bool)
    if not pieces.points:
        return Axis(recorded, recorded, noise_m, weight_s6, moved)
    weight_s6 = 0.01 if weight_s6 is None else weight_s6
    noise_m = 0.1 if noise_m is None else noise_m
    x, _ = smooth_robustly(make_penalty(series, weight_s6), recorded, pieces.recorded.astype(np.float64), noise_m)
    return Axis(recorded, x, noise_m, weight_s6, moved)


def _list_entries(pieces: Pieces, series: Series, along: Axis, across: Axis, facts: Mapping[str, Any]) -> pl.DataFrame:
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


def _summarise(
    entries: pl.DataFrame,
    vehicles: pl.DataFrame,
    along: Axis,
    across: Axis,
    facts: Mapping[str, Any],
    config: ReconstructionConfig,
) -> pl.DataFrame:
    """Write the row of `reconstruction_quality`."""
    moved = entries["moved_m"].drop_nulls()
    frame = pl.DataFrame(
        {
            "vehicles": [vehicles.height],
            "vehicles_reconstructed": [entries["vehicle_id"].n_unique()],
            "entries": [len(moved)],
            "imputed_entries": [entries["imputed"].sum()],
            "constrained_entries": [entries["constrained"].sum()],
            "noise_x_m": [along.noise_m],
            "noise_y_m": [across.noise_m],
            "noise_is_set": [config.noise_x_m is not None or config.noise_y_m is not None],
            "weight_x_s6": [along.weight_s6],
            "weight_y_s6": [across.weight_s6],
            "median_moved_m": [moved.median()],
            "moved_over_half_m_share": [(moved > 0.5).mean()],
            "moved_over_2_m_share": [(moved > 2.0).mean()],
            "bounds_not_kept": [0],
        }
    )
    return _conform(RECONSTRUCTION_QUALITY, frame, facts)


def _list_skips(skips: list[Skip], facts: Mapping[str, Any]) -> pl.DataFrame:
    """Write what was left out as rows of `reconstruction_skips`."""
    names = ("reason", "vehicles", "entries", "left_out")
    frame = pl.DataFrame([{name: getattr(skip, name) for name in names} for skip in skips])
    return _conform(RECONSTRUCTION_SKIPS, frame, facts) if skips else RECONSTRUCTION_SKIPS.empty()


def _conform(table: Table, frame: pl.DataFrame, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Add the subset's place and put a frame into its table's columns and order."""
    place = [pl.lit(facts[name]).alias(name) for name in ("dataset", "subset")]
    return table.conform(frame.with_columns(place).lazy()).sort(table.key).collect()
