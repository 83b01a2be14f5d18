"""Training tensors of one split: flat arrays on the protocol's clock, and an index of samples and their neighbors.

The input tables name vehicles and ticks; the arrays name rows, so that a batch is read by indexing alone. Every history
and future is a run of consecutive rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.resample import find_blocks, join_key
from tracklake.pipeline.transforms.tensors.positions import store_positions
from tracklake.pipeline.transforms.tensors.scenes import find_scenes
from tracklake.pipeline.transforms.tensors.vehicle_facts import find_sizes, mark_findings
from tracklake.schemas.arrays import Bytes, Flags, Integers, find_run_starts
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, MOST_TICKS, POSITION_STORAGES, Array

Arrays = dict[str, np.ndarray]
"""Arrays by their names in `schemas.tensors.ARRAYS`, with its dtypes and shapes."""
MOST_ROWS = 2**31 - 1
"""Largest number of rows or samples, which are numbered by Int32."""


@dataclass(frozen=True)
class SubsetTensors:
    """The tensors of one subset; rows, samples and subsets are numbered from 0.

    Args:
        centre_m: origin of stored positions: along, across.
        max_error_m: largest rounding error of stored positions: along, across; 0 without rows.
        squared_error_m2: sums of the squared rounding errors: along, across.
        last_lane: highest lane of any entry; 0 if no lane is known.
        cut_samples: number of samples with a neighbor that is cut off, in the order of PARTS; train is not counted.
    """

    arrays: Arrays
    centre_m: tuple[float, float]
    max_error_m: tuple[float, float]
    squared_error_m2: tuple[float, float]
    last_lane: int
    cut_samples: tuple[int, ...]


@dataclass(frozen=True)
class _Runs:
    """Gap-free runs of rows, (R,) each, in row order: consecutive ticks of one vehicle.

    `key` is vehicle and first tick as one number, increasing.
    """

    first_row: Integers
    last_row: Integers
    key: Integers

    def find_rows(self, key: Integers) -> Integers:
        """Find the rows of (vehicle, tick) keys of any shape; -1 = none.

        Searches the runs, not the rows: they are hundreds of times fewer and stay in the processor's cache.
        """
        if len(self.key) == 0:
            return np.full(key.shape, -1, dtype=np.int64)
        run = np.searchsorted(self.key, key, side="right") - 1
        row = self.first_row[run] + (key - self.key[run])
        return np.where((run >= 0) & (row <= self.last_row[run]), row, -1)

    def bound_rows(self) -> tuple[Integers, Integers]:
        """Return the first and the last row of each row's run, (N,) each."""
        lengths = self.last_row - self.first_row + 1
        return np.repeat(self.first_row, lengths), np.repeat(self.last_row, lengths)


def build_subset_tensors(
    clock: pl.DataFrame,
    samples: pl.DataFrame,
    neighbors: pl.DataFrame,
    blocks: pl.DataFrame,
    *,
    vehicles: pl.DataFrame,
    findings: pl.DataFrame,
    first_frame: int,
    frame_rate_hz: float,
    protocol: Protocol,
    storage: str = POSITION_STORAGES[0],
    left_out: pl.Series | None = None,
    drop_cut: bool = False,
) -> SubsetTensors:
    """Build the arrays of one subset of the split.

    Only entries inside a block of the split are kept, and no history, future or pair of neighbors crosses a block's
    border: runs are cut there, and samples whose history or least future is cut and neighbors in another block are left
    out. A subset that is one block is not changed.

    `clock` has vehicle_id, tick, x_m, y_m, lane (null becomes 0), speed_mps, segment, sorted by the first two; samples
    have protocol, vehicle_id, tick and the maneuvers; neighbors protocol, vehicle_id, tick, cell, neighbor_id (rows of
    other protocols are skipped); vehicles vehicle_id, length_m, width_m; findings vehicle_id, severity, first_frame,
    last_frame. `blocks` are the split's rows of SPLITS for this subset. A tick between two frames is in a block only if
    both are. Entries of vehicles in `left_out` are in no part but train. With `drop_cut`, samples outside train with a
    neighbor in another block or in no part are left out, too.

    Raises:
        ValueError: blocks overlap; the clock is not sorted; samples or neighbors do not fit the clock (they were made
            from other tracks); `vehicles` lacks a vehicle; or positions do not fit their storage.

    Source: DESIGN section 9.
    """
    where = f"{blocks['dataset'][0]}/{blocks['subset'][0]}" if blocks.height else "a subset in no block"
    _check_order(clock, where)
    if max(protocol.history_ticks, protocol.horizon_ticks) > MOST_TICKS:
        raise ValueError(f"protocol {protocol.name}: tensors hold at most {MOST_TICKS} ticks of history and of future")
    rates: dict[str, Any] = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz, "rate_hz": protocol.rate_hz}
    kept = _keep_entries(clock, blocks, left_out, rates, where)
    x_m, y_m, speed_mps = (clock[name].to_numpy()[kept.is_kept] for name in ("x_m", "y_m", "speed_mps"))
    stored = store_positions(x_m, y_m, storage=storage, where=where)
    lane = clock["lane"].fill_null(0).to_numpy()[kept.is_kept]
    sample_arrays, cut_samples = _build_sample_arrays(kept, samples, neighbors, protocol, where, drop_cut=drop_cut)
    arrays = {
        "position_m": stored.steps,
        "speed_mps": speed_mps,
        "lane": lane,
        "finding": mark_findings(kept.vehicle_id, kept.tick, findings, **rates)[kept.is_kept],
        **_build_run_arrays(kept, vehicles, where),
        **sample_arrays,
    }
    arrays = {array.name: np.ascontiguousarray(arrays[array.name], dtype=array.stored_as(storage)) for array in ARRAYS}
    last_lane = int(lane.max(initial=0))
    return SubsetTensors(arrays, stored.centre_m, stored.max_error_m, stored.squared_error_m2, last_lane, cut_samples)


