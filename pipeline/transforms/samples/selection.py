"""Selection of samples: the entries on a protocol's clock that can be prediction origins."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.resample import cut_runs, find_stride, join_key, put_on_clock
from tracklake.pipeline.transforms.samples.maneuvers import label_maneuvers
from tracklake.pipeline.transforms.samples.nearest import find_nearest
from tracklake.pipeline.transforms.samples.neighbors import Neighborhood, count_collisions, find_neighbors
from tracklake.pipeline.transforms.samples.threads import map_in_threads
from tracklake.pipeline.transforms.slices import Slice
from tracklake.pipeline.transforms.starts.late_starts import find_would_be_neighbors
from tracklake.schemas.arrays import Flags, bound_runs
from tracklake.schemas.columns import Table
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLE_COUNTS, SAMPLE_DROPS, SAMPLES

DROP_REASONS = {
    "excluded_subset": "validation excludes the subset",
    "no_lane": "some entry has no lane, so maneuvers and neighbors are unknown in the whole subset",
    "short_history": "fewer than `protocol.history_ticks` positions without a gap up to and with the entry",
    "short_future": "fewer than `protocol.min_future_ticks` positions without a gap after it",
    "early_vehicle": "the road ahead was not yet recorded when the vehicle entered",
    "would_be_neighbor": "a vehicle whose track starts late is missing near the entry",
    "error_finding": "the vehicle breaks a rule of severity error in the history or horizon (only in some protocols)",
}
"""Reasons why an entry is no sample, in the order in which they are tested; the first that applies counts."""

TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane")
"""Columns of tracks that `draw_samples` reads."""
SAMPLE_COLUMNS = ("vehicle_id", "tick", "frame", "lane", "lateral_maneuver", "longitudinal_maneuver")

NO_NEIGHBORS = Neighborhood(NEIGHBORS.empty(), collisions=0, crowded_out=0)

PUBLISHED_HZ = 10
"""Rate of the entries over which published collisions in the grid are counted, in Hz."""
PIECE_ROWS = 1 << 16
"""Entries tested and labelled at once; their arrays stay in the processor's cache."""


def draw_samples(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    missing_starts: pl.DataFrame,
    findings: pl.DataFrame,
    *,
    protocol: Protocol,
    dataset: str,
    subset: str,
    first_frame: int,
    frame_rate_hz: float,
    excluded: bool,
    last_lane: int | None = None,
    part: Slice | None = None,
    has_lanes: bool | None = None,
) -> dict[Table, pl.DataFrame]:
    """Keep or drop every entry on the protocol's clock, label the samples and find their neighbors (DESIGN section 7).

    `tracks` have TRACK_COLUMNS, sorted by vehicle_id, frame; `vehicle_starts` vehicle_id, early; `findings` vehicle_id,
    severity, first_frame, last_frame, in any order. The protocol's clock, on which `first_frame` is tick 0, may not be
    faster than the source. For maneuvers and neighbors, lanes above `last_lane` count as it. With `part`, the tracks
    are a slice's with its context, samples and counts those of the ticks in its own frames, and `has_lanes` says
    whether all entries of the subset have a lane.
    """
    rates: dict[str, Any] = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz, "rate_hz": protocol.rate_hz}
    clock = put_on_clock(tracks.select(TRACK_COLUMNS), **rates)
    names = {"protocol": protocol.name, "dataset": dataset, "subset": subset}
    kept = find_own_ticks(clock, part, **rates)
    entries = int(kept.sum())
    if has_lanes is None:
        has_lanes = not tracks["lane"].null_count()
    whole_subset = "excluded_subset" if excluded else None if has_lanes else "no_lane"
    lane = pl.col("lane") if last_lane is None else pl.col("lane").clip(upper_bound=last_lane)
    all_collisions = None
    if has_lanes and frame_rate_hz >= PUBLISHED_HZ:
        all_collisions = _count_all_collisions(tracks.with_columns(lane), first_frame, frame_rate_hz, part)
    if whole_subset or clock.is_empty():
        drops = {whole_subset: entries} if whole_subset else {}
        return _build_tables(entries, SAMPLES.empty(), drops, NO_NEIGHBORS, all_collisions, names)

    early_ids = vehicle_starts.filter("early")["vehicle_id"].implode()
    would_be = find_would_be_neighbors(clock, missing_starts, **rates)
    clock = clock.with_columns(lane)

    def find_reasons(piece: pl.DataFrame, rows: slice) -> dict[str, Flags]:
        applies = _find_short(piece, protocol) | {
            "early_vehicle": piece["vehicle_id"].is_in(early_ids).to_numpy(),
            "would_be_neighbor": would_be[rows],
        }
        if protocol.drop_error_findings:
            applies["error_finding"] = find_error_entries(piece, findings, protocol=protocol, **rates)
        return applies

    samples, drops = _label_and_drop(clock, kept, find_reasons, protocol.rate_hz)
    nearest = find_nearest(clock, protocol.nearest, kept) if protocol.nearest else pl.lit(None)
    samples = samples.with_columns(nearest.alias("nearest"))
    clock = clock.select("vehicle_id", "tick", "x_m", "lane")  # frees memory for the neighbors
    neighbors = find_neighbors(clock, kept, cell_m=protocol.grid_cell_m)
    return _build_tables(entries, samples, drops, neighbors, all_collisions, names)


