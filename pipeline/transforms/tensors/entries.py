"""Entries on the protocol's clock that blocks of a split keep, and what the tensors hold of each and of its run."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.resample import find_blocks, join_key
from tracklake.pipeline.transforms.tensors.positions import Stored
from tracklake.pipeline.transforms.tensors.runs import Runs, find_runs
from tracklake.pipeline.transforms.tensors.vehicle_facts import find_sizes, mark_findings
from tracklake.schemas.arrays import Bytes, Flags, Integers
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import POSITION_STORAGES


@dataclass(frozen=True)
class TensorInputs:
    """What the tensors of one subset are made with, besides its clock, samples and neighbors.

    Args:
        blocks: the split's rows of SPLITS for this subset.
        vehicles: vehicle_id, length_m, width_m.
        findings: vehicle_id, severity, first_frame, last_frame.
        left_out: vehicles whose entries are in no part but train.
        drop_cut: whether samples outside train with a neighbor in another block or in no part are left out.
    """

    blocks: pl.DataFrame
    vehicles: pl.DataFrame
    findings: pl.DataFrame
    first_frame: int
    frame_rate_hz: float
    protocol: Protocol
    storage: str = POSITION_STORAGES[0]
    left_out: pl.Series | None = None
    drop_cut: bool = False

    @property
    def where(self) -> str:
        """Name of the subset in messages."""
        blocks = self.blocks
        return f"{blocks['dataset'][0]}/{blocks['subset'][0]}" if blocks.height else "a subset in no block"

    @property
    def rates(self) -> Mapping[str, Any]:
        """First frame, frame rate and rate of the clock."""
        own = {"first_frame": self.first_frame, "frame_rate_hz": self.frame_rate_hz}
        return {**own, "rate_hz": self.protocol.rate_hz}

    @property
    def part_of_block(self) -> Bytes:
        """Part of each block, as its position in PARTS."""
        return encode_names(self.blocks["part"], PARTS)


@dataclass(frozen=True)
class KeptEntries:
    """The (N,) entries of a clock, which of them a block keeps, and their runs; rows are numbered from 0.

    Args:
        is_kept: (N,) whether the entry is in a block.
        whole_runs: runs that no block's border cuts.
    """

    clock: pl.DataFrame
    is_kept: Flags
    whole_runs: Runs
    runs: Runs


def keep_entries(clock: pl.DataFrame, inputs: TensorInputs) -> KeptEntries:
    """Assign entries to blocks and cut runs at their borders.

    Raises:
        ValueError: the entries are not sorted, or blocks overlap.
    """
    tick = clock["tick"].to_numpy().astype(np.int64)
    vehicle_id = clock["vehicle_id"].to_numpy().astype(np.int64)
    segment = clock["segment"].to_numpy()
    if not bool((np.diff(join_key(vehicle_id, tick)) > 0).all()):
        raise ValueError(
            f"{inputs.where}: the entries on the clock are not sorted by (vehicle_id, tick), or not unique"
        )
    frame = inputs.first_frame + tick * (inputs.frame_rate_hz / inputs.protocol.rate_hz)
    block = find_blocks(frame, vehicle_id, inputs.blocks, inputs.where)
    left_out, part_of_block = inputs.left_out, inputs.part_of_block
    if left_out is not None and len(left_out):
        block[np.isin(vehicle_id, left_out.to_numpy()) & (part_of_block[block] != PARTS.index("train"))] = -1
    return KeptEntries(
        clock=clock,
        is_kept=block >= 0,
        whole_runs=find_runs(vehicle_id, tick, segment, np.zeros_like(block)),
        runs=find_runs(vehicle_id, tick, segment, block),
    )


def build_row_arrays(kept: KeptEntries, stored: Stored, inputs: TensorInputs) -> dict[str, npt.NDArray[Any]]:
    """Build the arrays of the entries that blocks keep."""
    vehicle_id, tick = (kept.clock[name].to_numpy().astype(np.int64) for name in ("vehicle_id", "tick"))
    return {
        "position_m": stored.steps,
        "speed_mps": kept.clock["speed_mps"].to_numpy()[kept.is_kept],
        "lane": kept.clock["lane"].fill_null(0).to_numpy()[kept.is_kept],
        "finding": mark_findings(vehicle_id, tick, inputs.findings, **inputs.rates)[kept.is_kept],
    }


def build_run_arrays(runs: Runs, inputs: TensorInputs, rows_before: int = 0) -> dict[str, npt.NDArray[Any]]:
    """Build the arrays of the runs that blocks keep, whose rows come after others."""
    own = runs.is_kept
    vehicle_id, first_tick = split_key(runs.key[own])
    length_m, width_m = find_sizes(inputs.vehicles, vehicle_id, where=inputs.where)
    return {
        "run_first_row": rows_before + np.append(runs.new_row[own], runs.size[own].sum()),
        "run_vehicle_id": vehicle_id,
        "run_length_m": length_m,
        "run_width_m": width_m,
        "run_first_tick": first_tick,
        "run_subset": np.zeros(len(vehicle_id)),
    }


def split_key(key: Integers) -> tuple[Integers, Integers]:
    """Return vehicles and ticks of keys, (N,) each; the inverse of `join_key`."""
    vehicle_id = (key + 2**31) >> 32
    return vehicle_id, key - (vehicle_id << 32)


def encode_names(names: pl.Series, order: tuple[str, ...]) -> Bytes:
    """Encode names by their positions in an enumeration."""
    return names.replace_strict(list(order), range(len(order)), return_dtype=pl.UInt8).to_numpy()
