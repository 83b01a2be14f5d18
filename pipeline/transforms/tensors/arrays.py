"""Training tensors of one split: flat arrays over the protocol's clock, and an index of samples and their neighbors.

The tables that go in name vehicles and ticks; the arrays that come out name rows, so that reading a batch is nothing
but indexing. Every history and future is a run of consecutive rows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.tensors.positions import store_positions
from tracklake.pipeline.transforms.tensors.scenes import find_scenes
from tracklake.pipeline.transforms.tensors.vehicle_facts import find_sizes, mark_findings
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, MOST_TICKS, POSITION_STORAGES, Array

Arrays = dict[str, np.ndarray]
"""One NumPy array per name of `schemas.tensors.ARRAYS`, of its dtype and shape."""

Integers = npt.NDArray[np.int64]

MOST_ROWS = 2**31 - 1
"""Rows and samples are numbered by Int32."""


@dataclass(frozen=True)
class SubsetTensors:
    """The tensors of one subset; rows, samples and subsets are numbered from 0.

    Args:
        arrays: see `schemas.tensors.ARRAYS`.
        centre_m: what stored positions count from: along, across.
        max_error_m: greatest rounding error of the stored positions: along, across; 0 without rows.
        squared_error_m2: sums of the squared rounding errors.
        last_lane: the highest lane of any entry; 0 where no lane is known.
    """

    arrays: Arrays
    centre_m: tuple[float, float]
    max_error_m: tuple[float, float]
    squared_error_m2: tuple[float, float]
    last_lane: int


@dataclass(frozen=True)
class _Runs:
    """Gap-free runs of rows, in row order: consecutive ticks of one vehicle.

    Args:
        first_row: (R,) increasing.
        last_row: (R,)
        key: (R,) vehicle and first tick in one number, increasing.
    """

    first_row: Integers
    last_row: Integers
    key: Integers

    def find_rows(self, key: Integers) -> Integers:
        """Rows of (vehicle, tick) keys, any shape; -1 where there is none.

        Searches the runs, not the rows: there are hundreds of times fewer, and they stay in the processor's cache.
        """
        if len(self.key) == 0:
            return np.full(key.shape, -1, dtype=np.int64)
        run = np.searchsorted(self.key, key, side="right") - 1
        row = self.first_row[run] + (key - self.key[run])
        return np.where((run >= 0) & (row <= self.last_row[run]), row, -1)

    def bounds(self) -> tuple[Integers, Integers]:
        """(N,) first and last row of the run that each row stands in."""
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
) -> SubsetTensors:
    """Build the arrays of one subset that stands in the split.

    Only entries inside a block of the split are kept, and no history, future or pair of neighbors crosses a block's
    border: runs are cut there, samples whose history or least future is cut are left out, and so are neighbors that
    stand in another block. Where the subset stands undivided (one block), nothing of this changes anything.

    Args:
        clock: the subset's entries on the protocol's clock, sorted by (vehicle_id, tick): vehicle_id, tick, x_m, y_m,
            lane (null becomes 0), speed_mps, segment (a gap-free stretch of a track).
        samples: of `schemas.samples.SAMPLES` protocol, vehicle_id, tick and the maneuvers, for this subset; other
            protocols' rows are passed by.
        neighbors: of `schemas.samples.NEIGHBORS` protocol, vehicle_id, tick, cell, neighbor_id; likewise.
        blocks: the split's rows of `schemas.splits.SPLITS` for this subset; blocks do not overlap.
        vehicles: of `schemas.vehicles.VEHICLES` vehicle_id, length_m, width_m, of every vehicle of the clock.
        findings: of `schemas.findings.FINDINGS` vehicle_id, severity, first_frame, last_frame, in any order.
        first_frame: the subset's first frame, where tick 0 lies.
        frame_rate_hz: of the source; tick k lies at frame first_frame + k * frame_rate_hz / protocol.rate_hz. A tick
            between two frames belongs to a block only if both do.
        protocol: whose clock, samples and neighbors these are.
        storage: of positions, one of `schemas.tensors.POSITION_STORAGES`.
        left_out: ids of vehicles (`schemas.splits.SPLIT_LEFT_OUT`) whose entries outside `train` are in no part.

    Raises:
        ValueError: blocks overlap; the clock is not sorted; samples and neighbors name entries or a history that the
            clock does not have (they were made from other tracks); `vehicles` lacks one of the clock's; or positions do
            not fit their storage.

    Source: DESIGN section 9.
    """
    where = f"{blocks['dataset'][0]}/{blocks['subset'][0]}" if blocks.height else "a subset in no block"
    samples = _sort(samples.filter(pl.col("protocol") == protocol.name))
    neighbors = _sort(neighbors.filter(pl.col("protocol") == protocol.name))
    _check_order(clock, where)
    if max(protocol.history_ticks, protocol.horizon_ticks) > MOST_TICKS:
        raise ValueError(f"protocol {protocol.name}: tensors hold at most {MOST_TICKS} ticks of history and of future")

    tick = clock["tick"].to_numpy().astype(np.int64)
    vehicle_id = clock["vehicle_id"].to_numpy().astype(np.int64)
    segment = clock["segment"].to_numpy()
    runs = _find_runs(vehicle_id, tick, segment)
    origin = _find_origins(samples, runs, protocol, where)
    pair_sample, pair_row = _find_pairs(samples, neighbors, runs, where)

    # All rows below count the whole clock; `new_row` turns them into rows of what the blocks keep of it.
    block = _block_of(first_frame + tick * (frame_rate_hz / protocol.rate_hz), vehicle_id, blocks, where)
    part_of_block = _codes(blocks["part"], PARTS)
    if left_out is not None and len(left_out):
        block[np.isin(vehicle_id, left_out.to_numpy()) & (part_of_block[block] != PARTS.index("train"))] = -1
    kept = block >= 0
    new_row = np.cumsum(kept, dtype=np.int32) - np.int32(1)
    cut = _find_runs(vehicle_id, tick, segment, block)
    first, last = cut.bounds()
    usable = (
        kept[origin]
        & (origin - first[origin] >= protocol.history_ticks - 1)
        & (last[origin] - origin >= protocol.min_future_ticks)
    )
    together = usable[pair_sample] & (block[pair_row] == block[origin[pair_sample]])
    number = np.cumsum(usable) - 1
    pairs_of = np.bincount(number[pair_sample[together]], minlength=int(usable.sum()))
    pair_row, own = pair_row[together], origin[usable]

    sample_of_row = np.full(len(tick), -1, dtype=np.int64)
    sample_of_row[own] = np.arange(len(own))
    scenes = find_scenes(tick[kept], block[kept], sample_of_row[kept])
    run_kept = kept[cut.first_row]
    stored = store_positions(clock["x_m"].to_numpy()[kept], clock["y_m"].to_numpy()[kept], storage=storage, where=where)
    lane = clock["lane"].fill_null(0).to_numpy()[kept]
    length_m, width_m = find_sizes(vehicles, vehicle_id[cut.first_row[run_kept]], where=where)
    finding = mark_findings(
        vehicle_id, tick, findings, first_frame=first_frame, frame_rate_hz=frame_rate_hz, rate_hz=protocol.rate_hz
    )
    arrays: dict[str, npt.ArrayLike] = {
        "position_m": stored.steps,
        "speed_mps": clock["speed_mps"].to_numpy()[kept],
        "lane": lane,
        "finding": finding[kept],
        "run_first_row": np.append(new_row[cut.first_row[run_kept]], kept.sum()),
        "run_vehicle_id": vehicle_id[cut.first_row[run_kept]],
        "run_length_m": length_m,
        "run_width_m": width_m,
        "run_first_tick": tick[cut.first_row[run_kept]],
        "run_subset": np.zeros(int(run_kept.sum())),
        "sample_row": new_row[own],
        "sample_part": part_of_block[block[own]],
        "sample_lateral": _codes(samples["lateral_maneuver"], LATERAL_MANEUVERS)[usable],
        "sample_longitudinal": _codes(samples["longitudinal_maneuver"], LONGITUDINAL_MANEUVERS)[usable],
        "sample_future": np.minimum(last[own] - own, protocol.horizon_ticks),
        "neighbor_offset": np.concatenate([[0], np.cumsum(pairs_of)]),
        "neighbor_row": new_row[pair_row],
        "neighbor_cell": neighbors["cell"].to_numpy()[together],
        "neighbor_known": np.minimum(pair_row - first[pair_row] + 1, protocol.history_ticks),
        "scene_offset": scenes.offset,
        "scene_row": scenes.row,
        "scene_sample": scenes.sample,
        "scene_part": part_of_block[scenes.block],
    }
    return SubsetTensors(
        arrays={
            array.name: np.ascontiguousarray(arrays[array.name], dtype=array.stored_as(storage)) for array in ARRAYS
        },
        centre_m=stored.centre_m,
        max_error_m=stored.max_error_m,
        squared_error_m2=stored.squared_error_m2,
        last_lane=int(lane.max(initial=0)),
    )


def count_sizes(arrays: Arrays) -> dict[str, int]:
    """The sizes by letter; see `schemas.tensors.Array`."""
    return {
        "N": len(arrays["lane"]),
        "R": len(arrays["run_subset"]),
        "S": len(arrays["sample_row"]),
        "K": len(arrays["neighbor_row"]),
        "C": len(arrays["scene_part"]),
        "M": len(arrays["scene_row"]),
    }


def join_after(arrays: Arrays, before: Mapping[str, int], subset_index: int) -> Arrays:
    """What a subset's arrays add to those of the subsets before it.

    Args:
        arrays: of `build_subset_tensors`.
        before: sizes of all subsets before, by letter.
        subset_index: how many subsets there are before.

    Returns:
        Arrays to be put behind those before: row, sample and pair numbers shifted; the first value of offsets is left
        out where the ones before end with it (unless this is the first subset).

    Raises:
        TracklakeError: rows, samples or pairs are too many for their numbers.
    """
    sizes = count_sizes(arrays)
    if max(before["N"] + sizes["N"], before["S"] + sizes["S"]) > MOST_ROWS:
        raise TracklakeError(f"more than {MOST_ROWS:,} rows or samples in one split: exclude recordings from it")
    return {array.name: _shift(array, arrays[array.name], before, subset_index) for array in ARRAYS}


def _shift(array: Array, values: np.ndarray, before: Mapping[str, int], subset_index: int) -> np.ndarray:
    """One array of `join_after`."""
    if array.name == "run_subset":
        return np.full_like(values, subset_index)
    if not array.counts:
        return values
    shift = values.dtype.type(before[array.counts])
    if array.shape[0].endswith("+1") and subset_index:
        values = values[1:]
    shifted: np.ndarray = np.where(values < 0, values, values + shift)  # a negative number stands for none
    return shifted


def _sort(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows by vehicle, tick and, where there is one, cell; as they are where they stand so, as the lake's tables do."""
    step = np.diff(_key(frame, "vehicle_id"))
    by = [name for name in ("vehicle_id", "tick", "cell") if name in frame.columns]
    again = np.diff(frame["cell"].to_numpy()) < 0 if "cell" in by else np.zeros(len(step), dtype=np.bool_)
    return frame.sort(by) if ((step < 0) | ((step == 0) & again)).any() else frame


