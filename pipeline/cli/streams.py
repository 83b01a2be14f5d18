"""Standard streams that were closed, or whose disk is full."""

import os
import sys
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class StandardOutput(FileIO):
    """Standard output whose failures are messages, except that of a closed pipe."""

    def write(self, data: "ReadableBuffer", /) -> int:
        """Write bytes to the descriptor.

        Raises:
            FileAccessError: the disk is full or the stream is closed; nothing more is written to it.
        """
        try:
            return super().write(data)
        except BrokenPipeError:
            raise
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())  # or Python reports the same again at exit
            from tracklake.schemas.errors import FileAccessError  # imports Polars, which the help page need not

            raise FileAccessError(f"standard output: {error.strerror}") from error


def guard_streams() -> None:
    """Put streams where the caller closed standard ones (`>&-`), so that no other file gets their descriptors.

    Writing to standard output fails then, with a message; on standard error, messages are lost.
    """
    for number, stream in enumerate((sys.stdin, sys.stdout, sys.stderr)):
        if stream is None:
            os.dup2(os.open(os.devnull, os.O_RDWR if number == 2 else os.O_RDONLY), number)
    if sys.stderr is None:
        sys.stderr = open(2, "w")  # noqa: SIM115  (it stays open as long as the process)
    if os.name == "nt" and sys.stdout is not None and sys.stdout.isatty():
        return  # a console of Windows takes text, not bytes
    encoding, errors = ("utf-8", "strict") if sys.stdout is None else (sys.stdout.encoding, sys.stdout.errors)
    raw = BufferedWriter(StandardOutput(1, "w", closefd=False))
    sys.stdout = TextIOWrapper(raw, encoding=encoding, errors=errors, line_buffering=raw.isatty())
