"""Numbers of all points of a subset, in memory or, where the subset is long, in files; their median."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

import numpy as np

from tracklake.schemas.arrays import Floats, Integers

KEY_BITS = 16
"""Binary digits of a number that one pass over all of them counts."""


class NumberStore(ABC):
    """Numbers that are appended part by part, and then read and replaced by their places."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many there are."""

    @abstractmethod
    def append(self, values: np.ndarray) -> None:
        """Add numbers at the end."""

    @abstractmethod
    def __getitem__(self, places: slice | Integers) -> np.ndarray:
        """Return a copy of the numbers at some places; a slice has no steps."""

    @abstractmethod
    def __setitem__(self, places: slice | Integers, values: np.ndarray) -> None:
        """Replace the numbers at some places."""


class MemoryStore(NumberStore):
    """Numbers in memory; see `NumberStore`."""

    def __init__(self, dtype: str) -> None:
        """Hold no numbers yet."""
        self._values = np.empty(0, dtype)

    @property
    def size(self) -> int:
        """How many there are."""
        return len(self._values)

    def append(self, values: np.ndarray) -> None:
        """Add numbers at the end."""
        added = values.astype(self._values.dtype)
        self._values = np.concatenate([self._values, added]) if self.size else added

    def __getitem__(self, places: slice | Integers) -> np.ndarray:
        """Return a copy of the numbers at some places."""
        found: np.ndarray = self._values[places]
        return found.copy() if isinstance(places, slice) else found

    def __setitem__(self, places: slice | Integers, values: np.ndarray) -> None:
        """Replace the numbers at some places."""
        self._values[places] = values


MakeStore = Callable[[str], NumberStore]
"""Function from NumPy's name of a dtype to an empty store."""


def find_median(values: NumberStore, at_once: int) -> float:
    """Return the median of finite floats as `numpy.median` does, with so many of them in memory at once."""
    return float(np.mean(find_middle(values, at_once)))


def find_middle(values: NumberStore, at_once: int) -> Floats:
    """Return the one or two numbers in the middle of finite floats in order, (1,) or (2,).

    Where they are not all in memory they are found digit by digit: each pass counts those that begin with the digits
    known so far.
    """
    middle = sorted({(values.size - 1) // 2, values.size // 2})
    if values.size <= at_once:
        return np.partition(values[:], middle)[middle].astype(np.float64)
    return np.array([_select(values, rank, at_once) for rank in middle])


def _select(values: NumberStore, rank: int, at_once: int) -> float:
    """Return the number with so many smaller ones before it in order."""
    known, digits = np.uint64(0), np.uint64(KEY_BITS)
    for shift in map(np.uint64, range(64 - KEY_BITS, -1, -KEY_BITS)):
        counts: Integers = np.zeros(1 << KEY_BITS, np.int64)
        for keys in _list_keys(values, at_once):
            leading = keys >> shift
            digit = leading[leading >> digits == known] & np.uint64((1 << KEY_BITS) - 1)
            counts += np.bincount(digit.astype(np.int64), minlength=len(counts))
        up_to = np.cumsum(counts)
        place = int(np.searchsorted(up_to, rank, side="right"))
        rank -= int(up_to[place] - counts[place])
        known = (known << digits) | np.uint64(place)
    bits = known ^ np.uint64(1 << 63) if known >> np.uint64(63) else ~known
    return float(np.array([bits], np.uint64).view(np.float64)[0])


def _list_keys(values: NumberStore, at_once: int) -> Iterator[np.ndarray]:
    """Yield whole numbers in the same order as the floats, part by part."""
    for first in range(0, values.size, at_once):
        part: Floats = values[first : first + at_once].astype(np.float64)
        bits = part.view(np.uint64)
        yield np.where(bits >> np.uint64(63), ~bits, bits | np.uint64(1 << 63))
