"""Tensor folders: opened memory-mapped, checked against their declaration, gathered in batches by indexing."""

import errno
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Floats, Integers, Singles
from tracklake.schemas.columns import PARTS, SEVERITIES
from tracklake.schemas.errors import MORE_FILES, FileAccessError, UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensor_index import TensorError, read_index, read_protocol
from tracklake.schemas.tensors import ARRAYS, LANE_CENTRES, NOMINAL_LANE_M, STEPS_M
from tracklake.training.data.batches import Batch, SceneBatch
from tracklake.training.data.gathers import check_numbers, find_runs, gather_samples, gather_scenes

if TYPE_CHECKING:
    import torch

__all__ = ["Batch", "DeviceFolder", "SceneBatch", "TensorError", "TensorFolder"]

_NAMES = frozenset(array.name for array in ARRAYS)
_NO_PART = 255
"""Code of samples and scenes that `narrow` leaves out, in `sample_part` and `scene_part`."""


@dataclass(frozen=True)
class TensorFolder:
    """The arrays of one split, mapped into memory and not read until indexed.

    Every array of `schemas.tensors.ARRAYS` is an attribute, too: `folder.sample_row`. `index` is the content of
    `index.json`; the protocol of the samples gives H and F. `kept` are the numbers of the subsets that `narrow` keeps.
    """

    path: Path
    index: dict[str, Any] = field(repr=False)
    protocol: Protocol
    arrays: Mapping[str, npt.NDArray[Any]] = field(repr=False)
    kept: frozenset[int] | None = None

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Map a folder that the pipeline's tensors stage wrote; TensorError where it is not as declared and written."""
        path = Path(path)
        index = read_index(path)
        return cls(path, index, read_protocol(path, index), _map_arrays(path, index))

    def narrow(self, dataset: str | None = None, recording: str | None = None) -> Self:
        """Keep the samples and scenes of one dataset, and of one recording or subset in it; all others are of no part.

        What is kept has the same input as before: neighbors are of the sample's own subset.

        Raises:
            UsageError: no subset has these names.
        """
        if dataset is recording is None:
            return self
        meant = self._find_subsets(*([] if recording is None else [recording]))
        datasets = np.array([own["dataset"] for own in self.index["subsets"]])
        if dataset is not None and dataset not in datasets[meant]:
            known = ", ".join(np.unique(datasets[meant]))
            what = "a dataset" if recording is None else f"the dataset of `{recording}`"
            raise UsageError(f"{self.path}: expected {what} ({known}), got `{dataset}`")
        meant &= (datasets == dataset) | (dataset is None)
        scene = self.run_subset[self.runs_of(self.scene_row[self.scene_offset[:-1]])]
        parts = {
            "sample_part": np.where(meant[self.run_subset[self.runs_of(self.sample_row)]], self.sample_part, _NO_PART),
            "scene_part": np.where(meant[scene], self.scene_part, _NO_PART),
        }
        narrowed = {name: part.astype(np.uint8) for name, part in parts.items()}
        return replace(self, arrays={**self.arrays, **narrowed}, kept=frozenset(np.flatnonzero(meant).tolist()))

    def __getattr__(self, name: str) -> npt.NDArray[Any]:
        """Return an array by its name."""
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
    def lane_centred(self) -> Flags:
        """(subsets,) whether lateral positions are lane centres, so that errors across the road mean nothing."""
        return np.array([own["lateral_positions"] == LANE_CENTRES for own in self.index["subsets"]], dtype=np.bool_)

    @cached_property
    def run_size_m(self) -> Singles:
        """(R, 2) length and width of each run's vehicle; 0 where unknown."""
        size_m: Singles = np.nan_to_num(np.stack([self.run_length_m, self.run_width_m], axis=-1), nan=0.0)
        return size_m

    @cached_property
    def last_lane(self) -> npt.NDArray[np.int16]:
        """(subsets,) the rightmost lane."""
        return np.array([subset["last_lane"] for subset in self.index["subsets"]], dtype=np.int16)

    @cached_property
    def marked_lanes(self) -> Floats:
        """(subsets, L + 1, 2) y of the centre, and width, of lanes 0 to L; NaN where unknown, at lane 0 and at L.

        L is one more than the highest marked lane of all subsets.
        """
        markings = [np.array(subset["lane_markings_m"] or [0.0]) for subset in self.index["subsets"]]
        lanes = np.full((len(markings), 1 + max(map(len, markings), default=1), 2), np.nan)
        for number, own in enumerate(markings):
            lanes[number, 1 : len(own)] = np.stack([(own[1:] + own[:-1]) / 2, np.diff(own)], axis=-1)
        return lanes

    @cached_property
    def all_lanes(self) -> Floats:
        """(subsets, M, 3) every lane from the left one on: y of the centre, width, and 1; zeros beyond the last lane.

        Where a subset has no markings, lanes are NOMINAL_LANE_M wide, from the left edge on.
        """
        lane = np.arange(1, int(self.last_lane.max(initial=0)) + 1)
        exists = (lane <= self.last_lane[:, None])[..., None]
        marked = self.marked_lanes[:, np.minimum(lane, self.marked_lanes.shape[1] - 1)]
        nominal = np.stack([(lane - 0.5) * NOMINAL_LANE_M, np.full(len(lane), NOMINAL_LANE_M)], axis=-1)
        return np.concatenate([np.where(np.isnan(marked), nominal, marked), exists], axis=-1) * exists

    @cached_property
    def adjacent_lanes(self) -> Floats:
        """(subsets, O, 3, 3) the lanes left of, under and right of lanes 0 to O - 1, as in `all_lanes`.

        Zeros where a lane does not exist: lane 0 stands for no lane and has no neighbors, and neither has any above
        O - 1.
        """
        own = np.arange(self.all_lanes.shape[1] + 3)[:, None]
        padded = np.pad(self.all_lanes, ((0, 0), (2, 3), (0, 0)))  # lane 1 is at 2
        return padded[:, own + np.arange(3)] * (own > 0)[..., None]

    @cached_property
    def scene_of_sample(self) -> npt.NDArray[np.int32]:
        """(S,) the scene that each sample stands in; TensorError where it stands in none, or in several."""
        member = np.flatnonzero(self.scene_sample >= 0)
        sample, samples = self.scene_sample[member], len(self.sample_row)
        times = np.bincount(sample, minlength=samples)
        if len(times) != samples or (times != 1).any():
            expected, found = f"each of {samples:,} samples in one scene", f"{len(member):,} vehicles that are samples"
            raise TensorError.at(self.path, f"array `scene_sample`: expected {expected}, got {found}")
        scene = np.empty(samples, dtype=np.int32)
        scene[sample] = np.searchsorted(self.scene_offset, member, side="right") - 1
        return scene

    @property
    def origins(self) -> dict[str, str]:
        """Origin, recorded or synthetic, of each subset that is kept, by name (`dataset/subset`)."""
        subsets = self.index["subsets"]
        kept = (subsets[number] for number in sorted(range(len(subsets)) if self.kept is None else self.kept))
        return {f"{named['dataset']}/{named['subset']}": named["origin"] for named in kept}

    @property
    def lane_centred_subsets(self) -> list[str]:
        """Names (`dataset/subset`) of the kept subsets that have lane centres in place of lateral positions, sorted."""
        subsets = (f"{own['dataset']}/{own['subset']}" for own in self.index["subsets"])
        named = zip(subsets, self.lane_centred, strict=True)
        return sorted(name for name, centred in named if centred and name in self.origins)

    @property
    def split(self) -> str:
        """Name of the split."""
        return str(self.index["split"])

    def samples_of(self, part: str, *names: str) -> Integers:
        """Return (S_part,) numbers of the samples of one part, increasing, of all subsets or of those named.

        A name is that of a subset or of a recording: `01` stands for `01-upper` and `01-lower`.

        Raises:
            UsageError: no such part, or no subset of a name.
        """
        chosen = self.sample_part == _find_part(part)
        if names:
            chosen &= self._find_subsets(*names)[self.run_subset[self.runs_of(self.sample_row)]]
        return np.flatnonzero(chosen)

    def _find_subsets(self, *names: str) -> Flags:
        """Return (subsets,) which subsets are named, or are of a recording that is; all of them without names."""
        subsets = [own["subset"] for own in self.index["subsets"]]
        if not names:
            return np.ones(len(subsets), dtype=np.bool_)
        meant = np.array([[own == name or own.startswith(f"{name}-") for name in names] for own in subsets])
        if not meant.any(axis=0).all():
            raise UsageError(
                f"{self.path}: expected subsets, or recordings, of {', '.join(subsets)}, got {', '.join(names)}"
            )
        return np.asarray(meant.any(axis=1))

    def read_part(self, part: str, *names: str) -> Batch:
        """Read all samples of a part as one batch, of all subsets or of those named (see `samples_of`)."""
        return self.gather(self.samples_of(part, *names))

    def scenes_of(self, part: str) -> Integers:
        """Return (C_part,) numbers of the scenes of one part, increasing; UsageError for no such part."""
        return np.flatnonzero(self.scene_part == _find_part(part))

    def runs_of(self, row: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
        """Return the run that each row stands in."""
        runs: npt.NDArray[np.intp] = find_runs(self, row)
        return runs

    def subsets_of(self, part: str) -> set[str]:
        """Return the subsets (`dataset/subset`) that have samples in a part."""
        present = np.unique(self.run_subset[self.runs_of(self.sample_row[self.samples_of(part)])])
        return {f"{named['dataset']}/{named['subset']}" for named in (self.index["subsets"][i] for i in present)}

    def mark_flagged(self, samples: npt.ArrayLike, severity: str) -> Flags:
        """Return (B,) whether the sample's own vehicle breaks a rule within its history or its known future.

        Rules of a severity and worse ones count. `finding` in `schemas.tensors.ARRAYS` says which frames a row stands
        for: the first row of a history also stands for the frames since the tick before it.
        """
        if severity not in SEVERITIES:
            raise ValueError(f"unknown severity `{severity}`: expected one of {', '.join(SEVERITIES)}")
        sample = check_numbers(samples, self.sample_row, "sample")
        row = self.sample_row[sample].astype(np.intp)
        marked = (self.finding > 0) & (self.finding <= 1 + SEVERITIES.index(severity))
        before = np.cumsum(np.concatenate([[False], marked]), dtype=np.int32)
        flagged: Flags = before[row + self.sample_future[sample] + 1] > before[row + 1 - self.protocol.history_ticks]
        return flagged

    def batches(
        self, part: str, batch_size: int, *, shuffle_seed: int | None = None, absolute: bool = False
    ) -> Iterator[Batch]:
        """Yield every sample of a part once, in their own order or shuffled; the last batch may be smaller."""
        for samples in _cut(self.samples_of(part), batch_size, shuffle_seed):
            yield self.gather(samples, absolute=absolute)

    def scene_batches(
        self, part: str, batch_size: int, *, shuffle_seed: int | None = None, absolute: bool = False
    ) -> Iterator[SceneBatch]:
        """Yield every scene of a part once, in their own order or shuffled; the last batch may be smaller."""
        for scenes in _cut(self.scenes_of(part), batch_size, shuffle_seed):
            yield self.gather_scenes(scenes, absolute=absolute)

    def gather(self, samples: npt.ArrayLike, *, absolute: bool = False) -> Batch:
        """Read samples by their numbers (B,), in any order; IndexError for one below 0 or not below S."""
        return gather_samples(self, samples, absolute=absolute)

    def gather_scenes(self, scenes: npt.ArrayLike, *, absolute: bool = False) -> SceneBatch:
        """Read scenes by their numbers (B,), in any order; IndexError for one below 0 or not below C."""
        return gather_scenes(self, scenes, absolute=absolute)


class DeviceFolder:
    """The attributes of a `TensorFolder`, with every array as a tensor on a device, where batches are gathered.

    An array is copied when it is first used and stays there: 16 bytes for each sample, 6 for each of its neighbors and
    8 for each row (4 with int16 positions) where the grid is gathered.
    """

    def __init__(self, folder: TensorFolder, device: "torch.device") -> None:
        self._folder, self._device = folder, device

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (a tensor, or the folder's own value)
        """Return an attribute of the folder; called once for each, as the value is kept."""
        import torch

        value = getattr(self._folder, name)
        if isinstance(value, np.ndarray):
            value = torch.from_numpy(value.copy()).to(self._device)  # a copy: torch knows no read-only memory
        setattr(self, name, value)
        return value


def _map_arrays(path: Path, index: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Map every array of ARRAYS read-only, and check it against its declaration and the index."""
    arrays = {}
    for array in ARRAYS:
        file = path / array.file
        dtype, shape = np.dtype(array.stored_as(index["storage"])), array.sizes(index["sizes"])
        try:
            mapped = np.lib.format.open_memmap(file, mode="r")
        except Exception as broken:
            if isinstance(broken, OSError) and broken.errno == errno.EMFILE:
                raise FileAccessError(f"{file}: {broken.strerror}. {MORE_FILES}") from broken
            raise TensorError.at(file, f"cannot be read ({broken})") from broken
        if (mapped.dtype, mapped.shape) != (dtype, shape):
            raise TensorError.at(file, f"expected {dtype} of shape {shape}, got {mapped.dtype} of shape {mapped.shape}")
        size, wanted = file.stat().st_size, mapped.offset + mapped.nbytes
        if size != wanted:
            raise TensorError.at(file, f"expected {wanted:,} bytes, got {size:,}")
        arrays[array.name] = mapped.view(np.ndarray)  # indexing np.memmap itself runs Python code for every result
    _check_values(path, index, arrays)
    return arrays


def _check_values(path: Path, index: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Refuse offsets, subsets and parts that do not agree with the index, and would give wrong values.

    Only arrays by run, sample and scene are read, once each: a few ms for a million samples.
    """
    for array in ARRAYS:
        if not array.shape[0].endswith("+1"):
            continue
        what, offset, end = f"{path}: array `{array.name}`", arrays[array.name], index["sizes"][array.counts]
        if (offset[0], offset[-1]) != (0, end):
            raise TensorError.at(what, f"expected offsets from 0 to {end}, got {offset[0]} to {offset[-1]}")
        falls = offset[1:] < offset[:-1]
        if falls.any():
            at = int(falls.argmax())
            falling = f"{offset[at + 1]} after {offset[at]} at {at + 1}"
            raise TensorError.at(what, f"expected offsets that never fall, got {falling}")
    subset, last = arrays["run_subset"], len(index["subsets"]) - 1
    if len(subset) and (subset.min() < 0 or subset.max() > last):
        found = f"{subset.min()} to {subset.max()}"
        raise TensorError.at(path, f"array `run_subset`: expected 0 to {last}, the index's subsets, got {found}")
    part, what = arrays["sample_part"], f"{path}: array `sample_part`"
    for number, name in enumerate(PARTS):
        expected, got = index["samples_by_part"][name], np.count_nonzero(part == number)
        if got != expected:
            raise TensorError.at(what, f"expected {expected:,} samples of {name}, as the index counts, got {got:,}")
    others = np.count_nonzero(part >= len(PARTS))
    if others:
        raise TensorError.at(what, f"expected 0 to {len(PARTS) - 1}, got {part.max()} ({others:,} samples of no part)")


def _find_part(part: str) -> int:
    if part not in PARTS:
        raise UsageError(f"unknown part `{part}`: expected one of {', '.join(PARTS)}")
    return PARTS.index(part)


def _cut(numbers: Integers, size: int, shuffle_seed: int | None) -> Iterator[Integers]:
    """Yield numbers in pieces of a size, in their own order or shuffled."""
    if size < 1:
        raise ValueError(f"expected batches of at least 1, got {size}")
    if shuffle_seed is not None:
        np.random.default_rng(shuffle_seed).shuffle(numbers)
    for start in range(0, len(numbers), size):
        yield numbers[start : start + size]
