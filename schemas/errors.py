"""The root of all errors that a user sees as a message."""

import errno
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tracklake.schemas.text import make_visible

UNREADABLE = (ArithmeticError, AttributeError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError)
"""Errors that readers of files raise on content that is damaged or of another kind."""
MORE_FILES = "Raise the limit of open files, for instance by `ulimit -n 1024`, and run the same command again."
"""Advice to a user whose process may open too few files at once."""


class TracklakeError(Exception):
    """Something the user can mend: the message says what, where, what was expected, what was found, and what to do.

    Commands print the message and exit with `exit_code`. Every other exception is a bug and keeps its traceback.
    Control characters in the message, which files may bring in, are escaped.
    """

    exit_code = 1

    def __init__(self, *arguments: object) -> None:
        """Make the texts among the arguments visible."""
        super().__init__(*(make_visible(each, keep="\n") if isinstance(each, str) else each for each in arguments))


class UsageError(TracklakeError):
    """A command or function was called with arguments or settings that cannot work."""

    exit_code = 2


class MissingExtraError(TracklakeError):
    """A package is needed that only an extra of tracklake installs; the message names the extra."""


class FileAccessError(TracklakeError):
    """A file or folder cannot be read or written, for instance because the disk is full or rights are missing."""


@contextmanager
def explain_file_errors(path: Path, advice: str = "") -> Iterator[None]:
    """Turn the operating system's errors on a file or folder into a message, with a sentence on what to do next.

    Raises:
        FileAccessError: the block raised an OSError, other than that of a closed pipe.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        advice = MORE_FILES if error.errno == errno.EMFILE else advice
        raise FileAccessError(f"{error.filename or path}: {reason}. {advice}".rstrip()) from error


def describe_error(error: BaseException) -> str:
    """Return what a user should read of an error that stopped a part of the work."""
    if isinstance(error, TracklakeError):
        return str(error)
    if isinstance(error, OSError):
        return f"{type(error).__name__}: {error}"
    return describe_bug(error)


def describe_bug(error: BaseException) -> str:
    """Return the traceback of a bug and the paragraph that asks for a report."""
    try:
        release = version("tracklake")
    except PackageNotFoundError:
        release = "unknown version"
    return (
        f"{''.join(traceback.format_exception(error))}\n"
        f"This is a bug in tracklake ({release}), not in your data or settings. Please report it on the issue tracker, "
        "with the traceback above, this version and the command you ran."
    )
