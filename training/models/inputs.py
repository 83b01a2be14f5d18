"""Samples as a model reads them: what may be seen, and the truth beside it."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.training.data.observed import Observed, ObservedScene, Truth, part_batch
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import Reads

NEAREST = 10
"""Vehicles around the ego in a scene, at most (Kim et al. 2020: trained with the nearest ten)."""


def read_samples(
    folder: TensorFolder, samples: npt.ArrayLike, reads: Reads, *, nearest: int = NEAREST
) -> tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]:
    """Samples by their numbers (B,), in any order, as NumPy arrays.

    Args:
        folder: where from.
        samples: numbers of samples.
        reads: `grid` or `scene`.
        nearest: of scenes: how many vehicles around the ego at most; V = 1 + nearest.

    Raises:
        IndexError: a number below 0, or not below S.
    """
    if reads == "grid":
        return part_batch(folder.gather(samples))
    from tracklake.training.data.nearest_vehicles import gather_surroundings

    return gather_surroundings(folder, np.asarray(samples, dtype=np.int64), nearest=nearest)


def truth_of_ego(truth: Truth[Any]) -> Truth[Any]:
    """The truth of the samples themselves: of scenes, that of vehicle 0."""
    if truth.future.ndim == 3:
        return truth
    return Truth(truth.future[:, 0], truth.future_mask[:, 0], truth.lateral, truth.longitudinal)
