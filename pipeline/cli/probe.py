"""`tracklake probe`: what a raw file is, without any value of it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import FAILED, REFUSED, command
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import JsonOption, QuietOption
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.ingest.probe import FileProbe, probe_source

FITS = {True: "plausible", False: "IMPLAUSIBLE", None: ""}
"""Words for whether a column's values fit its unit."""
MOTION = {True: "agree", False: "DO NOT AGREE: another unit or frame rate?"}
"""Words for whether positions advance by the speeds."""


def probe(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A raw file, or a folder or archive of them.")],
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Print the format, columns, counts and units of raw files, without any value: to paste into an issue.

    Nothing is written. Names of files and columns are printed. Exit code 1: no known format; 3: rows cannot be read, or
    values do not fit their units.
    """
    with command(quiet=quiet, json=json) as terminal:
        found = []
        for each in probe_source(file):
            found.append(each)
            _print_probe(terminal, each)
        terminal.print_json({"files": [asdict(each) for each in found]})
        if not any(each.dataset for each in found):
            terminal.print_problem(f"{file}: no known format. docs/data.md lists them.")
            raise typer.Exit(FAILED)
        if not all(each.is_sound for each in found if each.dataset):
            raise typer.Exit(REFUSED)


def _print_probe(terminal: Terminal, probe: FileProbe) -> None:
    what = f"dataset {probe.dataset}, dialect {probe.dialect}" if probe.dataset else probe.problem
    terminal.print_line(f"{probe.name}: {what}", style="bold")
    if probe.dataset and probe.problem:
        terminal.print_line(f"  {probe.problem}")
    elif probe.dataset and probe.rows is None:
        terminal.print_line("  a format without columns; its rows are not counted here")
    if probe.rows is not None:
        lost = sum(probe.rejected.values())
        terminal.print_line(f"  rows: {probe.rows:,}, of which {probe.rows - lost:,} can be read")
        for reason, count in probe.rejected.items():
            terminal.print_line(f"    {count:,} rejected: {reason}")
    rows = [
        [
            column.name,
            column.state,
            column.unit,
            "" if column.filled is None else f"{100 * column.filled:.1f} %",
            FITS[column.fits],
        ]
        for column in probe.columns
    ]
    if rows:
        right = [False, False, False, True, False]
        print_table(terminal, ["column", "state", "unit", "filled", "values"], rows, indent=2, right=right)
    if probe.motion is not None:
        terminal.print_line(f"  positions and speeds: {MOTION[probe.motion]}")
