"""Tensor folders: opened memory-mapped, checked against their declaration, gathered in batches by indexing."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import STEPS_M
from tracklake.training.data.batches import Batch, Bytes, Floats, Integers, SceneBatch
from tracklake.training.data.checks import TensorError
from tracklake.training.data.draws import draw_numbers
from tracklake.training.data.opening import map_arrays, read_index, read_protocol
from tracklake.training.data.scenes import Lanes, find_lanes, find_scenes_of_samples, gather_scenes
from tracklake.training.data.windows import Masks, Windows, check_numbers, place, spread, subtract

__all__ = ["Batch", "SceneBatch", "TensorError", "TensorFolder"]

Int32s = npt.NDArray[np.int32]


@dataclass(frozen=True)
class TensorFolder:
    """The arrays of one split, mapped into memory and not read until indexed. See `schemas.tensors.ARRAYS`.

    Args:
        path: the folder.
        index: what `index.json` holds.
        protocol: whose samples these are; gives H and F.
    """

    path: Path
    index: dict[str, Any]
    protocol: Protocol
    run_first_row: Integers
    neighbor_offset: Integers
    scene_offset: Integers
    speed_mps: Floats
    run_length_m: Floats
    run_width_m: Floats
    run_vehicle_id: Int32s
    run_first_tick: Int32s
    run_subset: Int32s
    sample_row: Int32s
    neighbor_row: Int32s
    scene_row: Int32s
    scene_sample: Int32s
    position_m: npt.NDArray[Any]
    lane: npt.NDArray[np.int16]
    finding: Bytes
    sample_part: Bytes
    sample_lateral: Bytes
    sample_longitudinal: Bytes
    sample_future: Bytes
    neighbor_cell: npt.NDArray[np.int8]
    neighbor_known: Bytes
    scene_part: Bytes

    @classmethod
    def open(cls, path: Path) -> Self:
        """Map a folder that the pipeline's tensors stage wrote.

        Raises:
            TensorError: the folder, its index or its arrays are absent, of another version, unreadable or cut short;
                a key of the index is not of its kind; an array is not of the dtype and shape declared; or offsets,
                subsets or parts do not agree with the index.
        """
        index = read_index(path)
        return cls(path=path, index=index, protocol=read_protocol(path, index), **map_arrays(path, index))

    @cached_property
    def step_m(self) -> tuple[float, float] | None:
        """Metres per step of int16 positions, along and across the road; None where they are float32."""
        return STEPS_M.get(self.index["storage"])

    @cached_property
    def centre_m(self) -> npt.NDArray[np.float64]:
        """(subsets, 2) what int16 positions count from."""
        return np.array([subset["centre_m"] for subset in self.index["subsets"]], dtype=np.float64).reshape(-1, 2)

    @cached_property
    def lanes(self) -> Lanes:
        """Where the lanes of each subset lie."""
        return find_lanes(self.index["subsets"])

    @cached_property
    def scene_of_sample(self) -> Int32s:
        """(S,) the scene that each sample stands in."""
        return find_scenes_of_samples(self)

    @cached_property
    def histories(self) -> Windows:
        """Every run of H positions."""
        return Windows(self.position_m, self.protocol.history_ticks)

    @cached_property
    def futures(self) -> Windows:
        """Every run of F positions."""
        return Windows(self.position_m, self.protocol.horizon_ticks)

    @cached_property
    def history_masks(self) -> Masks:
        """The last ticks of H are known."""
        return Masks(self.protocol.history_ticks, from_end=True)

    @cached_property
    def future_masks(self) -> Masks:
        """The first ticks of F are known."""
        return Masks(self.protocol.horizon_ticks, from_end=False)

    @property
    def split(self) -> str:
        """The split's name."""
        return str(self.index["split"])

    def samples_of(self, part: str) -> Integers:
        """(S_part,) numbers of the samples of one part, increasing.

        Raises:
            ValueError: no such part.
        """
        return np.flatnonzero(self.sample_part == find_part(part)).astype(np.int64)

    def scenes_of(self, part: str) -> Integers:
        """(C_part,) numbers of the scenes of one part, increasing.

        Raises:
            ValueError: no such part.
        """
        return np.flatnonzero(self.scene_part == find_part(part)).astype(np.int64)

    def runs_of(self, row: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
        """The run that each row stands in."""
        return np.searchsorted(self.run_first_row, row, side="right") - 1

    def subset_of(self, samples: npt.ArrayLike) -> Int32s:
        """(B,) position of each sample's subset in the index's `subsets`."""
        return self.run_subset[self.runs_of(self.sample_row[np.asarray(samples, dtype=np.intp)])]

    def subsets_of(self, part: str) -> set[str]:
        """Subsets (`dataset/subset`) that have samples in a part."""
        present = np.unique(self.subset_of(self.samples_of(part)))
        return {f"{named['dataset']}/{named['subset']}" for named in (self.index["subsets"][i] for i in present)}

    def batches(
        self,
        part: str,
        batch_size: int,
        *,
        shuffle_seed: int | None = None,
        shuffle_block: int | None = None,
        absolute: bool = False,
    ) -> Iterator[Batch]:
        """Every sample of a part once; the last batch may be smaller.

        Args:
            part: train, val or eval.
            batch_size: B.
            shuffle_seed: draws the order; None = the samples' own.
            shuffle_block: shuffle within blocks of so many samples, see `training.data.draws.draw_numbers`.
            absolute: see `Batch`.
        """
        order = {"shuffle_seed": shuffle_seed, "shuffle_block": shuffle_block}
        for samples in draw_numbers(self.sample_part, find_part(part), batch_size, **order):
            yield self.gather(samples, absolute=absolute)

    def scene_batches(
        self,
        part: str,
        batch_size: int,
        *,
        shuffle_seed: int | None = None,
        shuffle_block: int | None = None,
        absolute: bool = False,
    ) -> Iterator[SceneBatch]:
        """Every scene of a part once, `batch_size` at a time; otherwise as `batches`."""
        order = {"shuffle_seed": shuffle_seed, "shuffle_block": shuffle_block}
        for scenes in draw_numbers(self.scene_part, find_part(part), batch_size, **order):
            yield self.gather_scenes(scenes, absolute=absolute)

    def gather(self, samples: npt.ArrayLike, *, absolute: bool = False) -> Batch:
        """Read samples by their numbers (B,), in any order; no sample is looked at by itself.

        Raises:
            IndexError: a number below 0, or not below S.
        """
        sample = check_numbers(samples, len(self.sample_row), "sample")
        row = self.sample_row[sample].astype(np.intp)
        future_known = self.sample_future[sample]
        pair, neighbor_sample = spread(self.neighbor_offset, sample)
        neighbor_row = self.neighbor_row[pair].astype(np.intp)
        neighbor_known = self.neighbor_known[pair]

        back, ahead = self.protocol.history_ticks - 1, self.protocol.horizon_ticks
        whole = np.zeros(len(row), dtype=np.bool_)  # a sample's history is complete by definition
        history = self.histories.take(row - back, row, row, whole)
        future = self.futures.take(row + 1, row, row + future_known, future_known < ahead)
        neighbor_history = self.histories.take(
            neighbor_row - back, neighbor_row + 1 - neighbor_known, neighbor_row, neighbor_known <= back
        )
        origin = self.position_m[row]
        centre = self.centre_m[self.subset_of(sample)] if self.step_m is not None else self.centre_m[:0]
        if absolute:
            around = centre[neighbor_sample] if self.step_m is not None else centre
            history, future, neighbor_history = (
                place(history, centre, self.step_m),
                place(future, centre, self.step_m),
                place(neighbor_history, around, self.step_m),
            )
        else:
            history, future, neighbor_history = (
                subtract(history, origin, self.step_m),
                subtract(future, origin, self.step_m),
                subtract(neighbor_history, origin[neighbor_sample], self.step_m),
            )
        return Batch(
            sample=sample,
            history=history,
            future=future,
            future_mask=self.future_masks.take(future_known),
            neighbor_history=neighbor_history,
            neighbor_mask=self.history_masks.take(neighbor_known),
            neighbor_sample=neighbor_sample,
            neighbor_cell=self.neighbor_cell[pair],
            lateral=self.sample_lateral[sample],
            longitudinal=self.sample_longitudinal[sample],
            origin=place(origin[:, None, :], centre, self.step_m)[:, 0],
            absolute=absolute,
        )

    def gather_scenes(self, scenes: npt.ArrayLike, *, absolute: bool = False) -> SceneBatch:
        """Read scenes by their numbers (B,), in any order.

        Raises:
            IndexError: a number below 0, or not below C.
        """
        return gather_scenes(self, check_numbers(scenes, len(self.scene_part), "scene"), absolute=absolute)


def find_part(part: str) -> int:
    """The part's position in PARTS.

    Raises:
        ValueError: no such part.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part `{part}`: expected one of {', '.join(PARTS)}")
    return PARTS.index(part)
