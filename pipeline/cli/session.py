"""What every command does the same way: settings, doing what is not done, saying what came of it, exit codes.

Like the commands, it imports heavy libraries where they are used.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tracklake.schemas.errors import TracklakeError

if TYPE_CHECKING:
    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.ingest.discovery import Discovery
    from tracklake.pipeline.orchestration.run_plan import Order, Outcome
    from tracklake.pipeline.settings import Settings

DONE, FAILED, USAGE, REFUSED = 0, 1, 2, 3


@contextmanager
def command(*, quiet: bool = False, json: bool = False) -> Iterator["Terminal"]:
    """Give a command its terminal, and turn what a user can mend into a message and an exit code."""
    from tomllib import TOMLDecodeError

    from pydantic import ValidationError

    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.lake import LakeError
    from tracklake.pipeline.sources import SourceError
    from tracklake.pipeline.stages.stage import StageError
    from tracklake.quality_reports.rules.registry import ThresholdError

    terminal = Terminal(quiet=quiet, as_json=json)
    try:
        yield terminal
    except (LakeError, SourceError, StageError) as error:
        raise failure(terminal, str(error)) from None
    except (ThresholdError, TOMLDecodeError) as error:
        where = "tracklake.toml: " if isinstance(error, TOMLDecodeError) else ""
        raise failure(terminal, f"{where}{error}", USAGE) from None
    except ValidationError as error:
        for problem in error.errors():
            where = ".".join(str(part) for part in problem["loc"])
            terminal.complain(
                f"setting {where}: {problem['msg']}; got {problem['input']!r}. See `tracklake.toml` and TRACKLAKE_*."
            )
        raise failure(terminal, "the settings are not valid", USAGE) from None
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python must not complain about it once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (TracklakeError, ValueError, OSError, ImportError) as error:
        raise failure(terminal, str(error)) from None
    except KeyboardInterrupt:
        told = "interrupted; what was committed stays; run the same command again"
        raise failure(terminal, told) from None


def failure(terminal: "Terminal", message: str, code: int = FAILED) -> typer.Exit:
    """Say what went wrong, to people and to programs, and give the exit to raise."""
    terminal.complain(message)
    terminal.give({"error": message})
    return typer.Exit(code)


def read_settings(*, lake: Path | None = None, workers: int | None = None, protocol: str | None = None) -> "Settings":
    """The settings, with the flags that were given on top."""
    from tracklake.pipeline.settings import Settings

    flags: dict[str, Any] = {"lake": lake, "workers": workers, "protocol": protocol}
    return Settings(**{name: value for name, value in flags.items() if value is not None})


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
) -> "Outcome":
    """Do what is not done; Prefect is imported only where something is."""
    from tracklake.pipeline.lake import load, refuse_foreign, refuse_if_busy
    from tracklake.pipeline.orchestration.run_plan import Order, conclude_idle, is_idle
    from tracklake.pipeline.sources import SourceError
    from tracklake.schemas.columns import DATASETS

    if dataset not in (None, *DATASETS):
        raise typer.BadParameter(f"--dataset is {' or '.join(DATASETS)}; got {dataset!r}")
    plain = settings.model_dump(mode="json", exclude_unset=True)
    # Absolute, so that a worker in another folder finds the same places.
    where = None if source is None else str(Path(source).absolute())
    order = Order(str(settings.lake.absolute()), steps, where, dataset, plain, replace, prune, rebuild)
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
    if is_idle(order, discovery):
        terminal.say("nothing to do: the lake is up to date", style="dim")
        return conclude_idle(order, discovery)
    refuse_if_busy(order.root, rebuild=rebuild)
    with terminal.working():
        from tracklake.pipeline.orchestration.flows import execute

        return execute(order)


SOON_S = 0.3


def _survey_while_importing(order: "Order") -> "Discovery":
    """Find the raw files; Prefect is imported meanwhile where that takes longer than looking up known hashes.

    Files that must be hashed are new, so there will be work for it.
    """
    from concurrent.futures import ThreadPoolExecutor
    from contextlib import suppress
    from importlib import import_module

    from tracklake.pipeline.orchestration.run_plan import survey

    with ThreadPoolExecutor(max_workers=1) as thread:
        discovery = thread.submit(survey, order)
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
    outcome: "Outcome",
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
