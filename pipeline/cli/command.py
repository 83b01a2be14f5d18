"""The frame of every command: its terminal, its settings, its errors and exit codes."""

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tomllib import TOMLDecodeError
from typing import Any

import typer
from pydantic import ValidationError
from pydantic_settings import SettingsError

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.settings import Settings
from tracklake.schemas.errors import TracklakeError, UsageError, describe_bug
from tracklake.schemas.text import make_visible

DONE, FAILED, USAGE, REFUSED, INTERRUPTED = 0, 1, 2, 3, 130
"""Exit codes: done, failed, wrong usage, done but for refused recordings, and interrupted by Ctrl-C."""

DEBUG = "TRACKLAKE_DEBUG"
"""Environment variable: if set to 1, every error shows its traceback, as with the option --debug."""


@contextmanager
def command(*, quiet: bool = False, json: bool = False) -> Iterator[Terminal]:
    """Give a command its terminal, and turn errors into messages and exit codes.

    An error that the user can mend becomes one message. A bug shows its traceback and asks for a report.
    """
    terminal = Terminal(quiet=quiet, as_json=json)
    try:
        yield terminal
        sys.stdout.flush()  # what fails here would otherwise fail at exit
    except typer.TyperException as misuse:
        misuse.message = make_visible(misuse.message, keep="\n")
        raise
    except (typer.Exit, typer.Abort):
        raise
    except TracklakeError as error:
        _show_traceback_if_debugging(error)
        raise report_failure(terminal, str(error), error.exit_code) from None
    except ValidationError as error:
        _show_traceback_if_debugging(error)
        for problem in error.errors():
            where = ".".join(str(part) for part in problem["loc"])
            terminal.print_problem(
                f"setting {where}: {problem['msg']}; got {problem['input']!r}. See `tracklake.toml` and TRACKLAKE_*."
            )
        raise report_failure(terminal, "the settings are not valid", USAGE) from None
    except BrokenPipeError:
        # The reader of our output has closed it; without this, Python would report the broken pipe again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt as error:
        _show_traceback_if_debugging(error)
        raise report_failure(terminal, str(error) or "interrupted", INTERRUPTED) from None
    except Exception as bug:  # noqa: BLE001  (the outermost: nothing is hidden, the traceback is shown)
        if _is_interrupt(bug):
            _show_traceback_if_debugging(bug)
            raise report_failure(terminal, "interrupted", INTERRUPTED) from None
        raise _report_bug(terminal, bug) from None


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether Ctrl-C caused an error, as which DuckDB and pydantic raise it."""
    return error is not None and (isinstance(error, KeyboardInterrupt) or _is_interrupt(error.__cause__))


def _report_bug(terminal: Terminal, bug: Exception) -> typer.Exit:
    terminal.print_bug(describe_bug(bug))
    terminal.print_json({"error": f"{type(bug).__name__}: {bug}", "bug": True})
    return typer.Exit(FAILED)


def _show_traceback_if_debugging(error: BaseException) -> None:
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        sys.stderr.write(make_visible("".join(traceback.format_exception(error)), keep="\n"))


def report_failure(terminal: Terminal, message: str, code: int = FAILED) -> typer.Exit:
    """Print an error for people and for programs, and return the exit to raise."""
    terminal.print_problem(message)
    terminal.print_json({"error": message})
    return typer.Exit(code)


def read_settings(
    *,
    lake: Path | None = None,
    workers: int | None = None,
    protocol: str | None = None,
    columns: Path | None = None,
    recording: str | None = None,
) -> Settings:
    """Read the settings from file and environment, with the given flags on top.

    Raises:
        UsageError: `tracklake.toml` or an environment variable cannot be read.
    """
    flags: dict[str, Any] = {"lake": lake, "workers": workers, "protocol": protocol}
    # Absolute, so that a worker in another folder finds the same file.
    flags |= {"columns": None if columns is None else columns.absolute(), "recording": recording}
    try:
        return Settings(**{name: value for name, value in flags.items() if value is not None})
    except (TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise UsageError(f"tracklake.toml: {error}") from error
    except SettingsError as error:
        raise UsageError(f"environment: {error}; expected JSON in that TRACKLAKE_* variable") from error