@dataclass(frozen=True)
class _KeptEntries:
    """The (N,) entries of the whole clock, and those that blocks of the split keep.

    Args:
        block: (N,) row of the split's blocks; -1 = none.
        is_kept: (N,) whether the entry is in a block.
        new_row: (N,) number of the row among the kept ones.
    """

    vehicle_id: Integers
    tick: Integers
    block: Integers
    is_kept: Flags
    new_row: npt.NDArray[np.int32]
    part_of_block: Bytes
    whole_runs: _Runs
    runs: _Runs


def _keep_entries(
    clock: pl.DataFrame, blocks: pl.DataFrame, left_out: pl.Series | None, rates: Mapping[str, Any], where: str
) -> _KeptEntries:
    """Assign the clock's entries to blocks and cut runs at their borders."""
    tick = clock["tick"].to_numpy().astype(np.int64)
    vehicle_id = clock["vehicle_id"].to_numpy().astype(np.int64)
    segment = clock["segment"].to_numpy()
    frame = rates["first_frame"] + tick * (rates["frame_rate_hz"] / rates["rate_hz"])
    block = find_blocks(frame, vehicle_id, blocks, where)
    part_of_block = _encode_names(blocks["part"], PARTS)
    if left_out is not None and len(left_out):
        block[np.isin(vehicle_id, left_out.to_numpy()) & (part_of_block[block] != PARTS.index("train"))] = -1
    is_kept = block >= 0
    return _KeptEntries(
        vehicle_id=vehicle_id,
        tick=tick,
        block=block,
        is_kept=is_kept,
        new_row=np.cumsum(is_kept, dtype=np.int32) - np.int32(1),
        part_of_block=part_of_block,
        whole_runs=_find_runs(vehicle_id, tick, segment),
        runs=_find_runs(vehicle_id, tick, segment, block),
    )


def _build_run_arrays(kept: _KeptEntries, vehicles: pl.DataFrame, where: str) -> dict[str, npt.NDArray[Any]]:
    first_row = kept.runs.first_row[kept.is_kept[kept.runs.first_row]]
    length_m, width_m = find_sizes(vehicles, kept.vehicle_id[first_row], where=where)
    return {
        "run_first_row": np.append(kept.new_row[first_row], kept.is_kept.sum()),
        "run_vehicle_id": kept.vehicle_id[first_row],
        "run_length_m": length_m,
        "run_width_m": width_m,
        "run_first_tick": kept.tick[first_row],
        "run_subset": np.zeros(first_row.size),
    }


