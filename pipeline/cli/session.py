"""What every command does the same way: settings, doing what is not done, saying what came of it, exit codes.

Like the commands, it imports heavy libraries where they are used.
"""

import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tomllib import TOMLDecodeError
from typing import TYPE_CHECKING, Any

import typer

from tracklake.schemas.errors import TracklakeError

if TYPE_CHECKING:
    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.ingest.discovery import Discovery
    from tracklake.pipeline.orchestration.run_plan import RunRequest, RunResult
    from tracklake.pipeline.settings import Settings

DONE, FAILED, USAGE, REFUSED = 0, 1, 2, 3


DEBUG = "TRACKLAKE_DEBUG"
"""Variable of the environment: where it is set, every error shows its traceback, as the option --debug has it."""


@contextmanager
def command(*, quiet: bool = False, json: bool = False) -> Iterator["Terminal"]:
    """Give a command its terminal, and turn errors into messages and exit codes.

    An error that the user can mend becomes one message. A bug shows its traceback and asks for a report.
    """
    from pydantic import ValidationError

    from tracklake.pipeline.cli.console import Terminal
    from tracklake.schemas.errors import describe_bug

    terminal = Terminal(quiet=quiet, as_json=json)
    try:
        yield terminal
    except (typer.Exit, typer.Abort, typer.TyperException):
        raise
    except TracklakeError as error:
        _show_traceback_if_debugging(error)
        raise failure(terminal, str(error), error.exit_code) from None
    except ValidationError as error:
        _show_traceback_if_debugging(error)
        for problem in error.errors():
            where = ".".join(str(part) for part in problem["loc"])
            terminal.complain(
                f"setting {where}: {problem['msg']}; got {problem['input']!r}. See `tracklake.toml` and TRACKLAKE_*."
            )
        raise failure(terminal, "the settings are not valid", USAGE) from None
    except BrokenPipeError:
        # The reader of our output has closed it; without this, Python would report the broken pipe again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt as error:
        _show_traceback_if_debugging(error)
        message = "interrupted; what was committed stays; run the same command again"
        raise failure(terminal, message) from None
    except Exception as bug:  # noqa: BLE001  (the outermost: nothing is hidden, the traceback is shown)
        terminal.err.print(describe_bug(bug), markup=False)
        terminal.give({"error": f"{type(bug).__name__}: {bug}", "bug": True})
        raise typer.Exit(FAILED) from None


def _show_traceback_if_debugging(error: BaseException) -> None:
    if os.environ.get(DEBUG, "0") not in ("", "0"):
        sys.stderr.write("".join(traceback.format_exception(error)))


def failure(terminal: "Terminal", message: str, code: int = FAILED) -> typer.Exit:
    """Print what went wrong, for people and for programs, and return the exit to raise."""
    terminal.complain(message)
    terminal.give({"error": message})
    return typer.Exit(code)


