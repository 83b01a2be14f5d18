"""`tracklake repair`: late starts, and how well their missing part is estimated."""

from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder


def repair(
    lake: LakeOption = None,
    assess: Annotated[
        bool, typer.Option("--assess", help="Measure the estimates on tracks cut on purpose, and report it.")
    ] = False,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Find late starts and estimate what is missing of them."""
    with command(quiet=quiet, json=json) as terminal:
        steps = ("repair", "assess", "report") if assess else ("repair",)
        with work_in_folder(terminal, read_settings(lake=lake, workers=workers, in_folder=False)) as settings:
            report_result(terminal, settings, run_steps(terminal, settings, steps), headline=False, assess=assess)
