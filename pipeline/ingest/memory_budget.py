"""Room in memory for what is worked on at once: large recordings wait for one another, small ones do not."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class MemoryBudget:
    """So many bytes, of which threads take some and give them back.

    Args:
        size: in bytes.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._free = size
        self._given_back = threading.Condition()

    @contextmanager
    def reserve(self, size: int) -> Iterator[None]:
        """Wait until so many bytes are free, and take them for the length of a block.

        What is larger than the whole budget takes all of it, and so is worked on alone.

        Args:
            size: in bytes.
        """
        size = min(size, self._size)
        with self._given_back:
            self._given_back.wait_for(lambda: self._free >= size)
            self._free -= size
        try:
            yield
        finally:
            with self._given_back:
                self._free += size
                self._given_back.notify_all()
