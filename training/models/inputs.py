"""Samples as a model reads them: what may be seen, and the truth, from a mapped folder or on a device."""

from typing import Any

import numpy.typing as npt

from tracklake.training.data.batches import Array
from tracklake.training.data.gathers import gather_nearest, gather_samples, gather_vehicles
from tracklake.training.data.observed import Observed, ObservedScene, Truth, part_batch
from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder
from tracklake.training.models import Reads

NEAREST = 10
"""Most vehicles around the ego in a scene (Kim et al. 2020 train with the nearest ten)."""


def read_samples(
    folder: TensorFolder, samples: npt.ArrayLike, reads: Reads, *, nearest: int = NEAREST
) -> tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]:
    """Read samples by their numbers (B,), in any order, as NumPy arrays.

    Args:
        folder: tensors to read from.
        samples: numbers of samples.
        reads: `grid` or `scene`.
        nearest: most vehicles around the ego of a scene; V = 1 + nearest.

    Raises:
        IndexError: a number is below 0 or not below S.
    """
    if reads == "grid":
        return part_batch(folder.gather(samples))
    return gather_nearest(folder, samples, nearest=nearest)


def read_on_device(
    folder: DeviceFolder, samples: Array, reads: Reads
) -> tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]:
    """Read samples by their numbers (B,) int64 on a device, as tensors there; otherwise as `read_samples`."""
    if reads == "grid":
        return part_batch(gather_samples(folder, samples))
    return gather_vehicles(folder, samples, NEAREST)


def truth_of_ego(truth: Truth[Any]) -> Truth[Any]:
    """Return the truth of the samples themselves: of scenes, that of vehicle 0."""
    if truth.future.ndim == 3:
        return truth
    return Truth(truth.future[:, 0], truth.future_mask[:, 0], truth.lateral, truth.longitudinal)
