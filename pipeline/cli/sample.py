"""`tracklake sample`: recordings generated with SUMO."""

from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command
from tracklake.pipeline.cli.console import find_command
from tracklake.pipeline.cli.generated_sample import write_generated
from tracklake.pipeline.cli.options import JsonOption, MinutesOption, QuietOption, SeedOption
from tracklake.pipeline.lake import refuse_lake
from tracklake.pipeline.synthetic import ALL_FORMATS, UNIFORM


def sample(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new or empty folder.")],
    format: Annotated[
        list[str] | None,
        typer.Option("--format", help=f"{', '.join(ALL_FORMATS)}; repeatable."),
    ] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(
            "--noise", help="smooth (default), autocorrelated, handover, quantised; repeatable: errors add up."
        ),
    ] = None,
    traffic: Annotated[
        str,
        typer.Option(
            "--traffic", help="uniform, or varied-idm, varied-krauss: drivers, lane changes and waves drawn at random."
        ),
    ] = UNIFORM,
    defect: Annotated[
        str | None,
        typer.Option("--defect", help="The only defect of the sample, such as frame_gap or late_start; with --dose."),
    ] = None,
    dose: Annotated[
        float | None, typer.Option("--dose", help="Share of the vehicles that have the defect; 0: clean traffic.")
    ] = None,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Generate recordings in the raw formats with SUMO, with known defects and their truth."""
    with command(quiet=quiet, json=json) as terminal:
        refuse_lake(out)
        summary = write_generated(
            out, minutes, seed, terminal, formats=format, noise=noise, traffic=traffic, defect=defect, dose=dose
        )
        terminal.print_line(
            f"{summary.rows:,} rows of {summary.recordings} recordings in {out} ({summary.seconds:.0f} s)"
        )
        if summary.dose is not None:
            terminal.print_line(f"{defect}: {summary.dose:.2%} of the vehicles, {dose:.2%} were asked for")
        terminal.print_line(f"Try next:\n  {find_command()} run {out}")
        terminal.print_json(
            {"out": out, "rows": summary.rows, "recordings": summary.recordings, "seconds": summary.seconds}
            | ({} if summary.dose is None else {"defect": defect, "dose": summary.dose})
        )
