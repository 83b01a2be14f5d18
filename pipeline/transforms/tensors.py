"""Training tensors of one split: flat arrays over the protocol's clock, and an index of samples and their neighbors.

The tables that go in name vehicles and ticks; the arrays that come out name rows, so that reading a batch is nothing
but indexing. Every history and future is a run of consecutive rows.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from schemas.protocols import Protocol
from schemas.tensors import ARRAYS, TENSORS_VERSION

Arrays = dict[str, np.ndarray]
"""One NumPy array per name of `schemas.tensors.ARRAYS`, of its dtype."""

Integers = npt.NDArray[np.int64]

_ROW_ARRAYS = ("segment_first", "segment_last", "sample_row", "neighbor_row")
"""Arrays that hold row numbers, which shift when arrays are joined."""


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


def build_subset_arrays(
    clock: pl.DataFrame,
    samples: pl.DataFrame,
    neighbors: pl.DataFrame,
    blocks: pl.DataFrame,
    *,
    subset_index: int,
    first_frame: int,
    frame_rate_hz: float,
    protocol: Protocol,
) -> Arrays:
    """Build the arrays of one subset that stands in the split.

    Only entries inside a block of the split are kept, and no history, future or pair of neighbors crosses a block's
    border: runs are cut there, samples whose history or least future is cut are left out, and so are neighbors that
    stand in another block. Where the subset stands undivided (one block), nothing of this changes anything.

    Args:
        clock: the subset's entries on the protocol's clock, sorted by (vehicle_id, tick): vehicle_id, tick, x_m, y_m,
            lane (null becomes 0), speed_mps, segment (a gap-free stretch of a track).
        samples: rows of `schemas.samples.SAMPLES` of this subset; other protocols' rows are passed by.
        neighbors: rows of `schemas.samples.NEIGHBORS` of this subset; likewise.
        blocks: the split's rows of `schemas.splits.SPLITS` for this subset; blocks do not overlap.
        subset_index: the subset's position in the index's `subsets`.
        first_frame: the subset's first frame, where tick 0 lies.
        frame_rate_hz: of the source; tick k lies at frame first_frame + k * frame_rate_hz / protocol.rate_hz. A tick
            between two frames belongs to a block only if both do.
        protocol: whose clock, samples and neighbors these are.

    Returns:
        One array per name of `schemas.tensors.ARRAYS`.

    Raises:
        ValueError: blocks overlap; the clock is not sorted; or samples and neighbors name entries or a history that the
            clock does not have (they were made from other tracks).

    Source: DESIGN section 9.
    """
    where = f"{blocks['dataset'][0]}/{blocks['subset'][0]}" if blocks.height else f"subset {subset_index}"
    samples = samples.filter(pl.col("protocol") == protocol.name).sort("vehicle_id", "tick")
    neighbors = neighbors.filter(pl.col("protocol") == protocol.name).sort("vehicle_id", "tick", "cell")
    _check_order(clock, where)

    tick = clock["tick"].to_numpy().astype(np.int64)
    vehicle_id = clock["vehicle_id"].to_numpy().astype(np.int64)
    segment = clock["segment"].to_numpy()
    runs = _find_runs(vehicle_id, tick, segment)
    origin = _find_origins(samples, runs, protocol, where)
    pair_sample, pair_row = _find_pairs(samples, neighbors, runs, where)

    # All rows below count the whole clock; `new_row` turns them into rows of what the blocks keep of it.
    block = _block_of(first_frame + tick * (frame_rate_hz / protocol.rate_hz), vehicle_id, blocks, where)
    kept = block >= 0
    new_row = np.cumsum(kept) - 1
    first, last = _find_runs(vehicle_id, tick, segment, block).bounds()
    usable = (
        kept[origin]
        & (origin - first[origin] >= protocol.history_ticks - 1)
        & (last[origin] - origin >= protocol.min_future_ticks)
    )
    together = usable[pair_sample] & (block[pair_row] == block[origin[pair_sample]])
    number = np.cumsum(usable) - 1
    pairs_of = np.bincount(number[pair_sample[together]], minlength=int(usable.sum()))

    part_of_block = _codes(blocks["part"], PARTS)
    arrays: dict[str, npt.ArrayLike] = {
        "x_m": clock["x_m"].to_numpy()[kept],
        "y_m": clock["y_m"].to_numpy()[kept],
        "speed_mps": clock["speed_mps"].to_numpy()[kept],
        "lane": clock["lane"].fill_null(0).to_numpy()[kept],
        "subset": np.full(int(kept.sum()), subset_index),
        "vehicle_id": vehicle_id[kept],
        "tick": tick[kept],
        "segment_first": new_row[first[kept]],
        "segment_last": new_row[last[kept]],
        "sample_row": new_row[origin[usable]],
        "sample_part": part_of_block[block[origin[usable]]],
        "sample_lateral": _codes(samples["lateral_maneuver"], LATERAL_MANEUVERS)[usable],
        "sample_longitudinal": _codes(samples["longitudinal_maneuver"], LONGITUDINAL_MANEUVERS)[usable],
        "neighbor_offset": np.concatenate([[0], np.cumsum(pairs_of)]),
        "neighbor_row": new_row[pair_row[together]],
        "neighbor_cell": neighbors["cell"].to_numpy()[together],
    }
    return {array.name: np.ascontiguousarray(arrays[array.name], dtype=array.dtype) for array in ARRAYS}


def concatenate(parts: Sequence[Arrays]) -> Arrays:
    """Join subsets' arrays in the given order; row numbers and offsets shift accordingly.

    Args:
        parts: what `build_subset_arrays` returned, by increasing `subset_index`. None at all gives arrays without
            rows, samples and pairs.
    """
    first_rows = np.cumsum([0, *(len(part["x_m"]) for part in parts)])
    first_pairs = np.cumsum([0, *(len(part["neighbor_row"]) for part in parts)])
    joined: Arrays = {}
    for array in ARRAYS:
        pieces = [part[array.name] for part in parts]
        if array.name in _ROW_ARRAYS:
            pieces = [piece + first for piece, first in zip(pieces, first_rows, strict=False)]
        elif array.name == "neighbor_offset":
            # Each part's offsets end where the next part's begin: the first one of each but the first is left out.
            pieces = [piece[1:] + first for piece, first in zip(pieces, first_pairs, strict=False)]
            pieces = [np.zeros(1, dtype=np.int64), *pieces]
        joined[array.name] = np.concatenate([np.empty(0, dtype=array.dtype), *pieces]).astype(array.dtype, copy=False)
    return joined


def describe_tensors(arrays: Arrays, subsets: pl.DataFrame, splits: pl.DataFrame, protocol: Protocol) -> dict[str, Any]:
    """What `index.json` says of the arrays beside it.

    Args:
        arrays: of the whole split.
        subsets: dataset, subset, frame_rate_hz, in the order of `subset_index`.
        splits: the split's rows of `schemas.splits.SPLITS`; they let an evaluation prove that a model was trained on
            other data.
        protocol: of the samples.

    Returns:
        version, split, protocol (parameters and digest), subsets, blocks, sizes (N, S, K) and samples by part.
    """
    by_part = np.bincount(arrays["sample_part"], minlength=len(PARTS))
    split = splits["split"].unique().sort()
    return {
        "version": TENSORS_VERSION,
        "split": split[0] if len(split) == 1 else protocol.split,
        "protocol": {**asdict(protocol), "digest": protocol.digest},
        "subsets": subsets.select("dataset", "subset", "frame_rate_hz").to_dicts(),
        "blocks": splits.drop("split").sort("dataset", "subset", "block").to_dicts(),
        "sizes": {
            "N": len(arrays["x_m"]),
            "S": len(arrays["sample_row"]),
            "K": len(arrays["neighbor_row"]),
        },
        "samples_by_part": {part: int(count) for part, count in zip(PARTS, by_part, strict=True)},
    }


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
