"""One subset prepared for convolutional social pooling's files: rows, labels, parts and samples."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import CspEntries, assign_recorded_ids, assign_run_ids, to_csp_entries
from tracklake.pipeline.transforms.csp.grid import OverwritingGrid, ResolvedGrid
from tracklake.pipeline.transforms.csp.labels import Codes, code_maneuvers
from tracklake.pipeline.transforms.csp.parts import (
    EARLY,
    ID_ZERO,
    IN_TWO_PARTS,
    NO_PART,
    OUTSIDE_SPLIT,
    SAME_ID,
    WOULD_BE,
    Parts,
    assign_parts_by_id,
    assign_parts_by_split,
    find_drops,
    keep_samples,
)
from tracklake.pipeline.transforms.resample import find_stride, put_on_clock
from tracklake.pipeline.transforms.starts.late_starts import find_would_be_neighbors
from tracklake.schemas.arrays import Flags, Integers, Singles
from tracklake.schemas.samples import CELLS

RATE_HZ = 10
"""Rate of the script's clock, in Hz."""
COLUMNS = 8 + CELLS
"""Columns of `traj`: data set, vehicle, frame, x, y, lane, lateral and longitudinal code, the 39 cells."""
BLOCK_ROWS = 1 << 16
"""Samples assembled at once."""


@dataclass(frozen=True)
class CspRecording:
    """The facts about a subset beside its tracks.

    Args:
        last_lane: highest lane; higher ones count as this one. None = no limit.
        by_frame: whether the source's rows are sorted by frame and vehicle, not by vehicle and frame.
    """

    dataset_id: int
    first_frame: int
    frame_rate_hz: float
    last_lane: int | None
    by_frame: bool = False


@dataclass(frozen=True)
class CleanContext:
    """A subset's rows of `splits`, `vehicle_starts` (vehicle_id, early) and `missing_starts`, for `--clean`."""

    blocks: pl.DataFrame
    vehicle_starts: pl.DataFrame
    missing_starts: pl.DataFrame


@dataclass(frozen=True)
class CspSubset:
    """A subset ready to be written.

    Args:
        dropped: number of entries of each part that are no samples, by reason.
        left_out: number of entries that are in no file, by reason.
        positions: track_id, tick, x_m, lane of the entries if collisions are resolved, else None.
        by_frame: whether samples are in the order of frame and vehicle, as the script finds them in such a file.
    """

    dataset_id: int
    entries: CspEntries
    lateral: Codes
    longitudinal: Codes
    part: Parts
    kept: Flags
    dropped: dict[str, list[int]]
    left_out: dict[str, int]
    positions: pl.DataFrame | None = None
    by_frame: bool = False

    def open_grid(self) -> OverwritingGrid | ResolvedGrid:
        """Build the grid around the samples; it is large, so only when it is needed."""
        if self.positions is None:
            return OverwritingGrid(self.entries)
        return ResolvedGrid(self.positions, self.kept, self.part)

    def find_samples(self, part: int) -> Integers:
        """Return the rows of a part's samples, in the order of the source's rows."""
        rows = np.flatnonzero(self.kept & (self.part == part))
        return rows[np.argsort(self.entries.frame[rows], kind="stable")] if self.by_frame else rows

    def assemble_samples(self, rows: Integers, grid: OverwritingGrid | ResolvedGrid) -> Iterator[Singles]:
        """Yield the samples of some rows as blocks (47, B) of columns of `traj`."""
        entries = self.entries
        columns: list[NDArray[Any]] = [entries.track_id, entries.frame, entries.x_ft, entries.y_ft, entries.lane]
        columns += [self.lateral, self.longitudinal]
        for start in range(0, rows.size, BLOCK_ROWS):
            chunk = rows[start : start + BLOCK_ROWS]
            block = np.empty((COLUMNS, chunk.size), np.float32)
            block[0] = self.dataset_id
            for row, column in enumerate(columns, start=1):
                block[row] = column[chunk]
            block[COLUMNS - CELLS :] = grid.fill_grids(chunk).T
            yield block


