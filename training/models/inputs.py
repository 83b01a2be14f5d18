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
Inputs = tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]


def read_samples(folder: TensorFolder, samples: npt.ArrayLike, reads: Reads, *, nearest: int = NEAREST) -> Inputs:
    """Read samples by their numbers (B,) in any order, 0 <= number < S (else IndexError), as NumPy arrays.

    A scene has V = 1 + nearest vehicles.
    """
    return part_batch(folder.gather(samples)) if reads == "grid" else gather_nearest(folder, samples, nearest=nearest)


def read_on_device(folder: DeviceFolder, samples: Array, reads: Reads) -> Inputs:
    """Read samples by their numbers (B,) int64 on a device, as tensors there; otherwise as `read_samples`."""
    return part_batch(gather_samples(folder, samples)) if reads == "grid" else gather_vehicles(folder, samples, NEAREST)


def truth_of_ego(truth: Truth[Any]) -> Truth[Any]:
    """Return the truth of the samples themselves: of scenes, that of vehicle 0."""
    if truth.future.ndim == 3:
        return truth
    return Truth(truth.future[:, 0], truth.future_mask[:, 0], truth.lateral, truth.longitudinal)