def _label_and_drop(
    clock: pl.DataFrame,
    kept: Flags,
    find_reasons: Callable[[pl.DataFrame, slice], dict[str, Flags]],
    rate_hz: int,
) -> tuple[pl.DataFrame, dict[str, int]]:
    """Label the entries, and clear the flags in `kept` of those that a reason drops; returns samples, and counts."""

    def filter_piece(bounds: tuple[int, int]) -> tuple[pl.DataFrame, dict[str, int]]:
        rows = slice(*bounds)
        piece = clock[rows]
        drops = _drop_entries(kept[rows], find_reasons(piece, rows))
        labels = label_maneuvers(piece, rate_hz=rate_hz)
        return piece.hstack(labels).select(SAMPLE_COLUMNS).filter(kept[rows]), drops

    pieces = map_in_threads(filter_piece, cut_runs(clock["segment"].to_numpy(), PIECE_ROWS))
    drops = {reason: sum(dropped.get(reason, 0) for _, dropped in pieces) for reason in DROP_REASONS}
    return pl.concat(piece for piece, _ in pieces), drops


def find_own_ticks(
    clock: pl.DataFrame, part: Slice | None, *, first_frame: int, frame_rate_hz: float, rate_hz: int
) -> Flags:
    """Find (N,) flags of the entries on the clock whose tick lies in a slice's own frames; all without one.

    A tick between two frames belongs to the slice that owns the earlier one.
    """
    if part is None:
        return np.ones(clock.height, np.bool_)
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    frame = first_frame + clock["tick"].cast(pl.Int64).to_numpy() * stride.numerator // stride.denominator
    own: Flags = (frame >= part.first_frame) & (frame < part.end_frame)
    return own


def _count_all_collisions(tracks: pl.DataFrame, first_frame: int, frame_rate_hz: float, part: Slice | None) -> int:
    """Count the collisions in the grids of all entries at 10 Hz."""
    rates: dict[str, Any] = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz, "rate_hz": PUBLISHED_HZ}
    clock = put_on_clock(tracks.select("vehicle_id", "frame", "x_m", "lane"), **rates)
    return count_collisions(clock, None if part is None else find_own_ticks(clock, part, **rates))


