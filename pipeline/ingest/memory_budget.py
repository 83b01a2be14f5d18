"""A budget of memory for recordings that are read at once: large ones wait for one another, small ones do not."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class MemoryBudget:
    """A number of bytes that threads reserve and release, of a budget of `size` bytes."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._free = size
        self._released = threading.Condition()

    @contextmanager
    def reserve(self, size: int) -> Iterator[None]:
        """Wait until enough bytes are free, and reserve them for the length of a block.

        A size larger than the whole budget reserves all of it, so that its recording is read alone.
        """
        size = min(size, self._size)
        with self._released:
            self._released.wait_for(lambda: self._free >= size)
            self._free -= size
        try:
            yield
        finally:
            with self._released:
                self._free += size
                self._released.notify_all()
