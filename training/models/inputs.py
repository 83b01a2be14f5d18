"""Samples as a model reads them: what may be seen, and the truth, from a mapped folder or on a device."""

from typing import Any

import numpy.typing as npt

from tracklake.training.data.gathers import Folder, gather_nearest, gather_samples
from tracklake.training.data.observed import Observed, ObservedScene, Truth, part_batch
from tracklake.training.models import Reads

NEAREST = 10
"""Most vehicles around the ego in a scene (Kim et al. 2020 train with the nearest ten)."""
Inputs = tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]


def read_samples(folder: Folder, samples: npt.ArrayLike, reads: Reads, *, nearest: int = NEAREST) -> Inputs:
    """Read samples by their numbers (B,) in any order, as arrays of the folder's kind and device.

    Of a mapped folder they are 0 <= number < S (else IndexError), of a device's copy int64 tensors there. A scene has
    V = 1 + nearest vehicles.
    """
    if reads == "grid":
        return part_batch(gather_samples(folder, samples))
    return gather_nearest(folder, samples, nearest=nearest)


def truth_of_ego(truth: Truth[Any]) -> Truth[Any]:
    """Return the truth of the samples themselves: of scenes, that of vehicle 0."""
    if truth.future.ndim == 3:
        return truth
    return Truth(truth.future[:, 0], truth.future_mask[:, 0], truth.lateral, truth.longitudinal)