def read_settings(*, lake: Path | None = None, workers: int | None = None, protocol: str | None = None) -> "Settings":
    """Read the settings, with the flags that were given on top.

    Raises:
        UsageError: tracklake.toml or a variable of the environment cannot be read.
    """
    from pydantic_settings import SettingsError

    from tracklake.pipeline.settings import Settings
    from tracklake.schemas.errors import UsageError

    flags: dict[str, Any] = {"lake": lake, "workers": workers, "protocol": protocol}
    try:
        return Settings(**{name: value for name, value in flags.items() if value is not None})
    except (TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise UsageError(f"tracklake.toml: {error}") from error
    except SettingsError as error:
        raise UsageError(f"environment: {error}. See TRACKLAKE_* in the documentation of the settings.") from error


def carry_out(
    terminal: "Terminal",
    settings: "Settings",
    steps: tuple[str, ...],
    source: str | None = None,
    dataset: str | None = None,
    *,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
    check: "Callable[[Path, Discovery], None] | None" = None,
) -> "RunResult":
    """Run every requested step whose outputs are missing or stale; Prefect is imported only where there is one.

    `check` gets the lake and the source's files, and may refuse them.
    """
    from tracklake.pipeline.lake import load, refuse_foreign, refuse_if_busy
    from tracklake.pipeline.orchestration.run_plan import RunRequest, conclude_idle, plan_run
    from tracklake.pipeline.sources import SourceError
    from tracklake.schemas.columns import DATASETS

    if dataset not in (None, *DATASETS):
        raise typer.BadParameter(f"--dataset is {' or '.join(DATASETS)}; got {dataset!r}")
    plain = settings.model_dump(mode="json", exclude_unset=True)
    # Absolute, so that a worker in another folder finds the same places.
    where = None if source is None else str(Path(source).absolute())
    order = RunRequest(str(settings.lake.absolute()), steps, where, dataset, plain, replace, prune, rebuild)
    order.check()
    refuse_foreign(order.root, rebuild=rebuild)
    if prune and source is not None and Path(source).is_file():
        raise typer.BadParameter(f"--prune compares a folder with the lake; {source} is a file")
    try:
        discovery = _survey_while_importing(order) if source is not None else None
    except SourceError as nothing:
        raise SourceError(f"{nothing}{_prune_nothing(order.root)}" if prune else str(nothing)) from None
    if discovery is None:
        load(order.root)  # raises where there is no lake to work on
    if discovery is not None and not discovery.units:
        # Nothing can come of it, so no lake is made for it either.
        for message in discovery.refusals:
            terminal.complain(message, label="refused")
        if prune:
            terminal.complain(_prune_nothing(order.root).strip(), label="refused")
        terminal.give({"refused": list(discovery.refusals)})
        raise typer.Exit(FAILED)
    if check is not None and discovery is not None:
        check(settings.lake, discovery)
    plan = plan_run(order, discovery)
    if plan.is_idle:
        terminal.say("nothing to do: the lake is up to date", style="dim")
        return conclude_idle(order, plan)
    refuse_if_busy(order.root, rebuild=rebuild)
    with terminal.working():
        from tracklake.pipeline.orchestration.flows import execute

        return execute(order, plan)


SOON_S = 0.3


def _survey_while_importing(order: "RunRequest") -> "Discovery":
    """Find the raw files; Prefect is imported meanwhile where that takes longer than looking up known hashes.

    Files that must be hashed are new, so there will be work for it.
    """
    from concurrent.futures import ThreadPoolExecutor
    from contextlib import suppress
    from importlib import import_module

    from tracklake.pipeline.orchestration.run_plan import survey_source

    with ThreadPoolExecutor(max_workers=1) as thread:
        discovery = thread.submit(survey_source, order)
        with suppress(TimeoutError):
            return discovery.result(timeout=SOON_S)
        import_module("tracklake.pipeline.orchestration.flows")
        return discovery.result()


def _prune_nothing(lake: Path) -> str:
    """To follow the message about a source in which there is nothing to use."""
    import shlex

    return (
        "\n--prune removed nothing: what holds no raw files may be a mistyped folder, or a disk that is not there. To "
        f"remove a recording by its name: `tracklake remove RECORDING --lake {shlex.quote(str(lake))}`."
    )


def conclude(
    terminal: "Terminal",
    settings: "Settings",
    outcome: "RunResult",
    *,
    headline: bool = True,
    assess: bool = False,
    compare: Path | None = None,
) -> None:
    """Say what came of an order, where asked to how good repair is, or what differs from a lake to compare with.

    Exits with the code that fits.
    """
    import json
    from dataclasses import asdict

    from tracklake.pipeline.cli.console import show_headline, show_outcome
    from tracklake.pipeline.lake import load
    from tracklake.pipeline.lake.files import REPORTS
    from tracklake.pipeline.stages.report import DOCUMENT, PAGE

    show_outcome(terminal, outcome)
    reports = settings.lake / REPORTS
    record: dict[str, Any] = {"lake": settings.lake, **asdict(outcome)}
    usable = bool(load(settings.lake).of_stage("ingest"))
    if usable and headline and (reports / DOCUMENT).exists():
        quality = json.loads((reports / DOCUMENT).read_text(encoding="utf-8"))
        show_headline(terminal, quality, reports / PAGE, settings.lake)
        record |= {"report": (reports / PAGE).resolve(), **{key: quality[key] for key in ("headline", "model_scores")}}
    elif not usable and not outcome.refused:
        terminal.say(f"{settings.lake}: the lake holds no recordings; `tracklake ingest SOURCE` adds some")
    elif outcome.built:
        terminal.say(f"done: {', '.join(f'{stage} {count}' for stage, count in outcome.built.items())}")
    if assess and usable and not outcome.failed:
        from tracklake.pipeline.cli.assessment_table import show_assessment

        record["assessment"] = show_assessment(terminal, settings.lake)
    if compare is not None and not outcome.failed:
        from tracklake.pipeline.cli.comparison_table import compare_lakes

        record |= compare_lakes(terminal, settings.lake, compare)
    terminal.give(record)
    if outcome.failed or (outcome.refused and not usable):
        raise typer.Exit(FAILED)
    if outcome.refused:
        terminal.complain(f"{len(outcome.refused)} refused (above); everything else is done", label="refused")
        raise typer.Exit(REFUSED)
