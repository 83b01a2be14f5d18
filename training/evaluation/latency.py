"""Time a model takes to predict one moment."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.guard import choose_moments, find_scene_samples
from tracklake.training.models import Predictor, Reads
from tracklake.training.models.inputs import NEAREST, read_samples

MOMENTS = 20
"""Number of moments that the median is taken of."""


@dataclass(frozen=True)
class Latency:
    """Time per moment on one thread.

    Args:
        latency_ms: median time to predict all samples of a moment at once, without reading them, ms.
        latency_samples: median number of these samples.
    """

    latency_ms: float
    latency_samples: float


def measure_latency(
    predictor: Predictor, folder: TensorFolder, part: str, *, reads: Reads = "grid", nearest: int = NEAREST
) -> Latency:
    """Predict some moments of a part, evenly spread over it, each by itself; the part has samples."""
    spent, counts = [], []
    with _use_one_thread():
        for number, scene in enumerate(choose_moments(folder, part, MOMENTS)):
            samples = find_scene_samples(folder, scene)
            observed, _ = read_samples(folder, samples, reads, nearest=nearest)
            if number == 0:
                predictor.predict(observed)  # the first call prepares what later ones use
            start = time.perf_counter()
            predictor.predict(observed)
            spent.append(time.perf_counter() - start)
            counts.append(len(samples))
    return Latency(latency_ms=1000.0 * float(np.median(spent)), latency_samples=float(np.median(counts)))


@contextmanager
def _use_one_thread() -> Iterator[None]:
    """Let torch compute on one thread for a while, if it is in use at all."""
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
