"""What a person at a terminal sees: progress bars, summaries, tables. Results go to stdout, the rest to stderr."""

import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from tracklake.pipeline.orchestration.progress import Silent, reporting_to

if TYPE_CHECKING:
    from tracklake.pipeline.lake import LakeResult
    from tracklake.pipeline.orchestration.run_plan import RunResult

SHOWN_ROWS = 40
"""Rows of a query's result that are shown to a person; csv, json and parquet give all."""
SHOWN_CHARACTERS = 120
"""Of one value in them."""


class Terminal:
    """Where output goes, and how much of it.

    Args:
        quiet: errors only.
        as_json: one JSON object on stdout at the end, nothing else there.
    """

    def __init__(self, *, quiet: bool = False, as_json: bool = False) -> None:
        self.out = Console(highlight=False, soft_wrap=True)
        self.err = Console(stderr=True, highlight=False, soft_wrap=True)
        self.as_json = as_json
        self.talks = not (quiet or as_json)

    def say(self, text: str, *, style: str = "") -> None:
        """A line for people."""
        if self.talks:
            self.out.print(escape(text), style=style or None)

    def complain(self, text: str, *, label: str = "error") -> None:
        """An error or refusal; always shown, on stderr."""
        colour = "red" if label == "error" else "yellow"
        self.err.print(f"[bold {colour}]{label}:[/] {escape(text)}")

    def give(self, record: dict[str, Any]) -> None:
        """The result for programs, where they asked for it."""
        if self.as_json:
            json.dump(record, sys.stdout, indent=1, allow_nan=False, default=str)
            sys.stdout.write("\n")

    @contextmanager
    def working(self) -> Iterator[None]:
        """Show progress bars for the length of a block."""
        if not self.talks:
            with reporting_to(Silent()):
                yield
            return
        columns = (
            TextColumn("{task.description:<9}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[title]}"),
        )
        with Progress(*columns, console=self.err) as progress, reporting_to(_Bars(progress)):
            yield

    @contextmanager
    def measuring(self, title: str) -> Iterator[Callable[[float, float], None]]:
        """Show one bar that is told the share done (0 to 1) and the loss."""
        if not self.talks:
            yield lambda _share, _loss: None
            return
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
        with Progress(*columns, TextColumn("[dim]{task.fields[loss]}"), console=self.err) as progress:
            bar = progress.add_task(escape(title), total=1.0, loss="")
            yield lambda share, loss: progress.update(bar, completed=share, loss=f"loss {loss:.3f}")


class _Bars:
    """One bar per stage."""

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
        self._progress.update(self._bars[stage], advance=1, title=escape(title))


def show_outcome(terminal: Terminal, outcome: "RunResult") -> None:
    """Print what came of an order: notes, refusals, failures."""
    for note in dict.fromkeys(outcome.notes):
        terminal.say(f"note: {note}", style="dim")
    if outcome.skipped and terminal.talks:
        shown = ", ".join(outcome.skipped[:5]) + (", ..." if len(outcome.skipped) > 5 else "")
        terminal.say(f"note: skipped, no raw data: {shown}", style="dim")
    for message in outcome.refused:
        terminal.complain(message, label="refused")
    for message in outcome.failed:
        terminal.complain(message)


def show_headline(terminal: Terminal, quality: dict[str, Any], report: Path, lake: Path) -> None:
    """Print the report's figures, where it stands, and two commands to try next."""
    head = quality["headline"]
    excluded, judged = _some(head["excluded_subsets"]), head["eligible_starts"]
    late = "starts not judged" if judged is None else f"{head['late_starts']:,} late starts of {judged:,} judged"
    lines = {
        "recordings": f"{head['recordings']:,} recordings, {head['subsets']:,} subsets, {excluded} excluded",
        "tracks": f"{head['vehicles']:,} vehicles, {head['entries']:,} entries",
        "rows": f"{head['rows_read']:,} read, {head['rows_dropped']:,} rejected",
        "quality": f"{_some(head['vehicles_with_errors'])} vehicles with errors; " + late,
        "samples": "none" if head["samples"] is None else f"{head['samples']:,}{_balance(quality)}",
    }
    for score in quality["model_scores"]:
        rmse = "  ".join(
            f"{row['seconds']:g} s {row['rmse_m']:.2f}" for row in score["rows"] if row["rmse_m"] is not None
        )
        lines[f"RMSE, m ({score['model']})"] = (
            f"{rmse}  (n = {score['rows'][0]['n']:,} at {score['rows'][0]['seconds']:g} s)"
        )
    width = max(map(len, lines)) + 2
    for name, value in lines.items():
        terminal.say(f"{name:<{width}}{value}")
    terminal.say(f"{'report':<{width}}{report.resolve()}", style="bold green")
    at = "" if lake == Path("lake") else f" --lake {lake}"
    protocol = quality["provenance"]["protocol"]["name"]
    of = "" if protocol == "csp" else f" --protocol {protocol}"
    terminal.say("\nTry next:")
    command = command_here()
    terminal.say(f'  {command} sql "SELECT rule, count(*) AS runs FROM findings GROUP BY rule ORDER BY runs DESC"{at}')
    terminal.say(f"  {command} train lstm{at}{of}" if head["samples"] else f'  {command} sql "FROM subsets"{at}')


