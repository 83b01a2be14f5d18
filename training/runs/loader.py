"""The data loader of a training: its batches step after step, on the device of the network."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from tracklake.schemas.arrays import Integers
from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder
from tracklake.training.models import Reads
from tracklake.training.models.inputs import read_on_device, read_samples
from tracklake.training.runs.config import Plan

if TYPE_CHECKING:
    import torch

Read = Callable[[Integers], tuple[Any, Any]]
"""Reads samples by their numbers (B,): what may be seen of them and the truth, as tensors on the device."""


def load_batches(plan: Plan, read: Read, step: int) -> Iterator[tuple[int, Any, Any]]:
    """Yield the batches from a step on, without end: number of samples, what may be seen of them, and the truth."""
    size = plan.recipe.batch_size
    epoch, done = divmod(step, plan.epoch_steps)
    while True:
        order = plan.draw_epoch(epoch)
        for first in range(done * size, len(order), size):
            samples = order[first : first + size]
            yield len(samples), *read(samples)
        epoch, done = epoch + 1, 0


def make_reader(folder: TensorFolder, reads: Reads, device: "torch.device") -> Read:
    """Return the function that reads batches: from the mapped folder on a CPU, else from a copy on the device."""
    import torch

    if device.type != "cpu":
        return make_device_reader(folder, reads, device)

    def read(samples: Integers) -> tuple[Any, Any]:
        observed, truth = read_samples(folder, samples, reads)
        return observed.each(torch.from_numpy), truth.each(torch.from_numpy)

    return read


def make_device_reader(folder: TensorFolder, reads: Reads, device: "torch.device") -> Read:
    """Return the function that reads batches from arrays that stand on a device as a whole."""
    import torch

    copied = DeviceFolder(folder, device)
    return lambda samples: read_on_device(copied, torch.from_numpy(samples).to(device), reads)
