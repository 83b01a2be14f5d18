"""Runs of consecutive rows, gathered as they lie: one copy per run instead of one per position.

Two NumPy facts carry the speed. A position's two numbers are copied as one element (`packed`); and a view in which
every element is a whole run of T positions, each beginning one position after the last, makes one indexed copy of what
would be T.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.training.data.batches import Flags, Floats, Integers

Rows = npt.NDArray[np.intp]


class Windows:
    """Positions of rows start, start + 1, ... start + T - 1, for any number of starts at once.

    Args:
        positions: (N, 2) contiguous, of any dtype.
        length: T.
    """

    def __init__(self, positions: npt.NDArray[Any], length: int) -> None:
        self._dtype, self._length = positions.dtype, length
        self._packed = positions.view(np.dtype(f"u{2 * positions.itemsize}")).reshape(-1)
        item = self._packed.itemsize
        count = max(0, len(positions) - length + 1)
        self._runs: npt.NDArray[np.void] = np.ndarray(
            (count,), np.dtype((np.void, item * length)), buffer=self._packed, strides=(item,)
        )

    def take(self, start: Rows, low: Rows, high: Rows, cut: Flags) -> npt.NDArray[Any]:
        """(M, T, 2) positions of rows start to start + T - 1 as they are stored.

        Args:
            start: (M,)
            low: (M,) the first row that may be read; rows before it read as this one.
            high: (M,) the last row that may be read; rows after it read as this one.
            cut: (M,) whether `low` or `high` matters at all.
        """
        last = len(self._runs) - 1
        if last < 0:  # fewer rows than a window has
            taken = np.empty((len(start), self._length), self._packed.dtype)
            which = np.arange(len(start))
        else:
            # Only those that are cut can begin before the first row or end after the last one.
            runs = self._runs[np.minimum(np.maximum(start, 0), last)]
            taken = runs.view(self._packed.dtype).reshape(len(start), self._length)
            which = np.flatnonzero(cut)
        if len(which):
            rows = start[which, None] + np.arange(self._length)
            np.maximum(rows, low[which, None], out=rows)
            np.minimum(rows, high[which, None], out=rows)
            taken[which] = self._packed[rows]
        positions: npt.NDArray[Any] = taken.view(self._dtype).reshape(len(start), self._length, 2)
        return positions


class Masks:
    """Which of T ticks are known, by how many are.

    Args:
        length: T.
        from_end: whether it is the last ones that are known (a history), or the first ones (a future).
    """

    def __init__(self, length: int, *, from_end: bool) -> None:
        table = np.tri(length + 1, length, -1, dtype=np.bool_)
        table = np.ascontiguousarray(table[:, ::-1] if from_end else table)
        self._length = length
        self._rows = table.view(np.dtype((np.void, length))).reshape(-1)

    def take(self, known: npt.NDArray[np.uint8]) -> Flags:
        """(M, T) of numbers of known ticks (M,)."""
        flags: Flags = self._rows[known.astype(np.intp)].view(np.bool_).reshape(len(known), self._length)
        return flags


def subtract(positions: npt.NDArray[Any], origin: npt.NDArray[Any], step_m: tuple[float, float] | None) -> Floats:
    """Positions (M, T, 2) relative to origins (M, 2), in m, float32.

    Args:
        positions: as stored; float32 ones are changed in place.
        origin: as stored.
        step_m: of int16 storage; None for float32.
    """
    rows, length, _ = positions.shape
    if step_m is None:
        # A complex number is a pair: one subtraction for both axes, component by component.
        pairs = positions.view(np.complex64).reshape(rows, length)
        pairs -= np.ascontiguousarray(origin).view(np.complex64).reshape(rows, 1)
        return positions
    relative = positions.reshape(rows, 2 * length).astype(np.float32)  # differences of int16 would overflow
    relative -= np.tile(origin.astype(np.float32), (1, length))
    relative *= np.tile(np.asarray(step_m, dtype=np.float32), length)
    return relative.reshape(rows, length, 2)


def place(positions: npt.NDArray[Any], centre_m: npt.NDArray[np.float64], step_m: tuple[float, float] | None) -> Floats:
    """Stored positions (M, T, 2) on the carriageway, in m, float32.

    Args:
        positions: as stored.
        centre_m: (M, 2) what int16 steps count from.
        step_m: of int16 storage; None for float32, which is returned as it is.
    """
    if step_m is None:
        return positions
    placed: Floats = (centre_m[:, None, :] + positions * np.asarray(step_m)).astype(np.float32)
    return placed


def check_numbers(numbers: npt.ArrayLike, count: int, what: str) -> Integers:
    """Numbers (B,) of samples or scenes, int64.

    Raises:
        IndexError: one is not 0 to count - 1; NumPy would count a negative one from the end.
    """
    checked = np.asarray(numbers, dtype=np.int64)
    if len(checked) and (checked.min() < 0 or checked.max() >= count):
        raise IndexError(f"{what}s are numbered 0 to {count - 1}, got {checked.min()} to {checked.max()}")
    return checked


def spread(offset: Integers, numbers: Integers) -> tuple[Integers, Integers]:
    """The members of ragged groups, and which group each belongs to.

    Args:
        offset: members of group g are offset[g] to offset[g + 1] - 1.
        numbers: (B,) groups.

    Returns:
        (K,) members, in the order of `numbers`; and (K,) positions in `numbers`, increasing.
    """
    first = offset[numbers]
    counts = offset[numbers + 1] - first
    group = np.repeat(np.arange(len(numbers)), counts)
    before = np.cumsum(counts) - counts
    return np.arange(len(group)) + np.repeat(first - before, counts), group
