"""The terminal of a command: results go to stdout, progress and errors to stderr."""

import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from tracklake.pipeline.cli.logs import LOG, chosen, log_shown
from tracklake.pipeline.orchestration.progress import Reporter, reporting_to
from tracklake.schemas.text import make_visible, quote_shell


class Terminal:
    """Prints what a command has to show, as much as the user wants.

    Args:
        quiet: print errors only.
        as_json: print one JSON object on stdout at the end, and nothing else there.
    """

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        self.out = Console(highlight=False, soft_wrap=True)
        self.err = Console(stderr=True, highlight=False, soft_wrap=True)
        self.as_json = as_json
        self.verbose = not (quiet or as_json)
        self._synthetic: str | None = None
        self._held: list[dict[str, Any]] | None = None

    def print_line(self, text: str, *, style: str = "") -> None:
        """Print a line for people."""
        log_shown(logging.INFO, text)
        if self.verbose:
            self.out.print(escape(make_visible(text, keep="\n")), style=style or None)

    def print_origin(self, synthetic: str | None) -> None:
        """Print what of the data is synthetic, if anything, and add it to the record for programs.

        Args:
            synthetic: text of `schemas.origin.describe_synthetic`.
        """
        self._synthetic = synthetic
        if synthetic is not None:
            self.print_line(synthetic, style="bold yellow")

    def print_problem(self, text: str, *, label: str = "error") -> None:
        """Print an error or refusal, always, on stderr."""
        log_shown(logging.ERROR if label == "error" else logging.WARNING, f"{label}: {text}")
        colour = "red" if label == "error" else "yellow"
        self.err.print(f"[bold {colour}]{label}:[/] {escape(make_visible(text, keep=chr(10)))}")

    def print_bug(self, text: str) -> None:
        """Print the traceback of a bug on stderr."""
        log_shown(logging.CRITICAL, text)
        self.err.print(make_visible(text, keep="\n"), markup=False)

    def print_json(self, record: dict[str, Any]) -> None:
        """Print the result for programs, with --json."""
        if self._held is not None:
            self._held.append(record)
        elif self.as_json:
            synthetic = {} if self._synthetic is None else {"synthetic": self._synthetic}
            json.dump({**record, **synthetic}, sys.stdout, indent=1, allow_nan=False, default=str)
            sys.stdout.write("\n")

    @contextmanager
    def hold_json(self) -> Iterator[None]:
        """Print the results of a block at its end, and none of them if it fails, which is then the result."""
        held: list[dict[str, Any]] = []
        self._held = held
        try:
            yield
        except typer.Exit:  # a part was refused or failed, which the results say
            self._release_json(held)
            raise
        except BaseException:
            self._held = None
            raise
        self._release_json(held)

    def _release_json(self, held: list[dict[str, Any]]) -> None:
        self._held = None
        for record in held:
            self.print_json(record)

    @contextmanager
    def show_stages(self) -> Iterator[None]:
        """Show one progress bar per stage while a block runs, or with --verbose lines of the log."""
        if not self.verbose or chosen.verbose:
            with reporting_to(_Lines(Reporter())):
                yield
            return
        columns = (
            TextColumn("{task.description:<9}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[title]}"),
        )
        with Progress(*columns, console=self.err) as progress, reporting_to(_Lines(_Bars(progress))):
            yield

    @contextmanager
    def show_training(self, title: str) -> Iterator[Callable[[float, float], None]]:
        """Show one bar, updated by the function it yields with the share done (0 to 1) and the loss."""
        if not self.verbose or chosen.verbose:
            yield lambda share, loss: LOG.debug("%s: %.1f %% done, loss %.3f", title, 100 * share, loss)
            return
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
        with Progress(*columns, TextColumn("[dim]{task.fields[loss]}"), console=self.err) as progress:
            bar = progress.add_task(escape(title), total=1.0, loss="")
            yield lambda share, loss: progress.update(bar, completed=share, loss=f"loss {loss:.3f}")


class _Lines(Reporter):
    """Logs progress, and hands it on."""

    def __init__(self, shown: Reporter) -> None:
        self._shown = shown

    def begin(self, stage: str, total: int) -> None:
        LOG.info("%s: %d to do", stage, total)
        self._shown.begin(stage, total)

    def advance(self, stage: str, title: str) -> None:
        LOG.info("%s: %s done", stage, make_visible(title))
        self._shown.advance(stage, title)


class _Bars(Reporter):
    """Draws one bar per stage."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._bars: dict[str, TaskID] = {}

    def begin(self, stage: str, total: int) -> None:
        if stage in self._bars:
            bar = self._bars[stage]
            self._progress.update(bar, total=(self._progress.tasks[bar].total or 0) + total)
        else:
            self._bars[stage] = self._progress.add_task(stage, total=total, title="")

    def advance(self, stage: str, title: str) -> None:
        self._progress.update(self._bars[stage], advance=1, title=escape(make_visible(title)))


def find_command() -> str:
    """Return how a user calls the command again: by its name if the shell finds it, else by its path, quoted."""
    found, called = shutil.which("tracklake"), Path(sys.argv[0])
    if called.name != "tracklake" or (found and Path(found).resolve() == called.resolve()):
        return "tracklake"
    near = os.path.relpath(called)
    return quote_shell(called.resolve() if near.startswith("..") else near)
