"""Arrays of samples and their neighbors, whose rows are found by the runs of the whole subset."""

from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.resample import join_key
from tracklake.pipeline.transforms.tensors.entries import TensorInputs, encode_names
from tracklake.pipeline.transforms.tensors.runs import Runs
from tracklake.schemas.arrays import Integers, find_run_starts
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS


def build_sample_arrays(
    samples: pl.DataFrame, neighbors: pl.DataFrame, whole_runs: Runs, runs: Runs, inputs: TensorInputs
) -> tuple[dict[str, npt.NDArray[Any]], Integers]:
    """Build the arrays of samples and neighbors, and count by part the samples outside train that lost a neighbor.

    Args:
        samples: rows of all protocols.
        neighbors: the same samples' rows of all protocols.
        whole_runs: runs of the subset that no block's border cuts.
        runs: those that borders cut.
        inputs: the subset's other inputs.
    """
    protocol, part_of_block = inputs.protocol, inputs.part_of_block
    samples = _sort_rows(samples.filter(pl.col("protocol") == protocol.name))
    neighbors = _sort_rows(neighbors.filter(pl.col("protocol") == protocol.name))
    run, origin = _find_origins(samples, whole_runs, runs, inputs)
    pair_sample, pair_run, pair_row = _find_pairs(samples, neighbors, runs, inputs.where)
    usable = (
        runs.is_kept[run]
        & (origin - runs.first_row[run] >= protocol.history_ticks - 1)
        & (runs.last_row[run] - origin >= protocol.min_future_ticks)
    )
    beside = runs.block[pair_run] == runs.block[run[pair_sample]]
    part = part_of_block[runs.block[run]]
    cut = np.zeros(len(origin), dtype=np.bool_)
    cut[pair_sample[~beside]] = True
    cut &= usable & (part != PARTS.index("train"))
    if inputs.drop_cut:
        usable &= ~cut
    together = usable[pair_sample] & beside
    number = np.cumsum(usable) - 1
    pairs_of = np.bincount(number[pair_sample[together]], minlength=int(usable.sum()))
    own_run, own, pair_run, pair_row = run[usable], origin[usable], pair_run[together], pair_row[together]
    known = np.minimum(pair_row - runs.first_row[pair_run] + 1, protocol.history_ticks)
    arrays: dict[str, npt.NDArray[Any]] = {
        "sample_row": _number_rows(runs, own_run, own),
        "sample_part": part[usable],
        "sample_lateral": encode_names(samples["lateral_maneuver"], LATERAL_MANEUVERS)[usable],
        "sample_longitudinal": encode_names(samples["longitudinal_maneuver"], LONGITUDINAL_MANEUVERS)[usable],
        "sample_future": np.minimum(runs.last_row[own_run] - own, protocol.horizon_ticks),
        "neighbor_offset": np.concatenate([[0], np.cumsum(pairs_of)]),
        "neighbor_row": _number_rows(runs, pair_run, pair_row),
        "neighbor_cell": neighbors["cell"].to_numpy()[together],
        "neighbor_known": known,
    }
    return arrays, np.bincount(part[cut], minlength=len(PARTS))


def _number_rows(runs: Runs, run: Integers, row: Integers) -> Integers:
    """Return the numbers of rows, (N,), among those that blocks keep."""
    return runs.new_row[run] + row - runs.first_row[run]


def _sort_rows(frame: pl.DataFrame) -> pl.DataFrame:
    """Sort rows by vehicle, tick and, if present, cell, unless they are sorted as in the lake's tables."""
    step = np.diff(_key(frame, "vehicle_id"))
    by = [name for name in ("vehicle_id", "tick", "cell") if name in frame.columns]
    again = np.diff(frame["cell"].to_numpy()) < 0 if "cell" in by else np.zeros(len(step), dtype=np.bool_)
    return frame.sort(by) if ((step < 0) | ((step == 0) & again)).any() else frame


def _key(frame: pl.DataFrame, vehicle: str) -> Integers:
    """Join vehicle and tick to one number of the same order."""
    return join_key(frame[vehicle].to_numpy(), frame["tick"].to_numpy())


def _find_origins(
    samples: pl.DataFrame, whole_runs: Runs, runs: Runs, inputs: TensorInputs
) -> tuple[Integers, Integers]:
    """Find run and row of each sample, (S,); a sample without an entry or full history on the clock is refused."""
    key, ticks = _key(samples, "vehicle_id"), inputs.protocol.history_ticks
    run, origin = runs.find(key)
    known = origin >= 0
    whole, _ = whole_runs.find(key[known])
    known[known] = origin[known] - whole_runs.first_row[whole] >= ticks - 1
    if not known.all():
        vehicle, tick = samples.select("vehicle_id", "tick").row(int(np.argmin(known)))
        raise ValueError(
            f"{inputs.where}: {int((~known).sum())} of {samples.height} samples have no entry or not {ticks} "
            f"ticks of history on the clock, for example vehicle {vehicle} at tick {tick}; make the samples again from "
            "these tracks"
        )
    return run, origin


def _find_pairs(
    samples: pl.DataFrame, neighbors: pl.DataFrame, runs: Runs, where: str
) -> tuple[Integers, Integers, Integers]:
    """Find sample, run and row of each neighbor, (K,) each, in the given order; unknown ones are refused."""
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
    run, row = runs.find(_key(neighbors, "neighbor_id"))
    if (row < 0).any():
        neighbor, tick = neighbors.select("neighbor_id", "tick").row(int(np.argmax(row < 0)))
        raise ValueError(
            f"{where}: {int((row < 0).sum())} neighbors have no entry on the clock, for example vehicle {neighbor} at "
            f"tick {tick}; make samples and neighbors again from these tracks"
        )
    return np.repeat(sample, np.diff(np.append(starts, len(key)))).astype(np.int64), run, row
