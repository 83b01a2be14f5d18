"""Work on pieces of arrays in two threads: NumPy lets go of the interpreter while it computes."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

THREADS = 2
"""More gain little: between its computations every thread needs the interpreter, and several recordings are worked on
at once already."""

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def map_in_threads(work: Callable[[Piece], Result], pieces: Iterable[Piece]) -> list[Result]:
    """The results of a function for every piece, in the order of the pieces.

    Args:
        work: must not change what the work on another piece reads.
        pieces: small (bounds of a slice); all of them are listed before the first is begun.

    Raises:
        Exception: the first that `work` raises, in the order of the pieces.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, pieces))