def _build_sample_arrays(
    kept: _KeptEntries,
    samples: pl.DataFrame,
    neighbors: pl.DataFrame,
    protocol: Protocol,
    where: str,
    *,
    drop_cut: bool,
) -> tuple[dict[str, npt.NDArray[Any]], tuple[int, ...]]:
    """Build the arrays of samples, neighbors and scenes, and count the samples outside train that lost a neighbor.

    Rows are those of the whole clock until `new_row`.
    """
    samples = _sort_rows(samples.filter(pl.col("protocol") == protocol.name))
    neighbors = _sort_rows(neighbors.filter(pl.col("protocol") == protocol.name))
    origin = _find_origins(samples, kept.whole_runs, protocol, where)
    pair_sample, pair_row = _find_pairs(samples, neighbors, kept.whole_runs, where)
    first, last = kept.runs.bound_rows()
    usable = (
        kept.is_kept[origin]
        & (origin - first[origin] >= protocol.history_ticks - 1)
        & (last[origin] - origin >= protocol.min_future_ticks)
    )
    beside = kept.block[pair_row] == kept.block[origin[pair_sample]]
    part = kept.part_of_block[kept.block[origin]]
    cut = np.zeros(len(origin), dtype=np.bool_)
    cut[pair_sample[~beside]] = True
    cut &= usable & (part != PARTS.index("train"))
    if drop_cut:
        usable &= ~cut
    together = usable[pair_sample] & beside
    number = np.cumsum(usable) - 1
    pairs_of = np.bincount(number[pair_sample[together]], minlength=int(usable.sum()))
    pair_row, own = pair_row[together], origin[usable]
    sample_of_row = np.full(len(kept.tick), -1, dtype=np.int64)
    sample_of_row[own] = np.arange(len(own))
    scenes = find_scenes(kept.tick[kept.is_kept], kept.block[kept.is_kept], sample_of_row[kept.is_kept])
    arrays: dict[str, npt.NDArray[Any]] = {
        "sample_row": kept.new_row[own],
        "sample_part": kept.part_of_block[kept.block[own]],
        "sample_lateral": _encode_names(samples["lateral_maneuver"], LATERAL_MANEUVERS)[usable],
        "sample_longitudinal": _encode_names(samples["longitudinal_maneuver"], LONGITUDINAL_MANEUVERS)[usable],
        "sample_future": np.minimum(last[own] - own, protocol.horizon_ticks),
        "neighbor_offset": np.concatenate([[0], np.cumsum(pairs_of)]),
        "neighbor_row": kept.new_row[pair_row],
        "neighbor_cell": neighbors["cell"].to_numpy()[together],
        "neighbor_known": np.minimum(pair_row - first[pair_row] + 1, protocol.history_ticks),
        "scene_offset": scenes.offset,
        "scene_row": scenes.row,
        "scene_sample": scenes.sample,
        "scene_part": kept.part_of_block[scenes.block],
    }
    return arrays, tuple(np.bincount(part[cut], minlength=len(PARTS)).tolist())


def count_sizes(arrays: Arrays) -> dict[str, int]:
    """Count the sizes by letter; see `schemas.tensors.Array`."""
    return {
        "N": len(arrays["lane"]),
        "R": len(arrays["run_subset"]),
        "S": len(arrays["sample_row"]),
        "K": len(arrays["neighbor_row"]),
        "C": len(arrays["scene_part"]),
        "M": len(arrays["scene_row"]),
    }


def join_after(arrays: Arrays, before: Mapping[str, int], subset_index: int) -> Arrays:
    """Shift a subset's arrays so that they can be appended to those of the previous subsets.

    Row, sample and pair numbers are shifted; the first value of offsets is left out, except in the first subset.

    `before` are the sizes of all previous subsets by letter, `subset_index` is their number.

    Raises:
        TracklakeError: there are too many rows, samples or pairs for their numbers.
    """
    sizes = count_sizes(arrays)
    if max(before["N"] + sizes["N"], before["S"] + sizes["S"]) > MOST_ROWS:
        raise TracklakeError(f"more than {MOST_ROWS:,} rows or samples in one split: exclude recordings from it")
    return {array.name: _shift_array(array, arrays[array.name], before, subset_index) for array in ARRAYS}


def _shift_array(array: Array, values: np.ndarray, before: Mapping[str, int], subset_index: int) -> np.ndarray:
    if array.name == "run_subset":
        return np.full_like(values, subset_index)
    if not array.counts:
        return values
    shift = values.dtype.type(before[array.counts])
    if array.shape[0].endswith("+1") and subset_index:
        values = values[1:]
    shifted: np.ndarray = np.where(values < 0, values, values + shift)  # negative numbers mean none
    return shifted