def command_here() -> str:
    """How to call the command from where the user is: by name if that is found, else by the path it was called by."""
    found, called = shutil.which("tracklake"), Path(sys.argv[0])
    if called.name != "tracklake" or (found and Path(found).resolve() == called.resolve()):
        return "tracklake"
    near = os.path.relpath(called)
    return str(called.resolve()) if near.startswith("..") else near


def _some(count: int | None) -> str:
    return "no" if count is None else f"{count:,}"


def _balance(quality: dict[str, Any]) -> str:
    beside = {row["split"] for row in quality["splits"]["recipes"] if not row["trains"]}
    parts = [
        f"{row['dataset']} {row['part']} {row['vehicle_share']:.1%}"
        for row in quality["splits"]["balance"]
        if row["vehicle_share"] is not None and row["split"] not in beside
    ]
    return f"; split by vehicles: {', '.join(parts)}" if parts else ""


def show_relation(relation: "LakeResult", terminal: Terminal) -> None:
    """Print a query's first rows as a table that keeps every column, and on stderr how many rows there are."""
    rows = relation.limit(SHOWN_ROWS + 1).fetchall()
    cells = [list(relation.columns), *([_cell(value) for value in row] for row in rows[:SHOWN_ROWS])]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    numeric = [str(kind).startswith(_NUMERIC) and not str(kind).endswith("]") for kind in relation.types]
    for number, row in enumerate(cells):
        shown = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        terminal.say("  ".join(shown).rstrip(), style="" if number else "bold")
    if len(rows) > SHOWN_ROWS:
        rest = f"the first {SHOWN_ROWS} of {relation.count():,} rows; --format csv, json or parquet gives all"
        terminal.err.print(f"[dim]{rest}[/]")
    else:
        terminal.err.print(f"[dim]{len(rows)} {'row' if len(rows) == 1 else 'rows'}[/]")


_NUMERIC = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UBIGINT", "UINTEGER", "FLOAT", "DOUBLE", "DECIMAL")


def _cell(value: object) -> str:
    if value is None:
        return "null"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    # A plan is drawn over many lines.
    return text if len(text) <= SHOWN_CHARACTERS or "\n" in text else text[: SHOWN_CHARACTERS - 1] + "…"


def show_scores(terminal: Terminal, evaluations: Sequence[dict[str, Any]]) -> None:
    """Print RMSE by horizon with the number of samples behind each."""
    for evaluation in evaluations:
        title = (
            f"{evaluation['model']} on {evaluation['part']} of {evaluation['split']} "
            f"({evaluation['samples']:,} samples, protocol {evaluation['protocol']})"
        )
        table = Table(title=escape(title), title_justify="left", box=None, header_style="bold", padding=(0, 2, 0, 0))
        for heading in ("horizon", "RMSE m", "longitudinal m", "lateral m", "MAE m", "n"):
            table.add_column(heading, justify="right")
        for row in evaluation["horizons"]:
            values = [row[name] for name in ("rmse_m", "rmse_longitudinal_m", "rmse_lateral_m", "mae_m")]
            shown = ["-" if value is None else f"{value:.2f}" for value in values]
            table.add_row(f"{row['seconds']:g} s", *shown, f"{row['n']:,}")
        if terminal.talks:
            terminal.out.print(table)