def _key(frame: pl.DataFrame, vehicle: str) -> Integers:
    """(vehicle, tick) as one number of the same order; both fit 31 bits."""
    return _join_key(frame[vehicle].to_numpy().astype(np.int64), frame["tick"].to_numpy().astype(np.int64))


def _join_key(vehicle_id: Integers, tick: Integers) -> Integers:
    """The same of two arrays."""
    return (vehicle_id << 32) | tick


def _codes(names: pl.Series, order: tuple[str, ...]) -> npt.NDArray[np.uint8]:
    """Positions of names in an enumeration."""
    return names.replace_strict(list(order), range(len(order)), return_dtype=pl.UInt8).to_numpy()


def _check_order(clock: pl.DataFrame, where: str) -> None:
    """Refuse entries out of order."""
    if not bool((np.diff(_key(clock, "vehicle_id")) > 0).all()):
        raise ValueError(f"{where}: the entries on the clock are not sorted by (vehicle_id, tick), or not unique")


def _find_origins(samples: pl.DataFrame, runs: _Runs, protocol: Protocol, where: str) -> Integers:
    """(S,) row of each sample; one that the clock has no entry or no full history for is refused."""
    origin = runs.find_rows(_key(samples, "vehicle_id"))
    known = origin >= 0
    first, _ = runs.bounds()
    known[known] = origin[known] - first[origin[known]] >= protocol.history_ticks - 1
    if not known.all():
        vehicle, tick = samples.select("vehicle_id", "tick").row(int(np.argmin(known)))
        raise ValueError(
            f"{where}: {int((~known).sum())} of {samples.height} samples have no entry or not {protocol.history_ticks} "
            f"ticks of history on the clock, for example vehicle {vehicle} at tick {tick}; make the samples anew from "
            "these tracks"
        )
    return origin


