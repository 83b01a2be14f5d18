"""How work is shown while it lasts: flows report here, the command line decides whether and how to draw it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Reporter(Protocol):
    """Told what is going on."""

    def begin(self, stage: str, total: int) -> None:
        """A stage starts on so many recordings."""

    def advance(self, stage: str, title: str) -> None:
        """One of them is done."""


class Silent:
    """Shows nothing: for scripts, tests and workers."""

    def begin(self, stage: str, total: int) -> None:
        """Nothing."""

    def advance(self, stage: str, title: str) -> None:
        """Nothing."""


_current: Reporter = Silent()


def reporter() -> Reporter:
    """The reporter in use."""
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
