"""Numbers of a long subset that are kept in files while a stage works on it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from tracklake.pipeline.lake.files import STAGING
from tracklake.pipeline.transforms.number_store import MakeStore, NumberStore
from tracklake.schemas.arrays import Integers


class FileStore(NumberStore):
    """Numbers in a file; see `NumberStore`. Only what is asked for is in memory."""

    def __init__(self, file: Path, dtype: str) -> None:
        """Make an empty file of numbers."""
        self._file, self._dtype, self._count = file, np.dtype(dtype), 0
        file.touch()

    @property
    def size(self) -> int:
        """How many there are."""
        return self._count

    def append(self, values: np.ndarray) -> None:
        """Add numbers at the end."""
        with self._file.open("ab") as file:
            np.ascontiguousarray(values, self._dtype).tofile(file)
        self._count += len(values)

    def __getitem__(self, places: slice | Integers) -> np.ndarray:
        """Return the numbers at some places."""
        if isinstance(places, slice):
            first, end, _ = places.indices(self._count)
            return np.fromfile(self._file, self._dtype, max(end - first, 0), offset=first * self._dtype.itemsize)
        return np.array(self._map("r")[places]) if self._count else np.empty(0, self._dtype)

    def __setitem__(self, places: slice | Integers, values: np.ndarray) -> None:
        """Replace the numbers at some places."""
        if self._count:
            self._map("r+")[places] = values

    def _map(self, mode: Literal["r", "r+"]) -> np.ndarray:
        """Map the file for one access: pages that stay mapped count as this process's memory."""
        return np.memmap(self._file, self._dtype, mode=mode, shape=(self._count,))


@contextmanager
def open_scratch(root: Path) -> Iterator[MakeStore]:
    """Yield a function that makes stores of a dtype in the lake's staging folder; they are deleted at the end."""
    (root / STAGING).mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=root / STAGING, prefix="numbers-") as folder:
        made = iter(range(10**6))
        yield lambda dtype: FileStore(Path(folder) / str(next(made)), dtype)
