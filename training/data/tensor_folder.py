"""Tensor folders: opened memory-mapped, checked against their declaration, gathered in batches by indexing."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats, Integers, Singles
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import ARRAYS, STEPS_M
from tracklake.training.data.batches import Batch, SceneBatch
from tracklake.training.data.checks import TensorError
from tracklake.training.data.opening import map_arrays, read_index, read_protocol
from tracklake.training.data.positions import check_numbers, find_runs
from tracklake.training.data.samples import gather_samples
from tracklake.training.data.scenes import Lanes, find_lanes, find_scenes_of_samples, gather_scenes

__all__ = ["Batch", "SceneBatch", "TensorError", "TensorFolder"]

_NAMES = frozenset(array.name for array in ARRAYS)


@dataclass(frozen=True)
class TensorFolder:
    """The arrays of one split, mapped into memory and not read until indexed.

    Every array of `schemas.tensors.ARRAYS` is an attribute, too: `folder.sample_row`.

    Args:
        path: the folder.
        index: content of `index.json`.
        protocol: protocol of the samples; gives H and F.
        arrays: arrays by name.
    """

    path: Path
    index: dict[str, Any]
    protocol: Protocol
    arrays: Mapping[str, npt.NDArray[Any]]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Map a folder that the pipeline's tensors stage wrote.

        Raises:
            TensorError: the folder, its index or its arrays are absent, of another version, unreadable or cut short;
                a key of the index is not of its kind; an array is not of the dtype and shape declared; or offsets,
                subsets or parts do not agree with the index.
        """
        index = read_index(path)
        return cls(path, index, read_protocol(path, index), map_arrays(path, index))

    def __getattr__(self, name: str) -> npt.NDArray[Any]:
        """Return an array by its name.

        Raises:
            AttributeError: no array has the name.
        """
        if name not in _NAMES:
            raise AttributeError(f"a tensor folder has no array `{name}`", name=name, obj=self)
        return self.arrays[name]

    @cached_property
    def step_m(self) -> Floats | None:
        """(2,) metres per step of int16 positions, along and across the road; None where they are float32."""
        step_m = STEPS_M.get(self.index["storage"])
        return None if step_m is None else np.array(step_m)

    @cached_property
    def centre_m(self) -> Floats:
        """(subsets, 2) the points that int16 positions are counted from."""
        return np.array([subset["centre_m"] for subset in self.index["subsets"]], dtype=np.float64).reshape(-1, 2)

    @cached_property
    def run_size_m(self) -> Singles:
        """(R, 2) length and width of each run's vehicle; 0 where unknown."""
        size_m: Singles = np.nan_to_num(np.stack([self.run_length_m, self.run_width_m], axis=-1), nan=0.0)
        return size_m

    @cached_property
    def lanes(self) -> Lanes:
        """Where the lanes of each subset lie."""
        return find_lanes(self.index["subsets"])

    @cached_property
    def adjacent_lanes(self) -> Floats:
        """(subsets, O, 3, 3) the lanes beside each lane, see `Lanes.find_adjacent`."""
        return self.lanes.find_adjacent()

    @cached_property
    def scene_of_sample(self) -> npt.NDArray[np.int32]:
        """(S,) the scene that each sample stands in."""
        return find_scenes_of_samples(self)

    @property
    def split(self) -> str:
        """Name of the split."""
        return str(self.index["split"])

    def samples_of(self, part: str) -> Integers:
        """Return (S_part,) numbers of the samples of one part, increasing.

        Raises:
            ValueError: no such part.
        """
        return np.flatnonzero(self.sample_part == find_part(part))

    def scenes_of(self, part: str) -> Integers:
        """Return (C_part,) numbers of the scenes of one part, increasing.

        Raises:
            ValueError: no such part.
        """
        return np.flatnonzero(self.scene_part == find_part(part))

    def runs_of(self, row: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
        """Return the run that each row stands in."""
        runs: npt.NDArray[np.intp] = find_runs(self, row)
        return runs

    def subset_of(self, samples: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Return (B,) the position of each sample's subset in the index's `subsets`."""
        return self.run_subset[self.runs_of(self.sample_row[np.asarray(samples, dtype=np.intp)])]

    def subsets_of(self, part: str) -> set[str]:
        """Return the subsets (`dataset/subset`) that have samples in a part."""
        present = np.unique(self.subset_of(self.samples_of(part)))
        return {f"{named['dataset']}/{named['subset']}" for named in (self.index["subsets"][i] for i in present)}

    def batches(
        self, part: str, batch_size: int, *, shuffle_seed: int | None = None, absolute: bool = False
    ) -> Iterator[Batch]:
        """Yield every sample of a part once; the last batch may be smaller.

        Args:
            part: train, val or eval.
            batch_size: samples in a batch, B.
            shuffle_seed: seed of the order; None = the samples' own order.
            absolute: see `Batch`.
        """
        for samples in _cut(self.samples_of(part), batch_size, shuffle_seed):
            yield self.gather(samples, absolute=absolute)

    def scene_batches(
        self, part: str, batch_size: int, *, shuffle_seed: int | None = None, absolute: bool = False
    ) -> Iterator[SceneBatch]:
        """Yield every scene of a part once, `batch_size` at a time; otherwise as `batches`."""
        for scenes in _cut(self.scenes_of(part), batch_size, shuffle_seed):
            yield self.gather_scenes(scenes, absolute=absolute)

    def gather(self, samples: npt.ArrayLike, *, absolute: bool = False) -> Batch:
        """Read samples by their numbers (B,), in any order.

        Raises:
            IndexError: a number is below 0 or not below S.
        """
        return gather_samples(self, check_numbers(samples, len(self.sample_row), "sample"), absolute=absolute)

    def gather_scenes(self, scenes: npt.ArrayLike, *, absolute: bool = False) -> SceneBatch:
        """Read scenes by their numbers (B,), in any order.

        Raises:
            IndexError: a number is below 0 or not below C.
        """
        return gather_scenes(self, check_numbers(scenes, len(self.scene_part), "scene"), absolute=absolute)


def find_part(part: str) -> int:
    """Return the part's position in PARTS.

    Raises:
        ValueError: no such part.
    """
    if part not in PARTS:
        raise ValueError(f"unknown part `{part}`: expected one of {', '.join(PARTS)}")
    return PARTS.index(part)


def _cut(numbers: Integers, size: int, shuffle_seed: int | None) -> Iterator[Integers]:
    """Yield numbers in pieces of a size, in their own order or shuffled."""
    if size < 1:
        raise ValueError(f"expected batches of at least 1, got {size}")
    if shuffle_seed is not None:
        np.random.default_rng(shuffle_seed).shuffle(numbers)
    for start in range(0, len(numbers), size):
        yield numbers[start : start + size]
