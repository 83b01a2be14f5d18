"""`tracklake report`: the quality report, and the comparison with another lake."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, find_folder, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.stages.pages import find_pages
from tracklake.pipeline.stages.report import PAGE
from tracklake.quality_reports.pages.page_names import FOLDER
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import find_similar


def report(
    lake: LakeOption = None,
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="OTHER_LAKE", help="Also show what differs from this lake.")
    ] = None,
    subsets: Annotated[
        list[str] | None,
        typer.Option("--subset", metavar="SUBSET", help="Of more than 400, also draw this one's page; repeatable."),
    ] = None,
    opened: Annotated[bool, typer.Option("--open", help="Open the report in the web browser.")] = False,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the quality report."""
    with command(quiet=quiet, json=json) as terminal:
        named = read_settings(lake=lake, workers=workers, protocol=protocol, in_folder=False)
        if compare is not None:
            compare = find_folder(compare, named)
            load(compare)  # raises where there is no lake, before any work is done
        with work_in_folder(terminal, named) as settings:
            if subsets:
                _require_subsets(settings.lake, subsets)
                settings = settings.model_copy(update={"pages_of": [*settings.pages_of, *subsets]})
            report_result(terminal, settings, run_steps(terminal, settings, ("report",)), compare=compare)
        if opened and not webbrowser.open((settings.lake / REPORTS / PAGE).resolve().as_uri()):
            terminal.print_problem("there is no web browser to open the report with", label="note")
        pages = find_pages(settings.lake, load(settings.lake).of_stage("pages")) if subsets else {}
        for (_, subset), name in pages.items():
            if subset in (subsets or ()):
                terminal.print_line(f"page of {subset}: {settings.lake / REPORTS / FOLDER / name}")


def _require_subsets(lake: Path, names: list[str]) -> None:
    known = {subset["subset"] for commit in load(lake).of_stage("ingest") for subset in commit.info["subsets"]}
    for name in names:
        if name not in known:
            near = find_similar(name, sorted(known))
            advice = f"did you mean {near}?" if near else '`tracklake sql "SELECT subset FROM subsets"` lists them'
            raise UsageError(f"--subset {name}: no subset of {lake} has this name; {advice}")
