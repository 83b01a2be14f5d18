"""Type aliases of NumPy arrays, ragged ranges, and sums without rounding."""

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


SUM_BITS = 1126
"""Binary digits after the point of the whole numbers of `sum_exactly`."""
_BLOCK = 1 << 16


def sum_exactly(values: Floats) -> int:
    """Sum finite numbers without rounding: the sum * 2 ** SUM_BITS, a whole number.

    It does not depend on the order of the values, and sums of parts add up to that of the whole.
    """
    total = 0
    for start in range(0, len(values), _BLOCK):
        mantissa, exponent = np.frexp(values[start : start + _BLOCK])
        whole, shift = (mantissa * 2.0**53).astype(np.int64), exponent.astype(np.int64) + SUM_BITS - 53
        # Halves of so few numbers add up exactly as floats.
        for half, bits in ((whole >> 27, 27), (whole & ((1 << 27) - 1), 0)):
            sums = np.bincount(shift, half)
            total += sum(int(sums[at]) << (int(at) + bits) for at in np.flatnonzero(sums))
    return total


def divide_sum(total: int, count: int) -> float:
    """Divide a sum of `sum_exactly` by a number; the quotient is the nearest one."""
    return total / (count << SUM_BITS)
