"""Training tensors of one split: flat arrays on the protocol's clock, and an index of samples and their neighbors.

The input tables name vehicles and ticks; the arrays name rows, so that a batch is read by indexing alone. Every history
and future is a run of consecutive rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tensors.entries import (
    TensorInputs,
    build_row_arrays,
    build_run_arrays,
    keep_entries,
    split_key,
)
from tracklake.pipeline.transforms.tensors.positions import store_positions
from tracklake.pipeline.transforms.tensors.runs import Runs
from tracklake.pipeline.transforms.tensors.sample_arrays import build_sample_arrays
from tracklake.pipeline.transforms.tensors.scenes import build_scene_arrays
from tracklake.schemas.arrays import Integers, expand_ranges
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import ARRAYS, MOST_TICKS, Array

Arrays = dict[str, np.ndarray]
"""Arrays by their names in `schemas.tensors.ARRAYS`, with its dtypes and shapes."""
MOST_ROWS = 2**31 - 1
"""Largest number of rows or samples, which are numbered by Int32."""


@dataclass(frozen=True)
class SubsetTensors:
    """The tensors of one subset, or a part of them; rows, samples and subsets are numbered from 0.

    The figures are of the subset up to this part.

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


def build_subset_tensors(
    clock: pl.DataFrame, samples: pl.DataFrame, neighbors: pl.DataFrame, inputs: TensorInputs
) -> SubsetTensors:
    """Build the arrays of one subset of the split.

    Only entries inside a block of the split are kept, and no history, future or pair of neighbors crosses a block's
    border: runs are cut there, and samples whose history or least future is cut and neighbors in another block are left
    out. A subset that is one block is not changed. A tick between two frames is in a block only if both are.

    `clock` has vehicle_id, tick, x_m, y_m, lane (null becomes 0), speed_mps, segment, sorted by the first two; samples
    have protocol, vehicle_id, tick and the maneuvers; neighbors protocol, vehicle_id, tick, cell, neighbor_id (rows of
    other protocols are skipped).

    Raises:
        ValueError: blocks overlap; the clock is not sorted; samples or neighbors do not fit the clock (they were made
            from other tracks); `vehicles` lacks a vehicle; or positions do not fit their storage.

    Source: DESIGN section 9.
    """
    check_protocol(inputs)
    kept = keep_entries(clock, inputs)
    x_m, y_m = (clock[name].to_numpy()[kept.is_kept] for name in ("x_m", "y_m"))
    stored = store_positions(x_m, y_m, storage=inputs.storage, where=inputs.where)
    sample_arrays, cut_samples = build_sample_arrays(samples, neighbors, kept.whole_runs, kept.runs, inputs)
    arrays = build_row_arrays(kept, stored, inputs) | build_run_arrays(kept.runs, inputs) | sample_arrays
    sample_of_row = np.full(len(x_m), -1, dtype=np.int64)
    sample_of_row[arrays["sample_row"]] = np.arange(len(arrays["sample_row"]))
    row, block, tick = list_rows(kept.runs)
    arrays |= build_scene_arrays(row, block, tick, sample_of_row, inputs.part_of_block)
    return SubsetTensors(
        conform_arrays(arrays, inputs.storage),
        stored.centre_m,
        stored.max_error_m,
        stored.squared_error_m2,
        int(arrays["lane"].max(initial=0)),
        tuple(cut_samples.tolist()),
    )


def check_protocol(inputs: TensorInputs) -> None:
    """Refuse a protocol whose ticks are not counted by a byte."""
    protocol = inputs.protocol
    if max(protocol.history_ticks, protocol.horizon_ticks) > MOST_TICKS:
        raise ValueError(f"protocol {protocol.name}: tensors hold at most {MOST_TICKS} ticks of history and of future")


def list_rows(runs: Runs) -> tuple[Integers, Integers, Integers]:
    """Return the rows that blocks keep, numbered from 0, with the block and the tick of each, (N,) each."""
    own = runs.is_kept
    row, run = expand_ranges(runs.new_row[own], runs.size[own])
    _, first_tick = split_key(runs.key[own])
    return row, runs.block[own][run], first_tick[run] + row - runs.new_row[own][run]


def conform_arrays(arrays: Mapping[str, np.ndarray], storage: str) -> Arrays:
    """Return the arrays in their declared dtypes; those that are not given have no elements, or one offset of 0."""
    none = dict.fromkeys("NRSKCM", 0)
    return {
        array.name: np.ascontiguousarray(
            arrays[array.name] if array.name in arrays else np.zeros(array.sizes(none)), array.stored_as(storage)
        )
        for array in ARRAYS
    }


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


def join_after(
    arrays: Arrays, before: Mapping[str, int], subset_index: int, earlier: Mapping[str, int] | None = None
) -> Arrays:
    """Shift a subset's arrays so that they can be appended to those of the previous subsets.

    Row, sample and pair numbers are shifted; the first value of offsets is left out, except at the very beginning.

    `before` are the sizes of all previous subsets by letter, `subset_index` is their number, `earlier` the sizes of the
    earlier parts of this subset, None for the first one.

    Raises:
        TracklakeError: there are too many rows, samples or pairs for their numbers.
    """
    sizes = count_sizes(arrays)
    if max(before[letter] + (earlier or {}).get(letter, 0) + sizes[letter] for letter in "NS") > MOST_ROWS:
        raise TracklakeError(f"more than {MOST_ROWS:,} rows or samples in one split: exclude recordings from it")
    follows = subset_index > 0 or earlier is not None
    return {
        array.name: _shift_array(array, arrays[array.name], before, subset_index, follows=follows) for array in ARRAYS
    }


def _shift_array(
    array: Array, values: np.ndarray, before: Mapping[str, int], subset_index: int, *, follows: bool
) -> np.ndarray:
    if array.name == "run_subset":
        return np.full_like(values, subset_index)
    if not array.counts:
        return values
    shift = values.dtype.type(before[array.counts])
    if array.shape[0].endswith("+1") and follows:
        values = values[1:]
    shifted: np.ndarray = np.where(values < 0, values, values + shift)  # negative numbers mean none
    return shifted