def add_counts(tables: Sequence[Mapping[Table, pl.DataFrame]]) -> dict[Table, pl.DataFrame]:
    """Add up the counts of a subset's slices: its rows of SAMPLE_DROPS and its row of SAMPLE_COUNTS."""
    added = {}
    for table in (SAMPLE_DROPS, SAMPLE_COUNTS):
        rows = pl.concat([made[table] for made in tables])
        place = [name for name in rows.columns if rows.schema[name] == pl.String]
        # A sum of nothing would be 0, where it is not counted.
        sums = (
            pl.when(pl.col(name).count() > 0).then(pl.col(name).sum()) for name in rows.columns if name not in place
        )
        added[table] = table.conform(rows.lazy().group_by(place).agg(sums).sort(table.key)).collect()
    return added


def _find_short(piece: pl.DataFrame, protocol: Protocol) -> dict[str, Flags]:
    """Find the entries of whole segments whose history or future is too short."""
    row = np.arange(piece.height)
    first, last = bound_runs(piece["segment"].to_numpy())
    return {
        "short_history": row - first < protocol.history_ticks - 1,
        "short_future": last - row < protocol.min_future_ticks,
    }


def _drop_entries(kept: Flags, applies: Mapping[str, Flags]) -> dict[str, int]:
    """Clear the flags of entries to which a reason applies, in place, and count them by the first reason."""
    drops = {}
    for reason in DROP_REASONS:
        if reason in applies:
            drops[reason] = int((kept & applies[reason]).sum())
            kept &= ~applies[reason]
    return drops


def find_error_entries(
    clock: pl.DataFrame,
    findings: pl.DataFrame,
    *,
    protocol: Protocol,
    first_frame: int,
    frame_rate_hz: float,
    rate_hz: int,
) -> Flags:
    """Find (N,) flags of entries whose vehicle has a finding of severity error in their history or horizon.

    The finding's frames must overlap those of the history and horizon, first and last included; a tick between two
    frames covers both.

    The clock has vehicle_id, tick, and tick 0 at `first_frame`; findings have vehicle_id, severity, first_frame,
    last_frame.
    """
    errors = findings.filter(pl.col("severity") == "error")
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    tick = clock["tick"].to_numpy().astype(np.int64)
    begins = first_frame + (tick - (protocol.history_ticks - 1)) * stride.numerator // stride.denominator
    ends = first_frame - (-(tick + protocol.horizon_ticks) * stride.numerator // stride.denominator)
    # Overlapping findings of a vehicle are those that began in time minus those that ended before.
    own, vehicle_id = clock["vehicle_id"].to_numpy(), errors["vehicle_id"].to_numpy()
    begun = np.sort(join_key(vehicle_id, errors["first_frame"].to_numpy()))
    ended = np.sort(join_key(vehicle_id, errors["last_frame"].to_numpy()))
    overlaps = np.searchsorted(begun, join_key(own, ends), side="right") - np.searchsorted(ended, join_key(own, begins))
    has_error: Flags = overlaps > 0
    return has_error


def _build_tables(
    entries: int,
    samples: pl.DataFrame,
    drops: dict[str, int],
    found: Neighborhood,
    all_collisions: int | None,
    names: dict[str, str],
) -> dict[Table, pl.DataFrame]:
    """Build the tables of one subset; samples and drops add up to the entries on the clock."""
    constants = [pl.lit(value).alias(name) for name, value in names.items()]
    dropped = [{**names, "reason": reason, "entries": entries} for reason, entries in sorted(drops.items()) if entries]
    counts = {
        **names,
        "entries_on_clock": entries,
        "samples": samples.height,
        "neighbors": found.neighbors.height,
        "collisions": found.collisions,
        "all_collisions": all_collisions,
        "crowded_out": found.crowded_out,
    }
    return {
        SAMPLES: SAMPLES.conform(samples.lazy().with_columns(constants)).collect(),
        SAMPLE_DROPS: pl.DataFrame(dropped, schema=SAMPLE_DROPS.dtypes),
        SAMPLE_COUNTS: pl.DataFrame([counts], schema=SAMPLE_COUNTS.dtypes),
        NEIGHBORS: NEIGHBORS.conform(found.neighbors.lazy().with_columns(constants)).collect(),
    }
