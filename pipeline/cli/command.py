"""The frame of every command: its terminal, its settings, its errors and exit codes."""

import logging
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import typer

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.logs import LOG, open_log
from tracklake.pipeline.lake import follow_move
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.lake.working_copy import locate_origin, refresh_copy
from tracklake.pipeline.settings import DEBUG, Settings, find_unknown_variables, read_sources
from tracklake.schemas.errors import TracklakeError, UsageError, describe_bug
from tracklake.schemas.text import make_visible

DONE, FAILED, USAGE, REFUSED, GATE_FAILED, INTERRUPTED = 0, 1, 2, 3, 4, 130
"""Exit codes: done, failed, wrong usage, done but for refused recordings, a gate not passed, interrupted by Ctrl-C."""


@contextmanager
def command(*, quiet: bool = False, json: bool = False) -> Iterator[Terminal]:
    """Give a command its terminal and its log, and turn errors into messages and exit codes.

    An error that the user can mend becomes one message. A bug shows its traceback and asks for a report.
    """
    terminal = Terminal(quiet=quiet, as_json=json)
    with ExitStack() as log, _explain_errors(terminal):
        log.enter_context(open_log())
        for message in () if quiet else find_unknown_variables():
            terminal.print_problem(message, label="warning")
        yield terminal
        sys.stdout.flush()  # what fails here would otherwise fail at exit


@contextmanager
def _explain_errors(terminal: Terminal) -> Iterator[None]:
    """Turn the errors of a command into messages and exit codes."""
    try:
        yield
    except typer.TyperException as misuse:
        misuse.message = make_visible(misuse.message, keep="\n")
        raise
    except (typer.Exit, typer.Abort):
        raise
    except TracklakeError as error:
        _show_traceback_if_debugging(error)
        raise report_failure(terminal, str(error), error.exit_code) from None
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
    own = sys.modules.get("tracklake.training.models.own")  # None: no model of the user's own is in use
    files: set[str] = set() if own is None else {file for file, _ in own.OWN_FILES.values()}
    frames = reversed(traceback.extract_tb(bug.__traceback__))
    place = next((f"{frame.filename}, line {frame.lineno}" for frame in frames if frame.filename in files), None)
    if place is not None:
        _show_traceback_if_debugging(bug)
        advice = "This is your own model's code; `tracklake --debug` shows the traceback."
        return report_failure(terminal, f"{place}: {type(bug).__name__}: {bug}. {advice}")
    terminal.print_bug(describe_bug(bug))
    terminal.print_json({"error": f"{type(bug).__name__}: {bug}", "bug": True})
    return typer.Exit(FAILED)


def _show_traceback_if_debugging(error: BaseException) -> None:
    LOG.debug("the error was raised here", exc_info=error, extra={"shown": True})
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
    in_folder: bool = True,
) -> Settings:
    """Read the settings from files and environment, flags on top; a moved lake gets its catalog again.

    The folder of what this machine holds of a lake on an object store stands for its address.

    Args:
        lake: the lake; this and the next ones are options of the command line.
        workers: recordings worked on at once.
        protocol: name of the protocol.
        columns: mapping of columns.
        recording: name of the recording.
        in_folder: whether the lake must be in a folder; of one on an object store, its copy is brought up to date.

    Raises:
        SettingError: a setting is unknown, out of its bounds or cannot be read.
        LakeError: no lake is at the address.
    """
    flags: dict[str, Any] = {"lake": lake, "workers": workers, "protocol": protocol}
    # Absolute, so that a worker in another folder finds the same file.
    flags |= {"columns": None if columns is None else columns.absolute(), "recording": recording}
    given = {name: value for name, value in flags.items() if value is not None}
    settings = Settings(**given)
    for source in read_sources(given) if LOG.isEnabledFor(logging.DEBUG) else ():
        if source.values:
            LOG.debug("settings from %s: %s", source.name, source.values)
    origin = find_origin(settings.lake)
    if origin is not None:  # the copy that commands name: what it lacks is at the address
        settings = settings.model_copy(update={"lake": Path(origin.address), "cache": origin.cache.parent})
    if in_folder and find_address(settings.lake) is not None:
        return settings.model_copy(update={"lake": find_folder(settings.lake, settings)})
    follow_move(settings.lake)
    return settings


def find_folder(lake: Path, settings: Settings) -> Path:
    """Return the folder of a lake to read; of one on an object store that of its copy, which is brought up to date.

    Raises:
        LakeError: no lake is at the address.
    """
    if find_address(lake) is None:
        return lake
    origin = locate_origin(lake, settings.cache, settings.cache_gb)
    assert origin is not None
    return refresh_copy(origin)


def refuse_address(settings: Settings) -> Path:
    """Return the folder of a lake.

    Raises:
        UsageError: it is on an object store.
    """
    address = find_address(settings.lake)
    if address is not None:
        raise UsageError(
            f"{address}: this command works on a lake in a folder. Copy the lake to one by `tracklake fetch {address} "
            "--lake DIR`, name it by --lake DIR here, and send the result back by `tracklake publish store`."
        )
    return settings.lake
