"""Batches for the training loop: step after step, on the device that the network is on."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from tracklake.training.data.batches import Integers
from tracklake.training.data.observed import part_batch
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Reads
from tracklake.training.models.inputs import NEAREST, read_samples
from tracklake.training.runs.config import Plan

if TYPE_CHECKING:
    import torch

Read = Callable[[Integers], tuple[Any, Any]]
"""Numbers of samples (B,) -> what may be seen of them and what came, tensors on the device."""
Batches = Iterator[tuple[int, Any, Any]]
"""How many samples, what may be seen of them, and what came."""


def read_batches(plan: Plan, read: Read, step: int) -> Batches:
    """How many samples a step takes, what may be seen of them and what came; from a step on, without end."""
    size = plan.recipe.batch_size
    epoch, place = divmod(step, plan.epoch_steps)
    while True:
        order = plan.draw_epoch(epoch)
        for first in range(place * size, len(order), size):
            samples = order[first : first + size]
            yield len(samples), *read(samples)
        epoch, place = epoch + 1, 0


def make_reader(plan: Plan) -> Read:
    """How batches come to the device."""
    import torch

    reads, folder, device = plan.entry.reads, plan.folder, plan.device
    if device.type != "cpu":
        return make_resident_reader(folder, reads, device)

    def read(samples: Integers) -> tuple[Any, Any]:
        observed, truth = read_samples(folder, samples, reads)
        return observed.each(torch.from_numpy), truth.each(torch.from_numpy)

    return read


def make_resident_reader(folder: TensorFolder, reads: Reads, device: "torch.device") -> Read:
    """Batches gathered on a device, from tensors that stand there as a whole."""
    import torch

    if reads == "grid":
        from tracklake.training.data.torch_batches import ResidentTensors

        grids = ResidentTensors(folder, device)
        return lambda samples: part_batch(grids.gather(torch.from_numpy(samples).to(device)))
    from tracklake.training.data.torch_nearest_vehicles import ResidentSurroundings

    scenes = ResidentSurroundings(folder, device, nearest=NEAREST)
    return lambda samples: scenes.gather(torch.from_numpy(samples).to(device))
