"""The tensors of a long subset in parts, which follow one another: whole tracks first, scenes last."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.number_store import MakeStore, NumberStore, find_median
from tracklake.pipeline.transforms.slices import list_windows
from tracklake.pipeline.transforms.tensors.arrays import SubsetTensors, check_protocol, conform_arrays
from tracklake.pipeline.transforms.tensors.entries import (
    TensorInputs,
    build_row_arrays,
    build_run_arrays,
    keep_entries,
    split_key,
)
from tracklake.pipeline.transforms.tensors.positions import find_centre, store_positions
from tracklake.pipeline.transforms.tensors.runs import Runs, join_runs
from tracklake.pipeline.transforms.tensors.sample_arrays import build_sample_arrays
from tracklake.pipeline.transforms.tensors.scenes import build_scene_arrays
from tracklake.schemas.arrays import expand_ranges
from tracklake.schemas.columns import PARTS
from tracklake.schemas.tensors import STEPS_M


@dataclass(frozen=True)
class LongSubset:
    """How the tables of a long subset are read, some vehicles at a time.

    Args:
        read_clocks: function that yields the entries on the clock as `build_subset_tensors` takes them: whole tracks,
            in order of vehicles.
        read_samples: function that returns samples and neighbors of the vehicles above one id and up to another; None
            is no bound.
        make_store: function that makes a store of numbers.
        at_once: number of rows that are held in memory.
    """

    read_clocks: Callable[[], Iterable[pl.DataFrame]]
    read_samples: Callable[[int | None, int | None], tuple[pl.DataFrame, pl.DataFrame]]
    make_store: MakeStore
    at_once: int


def build_parts(subset: LongSubset, inputs: TensorInputs) -> Iterator[SubsetTensors]:
    """Yield the tensors that `build_subset_tensors` makes of the whole subset in parts; raises as it does.

    Rows are numbered in a first pass, so that samples find neighbors in other parts.
    """
    check_protocol(inputs)
    parts, whole_parts, centre_m = _survey(subset, inputs)
    runs, whole_runs = join_runs(parts), join_runs(whole_parts)
    ids = np.maximum.accumulate([int(split_key(part.key)[0].max(initial=-1)) for part in parts])
    last_ids = [*ids[:-1].tolist(), None]
    sample_of_row = subset.make_store("int32")
    made = SubsetTensors({}, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0, (0,) * len(PARTS))
    samples_before = pairs_before = 0
    for clock, part, low, high in zip(subset.read_clocks(), parts, [None, *last_ids], last_ids, strict=False):
        kept = keep_entries(clock, inputs)
        rows_before = sample_of_row.size
        x_m, y_m = (clock[name].to_numpy()[kept.is_kept] for name in ("x_m", "y_m"))
        stored = store_positions(
            x_m, y_m, storage=inputs.storage, where=inputs.where, centre_m=centre_m, earlier_m2=made.squared_error_m2
        )
        sampled, cut = build_sample_arrays(*subset.read_samples(low, high), whole_runs, runs, inputs)
        own = np.full(len(x_m), -1)
        own[sampled["sample_row"] - rows_before] = samples_before + np.arange(len(sampled["sample_row"]))
        sample_of_row.append(own)
        sampled["neighbor_offset"] += pairs_before
        samples_before, pairs_before = samples_before + len(sampled["sample_row"]), sampled["neighbor_offset"][-1]
        arrays = build_row_arrays(kept, stored, inputs) | build_run_arrays(part, inputs, rows_before) | sampled
        worst = np.maximum(made.max_error_m, stored.max_error_m).tolist()
        made = SubsetTensors(
            conform_arrays(arrays, inputs.storage),
            stored.centre_m,
            (worst[0], worst[1]),
            stored.squared_error_m2,
            max(made.last_lane, int(arrays["lane"].max(initial=0))),
            tuple((np.array(made.cut_samples) + cut).tolist()),
        )
        yield made
    for scenes in _list_scenes(runs, sample_of_row, inputs, subset.at_once):
        yield replace(made, arrays=conform_arrays(scenes, inputs.storage))


def _survey(subset: LongSubset, inputs: TensorInputs) -> tuple[list[Runs], list[Runs], tuple[float, float] | None]:
    """Return the runs of each part, cut by blocks and whole, and the origin of int16 positions."""
    parts, whole = [], []
    positions = [subset.make_store("float64") for _ in range(2)]
    for clock in subset.read_clocks():
        kept = keep_entries(clock, inputs)
        parts.append(kept.runs)
        whole.append(kept.whole_runs)
        if inputs.storage in STEPS_M:
            for store, name in zip(positions, ("x_m", "y_m"), strict=True):
                store.append(clock[name].to_numpy()[kept.is_kept])
    if not positions[0].size:
        return parts, whole, None
    return parts, whole, find_centre([find_median(store, subset.at_once) for store in positions], inputs.storage)


def _list_scenes(
    runs: Runs, sample_of_row: NumberStore, inputs: TensorInputs, at_once: int
) -> Iterator[dict[str, np.ndarray]]:
    """Yield the arrays of scenes, block by block, as many ticks at once as have so many rows."""
    first_tick, scenes_before = split_key(runs.key)[1], 0
    for block in range(inputs.blocks.height):
        own = np.flatnonzero(runs.block == block)
        for chosen, before, size in list_windows(first_tick[own], runs.size[own], at_once):
            inside = own[chosen]
            row, run = expand_ranges(runs.new_row[inside] + before, size)
            tick = row - runs.new_row[inside][run] + first_tick[inside][run]
            sample = sample_of_row[row].astype(np.int64)
            made = build_scene_arrays(row, np.full_like(row, block), tick, sample, inputs.part_of_block)
            made["scene_offset"] += scenes_before
            scenes_before = made["scene_offset"][-1]
            yield made