def _sort_rows(frame: pl.DataFrame) -> pl.DataFrame:
    """Sort rows by vehicle, tick and, if present, cell, unless they are sorted as in the lake's tables."""
    step = np.diff(_key(frame, "vehicle_id"))
    by = [name for name in ("vehicle_id", "tick", "cell") if name in frame.columns]
    again = np.diff(frame["cell"].to_numpy()) < 0 if "cell" in by else np.zeros(len(step), dtype=np.bool_)
    return frame.sort(by) if ((step < 0) | ((step == 0) & again)).any() else frame


def _key(frame: pl.DataFrame, vehicle: str) -> Integers:
    """Join vehicle and tick to one number of the same order."""
    return join_key(frame[vehicle].to_numpy(), frame["tick"].to_numpy())


def _encode_names(names: pl.Series, order: tuple[str, ...]) -> Bytes:
    """Encode names by their positions in an enumeration."""
    return names.replace_strict(list(order), range(len(order)), return_dtype=pl.UInt8).to_numpy()


def _check_order(clock: pl.DataFrame, where: str) -> None:
    """Refuse entries out of order."""
    if not bool((np.diff(_key(clock, "vehicle_id")) > 0).all()):
        raise ValueError(f"{where}: the entries on the clock are not sorted by (vehicle_id, tick), or not unique")


def _find_origins(samples: pl.DataFrame, runs: _Runs, protocol: Protocol, where: str) -> Integers:
    """Find the row of each sample, (S,); a sample without an entry or full history on the clock is refused."""
    origin = runs.find_rows(_key(samples, "vehicle_id"))
    known = origin >= 0
    first, _ = runs.bound_rows()
    known[known] = origin[known] - first[origin[known]] >= protocol.history_ticks - 1
    if not known.all():
        vehicle, tick = samples.select("vehicle_id", "tick").row(int(np.argmin(known)))
        raise ValueError(
            f"{where}: {int((~known).sum())} of {samples.height} samples have no entry or not {protocol.history_ticks} "
            f"ticks of history on the clock, for example vehicle {vehicle} at tick {tick}; make the samples again from "
            "these tracks"
        )
    return origin


def _find_pairs(samples: pl.DataFrame, neighbors: pl.DataFrame, runs: _Runs, where: str) -> tuple[Integers, Integers]:
    """Find the sample and the row of each neighbor, (K,) each, in the given order; unknown ones are refused."""
    key = _key(neighbors, "vehicle_id")
    # Pairs are sorted like the samples, so one key per sample with neighbors is looked up, not one per pair.
    starts = find_run_starts(key)
    sample_key = _key(samples, "vehicle_id")
    sample = np.searchsorted(sample_key, key[starts])
    unknown = np.append(sample_key, -1)[sample] != key[starts]
    if unknown.any():
        vehicle, tick = neighbors.select("vehicle_id", "tick").row(int(starts[np.argmax(unknown)]))
        raise ValueError(
            f"{where}: neighbors name a missing sample, for example vehicle {vehicle} at tick {tick}; "
            "make samples and neighbors again"
        )
    row = runs.find_rows(_key(neighbors, "neighbor_id"))
    if (row < 0).any():
        neighbor, tick = neighbors.select("neighbor_id", "tick").row(int(np.argmax(row < 0)))
        raise ValueError(
            f"{where}: {int((row < 0).sum())} neighbors have no entry on the clock, for example vehicle {neighbor} at "
            f"tick {tick}; make samples and neighbors again from these tracks"
        )
    return np.repeat(sample, np.diff(np.append(starts, len(key)))).astype(np.int64), row


def _find_runs(vehicle_id: Integers, tick: Integers, segment: npt.NDArray[Any], block: Integers | None = None) -> _Runs:
    """Find runs of consecutive ticks of one vehicle, one segment and, if given, one block."""
    starts = np.ones(len(tick), dtype=np.bool_)
    starts[1:] = (vehicle_id[1:] != vehicle_id[:-1]) | (tick[1:] != tick[:-1] + 1) | (segment[1:] != segment[:-1])
    if block is not None:
        starts[1:] |= block[1:] != block[:-1]
    first_row = np.flatnonzero(starts).astype(np.int64)
    last_row = np.append(first_row[1:], len(tick))[: len(first_row)] - 1
    return _Runs(first_row=first_row, last_row=last_row, key=join_key(vehicle_id[first_row], tick[first_row]))
