"""`tracklake report`: the quality report, and the comparison with another lake."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.stages.report import PAGE


def report(
    lake: LakeOption = None,
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="OTHER_LAKE", help="Also show what differs from this lake.")
    ] = None,
    opened: Annotated[bool, typer.Option("--open", help="Open the report in the web browser.")] = False,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the quality report."""
    with command(quiet=quiet, json=json) as terminal:
        if compare is not None:
            load(compare)  # raises where there is no lake, before any work is done
        named = read_settings(lake=lake, workers=workers, protocol=protocol, in_folder=False)
        with work_in_folder(terminal, named) as settings:
            report_result(terminal, settings, run_steps(terminal, settings, ("report",)), compare=compare)
        if opened and not webbrowser.open((settings.lake / REPORTS / PAGE).resolve().as_uri()):
            terminal.print_problem("there is no web browser to open the report with", label="note")
