"""Work on pieces of arrays in two threads; NumPy releases the interpreter lock while it computes."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

THREADS = 2
"""Threads per call; more gain little, since each needs the interpreter between computations and several recordings are
processed at once."""
Piece = TypeVar("Piece")
Result = TypeVar("Result")


def map_in_threads(work: Callable[[Piece], Result], pieces: Iterable[Piece]) -> list[Result]:
    """Apply a function to pieces, such as bounds of slices, and return its results in their order."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, pieces))