def _find_pairs(samples: pl.DataFrame, neighbors: pl.DataFrame, runs: _Runs, where: str) -> tuple[Integers, Integers]:
    """(K,) sample and row of each neighbor, in the order of `neighbors`; an unknown one is refused."""
    key = _key(neighbors, "vehicle_id")
    # Pairs are sorted like the samples: look up one key per sample with neighbors, not one per pair.
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    sample_key = _key(samples, "vehicle_id")
    sample = np.searchsorted(sample_key, key[starts])
    unknown = np.append(sample_key, -1)[sample] != key[starts]
    if unknown.any():
        vehicle, tick = neighbors.select("vehicle_id", "tick").row(int(starts[np.argmax(unknown)]))
        raise ValueError(
            f"{where}: neighbors name a sample that is not there, for example vehicle {vehicle} at tick {tick}; "
            "make samples and neighbors anew"
        )
    row = runs.find_rows(_key(neighbors, "neighbor_id"))
    if (row < 0).any():
        neighbor, tick = neighbors.select("neighbor_id", "tick").row(int(np.argmax(row < 0)))
        raise ValueError(
            f"{where}: {int((row < 0).sum())} neighbors have no entry on the clock, for example vehicle {neighbor} at "
            f"tick {tick}; make samples and neighbors anew from these tracks"
        )
    return np.repeat(sample, np.diff(np.append(starts, len(key)))).astype(np.int64), row


