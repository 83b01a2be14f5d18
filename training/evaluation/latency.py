"""How long a model takes to predict one moment."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.guard import choose_moments, samples_of_scene
from tracklake.training.models import Predictor, Reads
from tracklake.training.models.inputs import NEAREST, read_samples

MOMENTS = 20
"""Of which the median is taken."""


@dataclass(frozen=True)
class Latency:
    """How long one moment takes, on one thread.

    Args:
        latency_ms: median time to predict all samples of a moment at once; reading them is not counted.
        latency_samples: median number of them.
    """

    latency_ms: float
    latency_samples: float


def measure_latency(
    predictor: Predictor, folder: TensorFolder, part: str, *, reads: Reads = "grid", nearest: int = NEAREST
) -> Latency:
    """Predict some moments of a part, evenly spread over it, each by itself. The first one is predicted twice.

    Raises:
        ValueError: the part has no samples.
    """
    scenes = choose_moments(folder, part, MOMENTS)
    if len(scenes) == 0:
        raise ValueError(f"{folder.path}: no moment of `{part}` to measure")
    spent, counts = [], []
    with _one_thread():
        for number, scene in enumerate(scenes):
            samples = samples_of_scene(folder, scene)
            observed, _ = read_samples(folder, samples, reads, nearest=nearest)
            if number == 0:
                predictor.predict(observed)  # the first call prepares what later ones use
            start = time.perf_counter()
            predictor.predict(observed)
            spent.append(time.perf_counter() - start)
            counts.append(len(samples))
    return Latency(latency_ms=1000.0 * float(np.median(spent)), latency_samples=float(np.median(counts)))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch computes on one thread meanwhile, where it is in use at all."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
