"""One subset as convolutional social pooling's files hold it: rows, labels, parts, and which rows are samples."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.csp.entries import (
    CspEntries,
    Ints,
    Singles,
    name_as_recorded,
    name_by_runs,
    to_csp_entries,
)
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
    find_drops,
    keep_samples,
    part_by_id,
    part_by_split,
)
from tracklake.pipeline.transforms.resample import find_stride, put_on_clock
from tracklake.pipeline.transforms.starts.late_starts import find_would_be_neighbors
from tracklake.schemas.samples import CELLS

RATE_HZ = 10
COLUMNS = 8 + CELLS
"""Of `traj`: data set, vehicle, frame, x, y, lane, lateral and longitudinal code, the 39 cells."""
BLOCK_ROWS = 1 << 16
"""Samples put together at a time."""


@dataclass(frozen=True)
class Recorded:
    """What there is to know of a subset beside its tracks.

    Args:
        dataset_id: its row of `tracks`, from 1.
        first_frame: the recording's first frame.
        frame_rate_hz: the source's.
        last_lane: lanes with higher numbers count as this one; None: all stay.
    """

    dataset_id: int
    first_frame: int
    frame_rate_hz: float
    last_lane: int | None


@dataclass(frozen=True)
class Context:
    """What `--clean` needs of a subset.

    Args:
        blocks: its rows of `splits`.
        vehicle_starts: vehicle_id, early.
        missing_starts: of late starts.
    """

    blocks: pl.DataFrame
    vehicle_starts: pl.DataFrame
    missing_starts: pl.DataFrame


@dataclass(frozen=True)
class CspSubset:
    """A subset ready to be written.

    Args:
        dataset_id: its row of `tracks`, from 1.
        entries: all that stand in `tracks`.
        lateral: (N,) code of each.
        longitudinal: (N,) code of each.
        part: (N,) of schemas.columns.PARTS.
        kept: (N,) which are samples.
        dropped: by reason, how many entries of each part are no samples.
        left_out: by reason, how many entries stand nowhere.
        positions: track_id, tick, x_m, lane of the entries where collisions are to be resolved, else None.
    """

    dataset_id: int
    entries: CspEntries
    lateral: Codes
    longitudinal: Codes
    part: Parts
    kept: NDArray[np.bool_]
    dropped: dict[str, list[int]]
    left_out: dict[str, int]
    positions: pl.DataFrame | None = None

    def open_grid(self) -> OverwritingGrid | ResolvedGrid:
        """The grid around the samples; made when it is needed, for it is large."""
        if self.positions is None:
            return OverwritingGrid(self.entries)
        return ResolvedGrid(self.positions, self.kept, self.part)

    def samples_of(self, part: int) -> Ints:
        """Rows of the samples of a part, in order."""
        return np.flatnonzero(self.kept & (self.part == part))

    def assemble(self, rows: Ints, grid: OverwritingGrid | ResolvedGrid) -> Iterator[Singles]:
        """Yield the samples of some rows as blocks (47, B) of columns of `traj`."""
        entries = self.entries
        columns: list[NDArray[Any]] = [entries.track_id, entries.frame, entries.x_ft, entries.y_ft, entries.lane]
        columns += [self.lateral, self.longitudinal]
        for start in range(0, rows.size, BLOCK_ROWS):
            some = rows[start : start + BLOCK_ROWS]
            block = np.empty((COLUMNS, some.size), np.float32)
            block[0] = self.dataset_id
            for place, column in enumerate(columns, start=1):
                block[place] = column[some]
            block[COLUMNS - CELLS :] = grid.fill(some).T
            yield block


def put_on_csp_clock(tracks: pl.DataFrame, recorded: Recorded) -> pl.DataFrame:
    """Put tracks on the script's 10 Hz clock.

    A 10 Hz source keeps its entries and frame numbers. Any other is interpolated (`put_on_clock`), and its frames are
    counted in ticks from 1.

    Args:
        tracks: vehicle_id, frame, x_m, y_m, lane of one subset, sorted by vehicle_id, frame.
        recorded: of the subset.
    """
    clock = put_on_clock(
        tracks, first_frame=recorded.first_frame, frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ
    )
    native = find_stride(frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ) == 1
    return clock if native else clock.with_columns(frame=pl.col("tick") + 1)


def prepare_as_original(
    clock: pl.DataFrame, vehicles: pl.DataFrame, recorded: Recorded, *, full_future: bool = False
) -> CspSubset:
    """Prepare a subset as the script does.

    Args:
        clock: from `put_on_csp_clock`, lane without nulls.
        vehicles: vehicle_id, source_vehicle_id.
        recorded: of the subset.
        full_future: whether a sample needs 50 rows after it.
    """
    named, shared = name_as_recorded(clock, vehicles)
    named, nameless = _without_id_zero(named)
    entries = to_csp_entries(named, last_lane=recorded.last_lane)
    part = part_by_id(entries.track_id)
    kept, dropped = keep_samples(part, find_drops(entries, full_future=full_future))
    left_out = {SAME_ID: shared, ID_ZERO: nameless}
    return CspSubset(recorded.dataset_id, entries, *code_maneuvers(entries), part, kept, dropped, _some(left_out), None)


def prepare_clean(clock: pl.DataFrame, context: Context, recorded: Recorded, *, full_future: bool = False) -> CspSubset:
    """Prepare a subset without late starts, gaps, overwritten neighbors and leaks; the arithmetic stays the script's.

    Args:
        clock: from `put_on_csp_clock`, lane without nulls.
        context: of the subset.
        recorded: of the subset.
        full_future: whether a sample needs 50 rows after it.
    """
    stride = find_stride(frame_rate_hz=recorded.frame_rate_hz, rate_hz=RATE_HZ)
    clock, nameless = _without_id_zero(clock.with_columns(track_id="vehicle_id"))
    part, block, intended = part_by_split(clock, context.blocks, first_frame=recorded.first_frame, stride=float(stride))
    left_out = {
        ID_ZERO: nameless,
        OUTSIDE_SPLIT: int((intended == NO_PART).sum()),
        IN_TWO_PARTS: int(((intended != NO_PART) & (part == NO_PART)).sum()),
    }
    within = part != NO_PART
    highest_id = int(clock["vehicle_id"].to_numpy().max(initial=0))
    named = name_by_runs(clock.with_columns(part=part).filter(within), block[within], highest_id=highest_id)
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
    return CspSubset(
        recorded.dataset_id, entries, *code_maneuvers(entries), part, kept, dropped, _some(left_out), positions
    )


def stack_tracks(subset: CspSubset, part: int) -> tuple[NDArray[np.int32], Ints, Singles]:
    """The tracks of a part, as `tracks` holds them.

    Returns:
        (V,) ids, increasing; (V,) rows of each; (N, 3) frame, x, y of all, one track after the other.
    """
    rows = np.flatnonzero(subset.part == part)
    entries = subset.entries
    ids, lengths = np.unique(entries.track_id[rows], return_counts=True)
    values = np.stack((entries.frame[rows], entries.x_ft[rows], entries.y_ft[rows]), axis=1)
    return ids, lengths, values


def _without_id_zero(clock: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """The clock without track 0, and how many rows that had."""
    nameless = int((clock["track_id"] == 0).sum())
    return (clock.filter(pl.col("track_id") != 0) if nameless else clock), nameless


def _some(counts: dict[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in counts.items() if count}
