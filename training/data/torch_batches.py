"""Batches as torch tensors: streamed from the mapped folder, drawn by a sampler, or gathered on the device itself."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, get_worker_info

from tracklake.training.data.batches import Batch, Integers
from tracklake.training.data.draws import draw_numbers
from tracklake.training.data.tensor_folder import TensorFolder, find_part

Change = Callable[[Batch], Batch]


@dataclass(frozen=True)
class TorchBatch:
    """The arrays of `training.data.batches.Batch` as tensors of the same names, shapes, dtypes and units."""

    sample: Tensor
    history: Tensor
    future: Tensor
    future_mask: Tensor
    neighbor_history: Tensor
    neighbor_mask: Tensor
    neighbor_sample: Tensor
    neighbor_cell: Tensor
    lateral: Tensor
    longitudinal: Tensor
    origin: Tensor
    absolute: bool = False

    @classmethod
    def of(cls, batch: Batch) -> Self:
        """The same values, not copied."""
        return cls(**{own.name: _as_tensor(getattr(batch, own.name)) for own in fields(cls)})

    def __len__(self) -> int:
        """B."""
        return len(self.sample)

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> Self:
        """On a device; from pinned memory with `non_blocking` the copy runs beside what is computed."""
        return self._each(lambda tensor: tensor.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Self:
        """In page-locked memory (DataLoader calls this for `pin_memory=True`); needs an accelerator."""
        return self._each(Tensor.pin_memory)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Self:
        values = {own.name: getattr(self, own.name) for own in fields(self)}
        changed: dict[str, Any] = {name: change(value) for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **changed)


def _as_tensor(value: Any) -> Any:  # noqa: ANN401  (arrays become tensors, what is none stays)
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def _to_torch(batch: Batch, change: Change | None) -> TorchBatch:
    return TorchBatch.of(batch if change is None else change(batch))


class BatchStream(IterableDataset[TorchBatch]):
    """All samples of a part, batch by batch; each pass in an order of its own.

    For `DataLoader(stream, batch_size=None)`, or to iterate as it is: gathering needs no workers. With several, every
    batch is yielded by one of them, and the order of a pass also depends on the seed that DataLoader draws for it:
    `torch.manual_seed` (or its `generator`) repeats it.

    Args:
        folder: where from.
        part: train, val or eval.
        batch_size: B; the last batch may be smaller.
        shuffle_seed: of the first pass; the next one takes the next seed (with workers: another). None = the samples'
            own order.
        shuffle_block: see `training.data.draws.draw_numbers`.
        absolute: see `Batch`.
        pin_memory: whether batches stand in page-locked memory; needs an accelerator.
        change: made to each batch before it becomes torch, such as `training.data.augmentation.mirror`. Each worker
            has a copy of it: let it draw by `torch.rand`, which DataLoader seeds for each worker and pass.

    Raises:
        ValueError: no such part.
    """

    def __init__(
        self,
        folder: TensorFolder,
        part: str,
        batch_size: int,
        *,
        shuffle_seed: int | None = None,
        shuffle_block: int | None = None,
        absolute: bool = False,
        pin_memory: bool = False,
        change: Change | None = None,
    ) -> None:
        super().__init__()
        self.folder, self.part, self.batch_size = folder, find_part(part), batch_size
        self.shuffle_seed, self.shuffle_block = shuffle_seed, shuffle_block
        self.absolute, self.pin_memory, self.change = absolute, pin_memory, change
        self.passes = 0

    def __len__(self) -> int:
        """Batches of one pass."""
        return -(-int((self.folder.sample_part == self.part).sum()) // self.batch_size)

    def __iter__(self) -> Iterator[TorchBatch]:
        """One pass."""
        seed, worker = self.shuffle_seed, get_worker_info()
        if seed is not None:
            # A worker's count of passes ends with it, where workers do not persist. The loader's base seed is new for
            # each set of workers, and the same for all of them.
            seed += self.passes + (0 if worker is None else worker.seed - worker.id)
        self.passes += 1
        drawn = draw_numbers(
            self.folder.sample_part, self.part, self.batch_size, shuffle_seed=seed, shuffle_block=self.shuffle_block
        )
        return self._gather(drawn if worker is None else islice(drawn, worker.id, None, worker.num_workers))

    def _gather(self, drawn: Iterable[Integers]) -> Iterator[TorchBatch]:
        for samples in drawn:
            batch = _to_torch(self.folder.gather(samples, absolute=self.absolute), self.change)
            yield batch.pin_memory() if self.pin_memory else batch


class SampleDataset(Dataset[TorchBatch]):
    """Samples of a part by number, for samplers of one's own; a batch is gathered at once.

    For `DataLoader(dataset, batch_size=B, sampler=..., collate_fn=dataset.collate)`.

    Args:
        folder: where from.
        part: train, val or eval.
        absolute: see `Batch`.
        change: made to each batch before it becomes torch, see `BatchStream`.

    Raises:
        ValueError: no such part.
    """

    def __init__(
        self, folder: TensorFolder, part: str, *, absolute: bool = False, change: Change | None = None
    ) -> None:
        self.folder, self.absolute, self.change = folder, absolute, change
        self.numbers = folder.samples_of(part)

    def __len__(self) -> int:
        """Samples of the part."""
        return len(self.numbers)

    def __getitem__(self, position: int) -> TorchBatch:
        """A batch of one sample; `position` counts within the part."""
        return self.__getitems__([position])[0]

    def __getitems__(self, positions: Sequence[int]) -> list[TorchBatch]:
        """One batch of several, in the list that DataLoader expects."""
        chosen = self.numbers[np.asarray(positions, dtype=np.int64)]
        return [_to_torch(self.folder.gather(chosen, absolute=self.absolute), self.change)]

    @staticmethod
    def collate(batches: list[TorchBatch]) -> TorchBatch:
        """The one batch of the list: nothing is left to put together."""
        (batch,) = batches
        return batch


class ResidentTensors:
    """A whole folder on a device, and batches gathered there: nothing crosses the bus but the samples' numbers.

    Takes what the arrays take: 16 bytes for each sample, 6 for each of its neighbors, 8 for each entry on the clock (4
    with int16 positions). Its batches are never NumPy's, so nothing of `training.data.augmentation` can change
    them: that needs `BatchStream` or `SampleDataset`.

    Args:
        folder: what to load.
        device: where to.
    """

    def __init__(self, folder: TensorFolder, device: torch.device | str) -> None:
        self.folder, self.device = folder, torch.device(device)

        def load(array: np.ndarray) -> Tensor:
            return load_array(array, self.device)

        self.position_m = load(folder.position_m)
        self.sample_row, self.sample_future = load(folder.sample_row), load(folder.sample_future)
        self.sample_part = load(folder.sample_part)
        self.lateral, self.longitudinal = load(folder.sample_lateral), load(folder.sample_longitudinal)
        self.offset, self.neighbor_row = load(folder.neighbor_offset), load(folder.neighbor_row)
        self.neighbor_cell, self.neighbor_known = load(folder.neighbor_cell), load(folder.neighbor_known)
        self.run_first_row, self.run_subset = load(folder.run_first_row), load(folder.run_subset)
        self.centre_m = load(folder.centre_m)
        step_m = folder.step_m
        self.step_m = None if step_m is None else torch.tensor(step_m, dtype=torch.float64, device=self.device)
        self.back = torch.arange(1 - folder.protocol.history_ticks, 1, device=self.device)
        self.ahead = torch.arange(1, folder.protocol.horizon_ticks + 1, device=self.device)

    def samples_of(self, part: str) -> Tensor:
        """(S_part,) numbers of the samples of one part, increasing, on the device."""
        return torch.nonzero(self.sample_part == find_part(part))[:, 0]

    def batches(
        self, part: str, batch_size: int, *, shuffle_seed: int | None = None, absolute: bool = False
    ) -> Iterator[TorchBatch]:
        """Every sample of a part once; the last batch may be smaller. The order is drawn on the device."""
        samples = self.samples_of(part)
        if shuffle_seed is not None:
            random = torch.Generator(self.device).manual_seed(shuffle_seed)
            samples = samples[torch.randperm(len(samples), generator=random, device=self.device)]
        for some in torch.split(samples, batch_size):
            if len(some):  # of no samples at all, split makes one empty batch
                yield self.gather(some, absolute=absolute)

    def gather(self, samples: Tensor, *, absolute: bool = False) -> TorchBatch:
        """Read samples by their numbers (B,) int64 on the device: values, masks and order as `TensorFolder.gather`."""
        row, future_known = self.sample_row[samples].long(), self.sample_future[samples].long()
        first = self.offset[samples]
        counts = self.offset[samples + 1] - first
        around = torch.repeat_interleave(torch.arange(len(samples), device=self.device), counts)
        before = torch.cumsum(counts, 0) - counts
        pair = torch.arange(len(around), device=self.device) + (first - before)[around]
        neighbor_row, neighbor_known = self.neighbor_row[pair].long(), self.neighbor_known[pair].long()
        neighbor_first = neighbor_row + 1 - neighbor_known

        origin = self.position_m[row]
        centre = origin if self.step_m is None else self._find_centres(row)
        history = self._read(row[:, None] + self.back, origin, centre, absolute)
        future_rows = torch.minimum(row[:, None] + self.ahead, (row + future_known)[:, None])
        neighbor_rows = torch.maximum(neighbor_row[:, None] + self.back, neighbor_first[:, None])
        return TorchBatch(
            sample=samples,
            history=history,
            future=self._read(future_rows, origin, centre, absolute),
            future_mask=self.ahead <= future_known[:, None],
            neighbor_history=self._read(neighbor_rows, origin[around], centre[around], absolute),
            neighbor_mask=-self.back < neighbor_known[:, None],
            neighbor_sample=around,
            neighbor_cell=self.neighbor_cell[pair],
            lateral=self.lateral[samples],
            longitudinal=self.longitudinal[samples],
            origin=self._read(row[:, None], origin, centre, absolute=True)[:, 0],
            absolute=absolute,
        )

    def _find_centres(self, row: Tensor) -> Tensor:
        """(B, 2) float64: what the int16 positions of rows (B,) count from."""
        run = torch.searchsorted(self.run_first_row, row, right=True) - 1
        return self.centre_m[self.run_subset[run].long()]

    def _read(self, rows: Tensor, origin: Tensor, centre: Tensor, absolute: bool) -> Tensor:
        """(M, T, 2) float32 positions in m of rows (M, T), relative to stored origins (M, 2) or absolute."""
        positions = self.position_m[rows]
        if absolute:
            return positions if self.step_m is None else (centre[:, None] + positions * self.step_m).float()
        return subtract_origin(positions, origin, self.step_m)


def load_array(array: npt.NDArray[Any], device: torch.device) -> Tensor:
    """A mapped array as a tensor on a device; always a copy, for torch does not know read-only memory."""
    return torch.from_numpy(array.copy()).to(device)


def subtract_origin(positions: Tensor, origin: Tensor, step_m: Tensor | None) -> Tensor:
    """Stored positions (M, T, 2) relative to stored origins (M, 2), in m, float32."""
    if step_m is None:
        return positions - origin[:, None]
    return (positions.float() - origin[:, None].float()) * step_m.float()
