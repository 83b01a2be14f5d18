"""Type aliases of NumPy arrays, and ragged ranges."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]


def expand_ranges(first: Integers, count: Integers) -> tuple[Integers, Integers]:
    """Write (R,) ranges of `count` consecutive numbers out: the (N,) numbers, and which range each belongs to."""
    owner = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return np.arange(len(owner)) + np.repeat(first - before, count), owner


def find_run_starts(values: npt.NDArray[np.integer]) -> Integers:
    """Return the first row of each run of equal values."""
    return np.flatnonzero(np.diff(values, prepend=values[:1] - 1))


def bound_runs(values: npt.NDArray[np.integer]) -> tuple[Integers, Integers]:
    """Return the first and the last row of each row's run of equal values, (N,) each."""
    starts = find_run_starts(values)
    lengths = np.diff(starts, append=values.size)
    first = np.repeat(starts, lengths)
    return first, first + np.repeat(lengths, lengths) - 1
