"""Progress of the work: flows report it here, and the command line decides whether and how to draw it."""

from collections.abc import Iterator
from contextlib import contextmanager


class Reporter:
    """Receives reports of what is going on, and shows none: for scripts, tests and workers."""

    def begin(self, stage: str, total: int) -> None:
        """Report that a stage starts on a number of recordings."""

    def advance(self, stage: str, title: str) -> None:
        """Report that one of them is done."""


_current = Reporter()


def reporter() -> Reporter:
    """Return the reporter in use."""
    return _current


@contextmanager
def reporting_to(chosen: Reporter) -> Iterator[None]:
    """Use a reporter for the length of a block."""
    global _current
    before, _current = _current, chosen
    try:
        yield
    finally:
        _current = before