def _block_of(frame: npt.NDArray[np.floating], vehicle_id: Integers, blocks: pl.DataFrame, where: str) -> Integers:
    """(N,) row of `blocks` in which each entry stands; -1 where it stands in none."""
    found = np.full(len(frame), -1, dtype=np.int64)
    for position, block in enumerate(blocks.iter_rows(named=True)):
        # Positions between frames are floating-point; a millionth of a frame is none.
        inside = (frame > block["first_frame"] - 1e-6) & (frame < block["last_frame"] + 1e-6)
        if block["first_vehicle_id"] is not None:
            inside &= vehicle_id >= block["first_vehicle_id"]
        if block["last_vehicle_id"] is not None:
            inside &= vehicle_id <= block["last_vehicle_id"]
        if (inside & (found >= 0)).any():
            raise ValueError(f"{where}: block {block['block']} of the split overlaps another one")
        found[inside] = position
    return found


def _find_runs(vehicle_id: Integers, tick: Integers, segment: npt.NDArray[Any], block: Integers | None = None) -> _Runs:
    """Runs of consecutive ticks of one vehicle, one segment and, where given, one block."""
    starts = np.ones(len(tick), dtype=np.bool_)
    starts[1:] = (vehicle_id[1:] != vehicle_id[:-1]) | (tick[1:] != tick[:-1] + 1) | (segment[1:] != segment[:-1])
    if block is not None:
        starts[1:] |= block[1:] != block[:-1]
    first_row = np.flatnonzero(starts).astype(np.int64)
    last_row = np.append(first_row[1:], len(tick))[: len(first_row)] - 1
    return _Runs(first_row=first_row, last_row=last_row, key=_join_key(vehicle_id[first_row], tick[first_row]))