def put_on_csp_clock(tracks: pl.DataFrame, recorded: CspRecording) -> pl.DataFrame:
    """Put tracks on the script's 10 Hz clock.

    A 10 Hz source keeps its entries and frame numbers. Any other is interpolated (`put_on_clock`), and its frames are
    ticks counted from 1.

    The tracks have vehicle_id, frame, x_m, y_m, lane of one subset and are sorted by the first two.
    """
    clock = put_on_clock(
        tracks, first_frame=recorded.first_frame, frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ
    )
    native = find_stride(frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ) == 1
    return clock if native else clock.with_columns(frame=pl.col("tick") + 1)


def prepare_original_subset(
    clock: pl.DataFrame, vehicles: pl.DataFrame, recorded: CspRecording, *, full_future: bool = False
) -> CspSubset:
    """Prepare a subset on its `put_on_csp_clock` (lane without nulls) as the script does.

    `vehicles` have vehicle_id, source_vehicle_id; with `full_future` a sample needs 50 rows after it.
    """
    named, shared = assign_recorded_ids(clock, vehicles)
    named, zeros = _drop_id_zero(named)
    entries = to_csp_entries(named, last_lane=recorded.last_lane)
    part = assign_parts_by_id(entries.track_id)
    kept, dropped = keep_samples(part, find_drops(entries, full_future=full_future))
    left_out = _drop_zero_counts({SAME_ID: shared, ID_ZERO: zeros})
    return CspSubset(
        recorded.dataset_id, entries, *code_maneuvers(entries), part, kept, dropped, left_out, None, recorded.by_frame
    )


def prepare_clean_subset(
    clock: pl.DataFrame, context: CleanContext, recorded: CspRecording, *, full_future: bool = False
) -> CspSubset:
    """Prepare a subset without late starts, gaps, overwritten neighbors and leaks, with the script's arithmetic.

    On its `put_on_csp_clock` (lane without nulls); with `full_future` a sample needs 50 rows after it.
    """
    stride = find_stride(frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ)
    clock, zeros = _drop_id_zero(clock.with_columns(track_id="vehicle_id"))
    part, block, intended = assign_parts_by_split(
        clock, context.blocks, first_frame=recorded.first_frame, stride=float(stride)
    )
    left_out = {
        ID_ZERO: zeros,
        OUTSIDE_SPLIT: int((intended == NO_PART).sum()),
        IN_TWO_PARTS: int(((intended != NO_PART) & (part == NO_PART)).sum()),
    }
    within = part != NO_PART
    highest_id = int(clock["vehicle_id"].to_numpy().max(initial=0))
    named = assign_run_ids(clock.with_columns(part=part).filter(within), block[within], highest_id=highest_id)
    entries = to_csp_entries(named, last_lane=recorded.last_lane)
    part = named["part"].to_numpy()
    early = context.vehicle_starts.filter("early")["vehicle_id"].implode()
    drops = find_drops(entries, full_future=full_future) | {
        EARLY: named["vehicle_id"].is_in(early).to_numpy(),
        WOULD_BE: find_would_be_neighbors(
            named,
            context.missing_starts,
            first_frame=recorded.first_frame,
            frame_rate_hz=recorded.frame_rate_hz,
            rate_hz=RATE_HZ,
        ),
    }
    kept, dropped = keep_samples(part, drops)
    positions = named.select(
        "tick", "x_m", track_id=pl.Series(entries.track_id), lane=pl.Series(entries.lane).cast(pl.Int16)
    )
    left_out = _drop_zero_counts(left_out)
    return CspSubset(recorded.dataset_id, entries, *code_maneuvers(entries), part, kept, dropped, left_out, positions)


def stack_tracks(subset: CspSubset, part: int) -> tuple[NDArray[np.int32], Integers, Singles]:
    """Stack the tracks of a part: (V,) increasing ids, (V,) lengths, and (N, 3) frame, x, y, track after track."""
    rows = np.flatnonzero(subset.part == part)
    entries = subset.entries
    ids, lengths = np.unique(entries.track_id[rows], return_counts=True)
    values = np.stack((entries.frame[rows], entries.x_ft[rows], entries.y_ft[rows]), axis=1)
    return ids, lengths, values


def _drop_id_zero(clock: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Drop track 0 from the clock and count its rows."""
    zeros = int((clock["track_id"] == 0).sum())
    return (clock.filter(pl.col("track_id") != 0) if zeros else clock), zeros


def _drop_zero_counts(counts: dict[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in counts.items() if count}
