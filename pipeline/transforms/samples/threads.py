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
    """Apply a function to every piece and return the results in the order of the pieces.

    Args:
        work: function of a piece; it must not change what other calls read.
        pieces: small values such as the bounds of a slice.

    Raises:
        Exception: the first exception of `work`, in the order of the pieces.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, pieces))
