"""The log of a command: lines with times on stderr with --verbose, and in a file with --log-file."""

import logging
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import typer

LOG = logging.getLogger("tracklake")
"""Logger of the commands; it has handlers only while a command with --verbose or --log-file runs."""
LOG.addHandler(logging.NullHandler())
LOG.propagate = False
FORMAT = "%(asctime)s.%(msecs)03d %(levelname)-7s %(message)s"
TIME_FORMAT = "%Y-%m-%dT%H:%M:%S"


@dataclass
class LogOptions:
    """Options of the command that is called: where its log goes."""

    verbose: bool = False
    file: Path | None = None


chosen = LogOptions()
"""Options of this process's command."""


def choose_verbose(value: bool) -> None:
    """Remember --verbose, before or after the command's name."""
    chosen.verbose |= value


def choose_file(value: Path | None) -> None:
    """Remember --log-file, before or after the command's name."""
    chosen.file = value or chosen.file


def log_shown(level: int, text: str) -> None:
    """Log a message that the terminal shows, so that --verbose need not print it again."""
    LOG.log(level, "%s", text, extra={"shown": True})


@contextmanager
def open_log() -> Iterator[None]:
    """Log the block, as the options ask: what is called, and how it ends.

    Raises:
        LakeError: the file would lie in a lake.
        FileAccessError: the file cannot be written.
    """
    handlers: list[logging.Handler] = []
    if chosen.verbose:
        handlers.append(logging.StreamHandler(sys.stderr))
        handlers[0].addFilter(lambda record: not hasattr(record, "shown"))
    try:
        if chosen.file is not None:
            handlers.append(_open_file(chosen.file))
        for handler in handlers:
            handler.setFormatter(logging.Formatter(FORMAT, TIME_FORMAT))
            LOG.addHandler(handler)
        LOG.setLevel(logging.DEBUG if handlers else logging.CRITICAL + 1)
        with _log_end():
            yield
    finally:
        for handler in handlers:
            LOG.removeHandler(handler)
            handler.close()
        chosen.verbose, chosen.file = False, None


def _open_file(path: Path) -> logging.Handler:
    from tracklake.pipeline.lake import refuse_lake  # imports Polars, which the help page need not
    from tracklake.schemas.errors import explain_file_errors

    refuse_lake(path, "--log-file")
    with explain_file_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        return logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")


@contextmanager
def _log_end() -> Iterator[None]:
    """Log the call, and after the block its exit code and how long it took."""
    started, code = time.monotonic(), 1
    LOG.info("tracklake %s, Python %s, %s", version("tracklake"), platform.python_version(), platform.platform())
    LOG.info("called as %s", sys.argv)
    try:
        yield
        code = 0
    except typer.Exit as end:
        code = end.exit_code
        raise
    except typer.TyperException as misuse:
        code = misuse.exit_code
        log_shown(logging.ERROR, misuse.format_message())
        raise
    finally:
        LOG.info("ended with exit code %d after %.1f s", code, time.monotonic() - started)
