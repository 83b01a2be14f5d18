"""The command line. Heavy libraries are imported inside the commands, so that help answers at once."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tracklake.pipeline.cli import evaluate as evaluating
from tracklake.pipeline.cli import lane_forest
from tracklake.pipeline.cli import predict as predicting
from tracklake.pipeline.cli import split as planning
from tracklake.pipeline.cli import train as training_command
from tracklake.pipeline.cli.allocation import keep_freed_memory
from tracklake.pipeline.cli.export import app as export_app
from tracklake.pipeline.cli.generated_sample import provide_sample, refuse_mixing, write_generated
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import DEBUG, DONE, FAILED, carry_out, command, conclude, read_settings

app = typer.Typer(
    name="tracklake",
    help="Highway trajectory recordings (NGSIM, highD) to a Parquet lake, quality reports, splits and tensors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done, 1 failed, 2 usage, 3 done but some recordings were refused.",
)
app.add_typer(export_app, name="export")

DatasetOption = Annotated[str | None, typer.Option("--dataset", help="Read SOURCE as this only: ngsim or highd.")]
ReplaceOption = Annotated[
    bool, typer.Option("--replace", help="Let SOURCE's files replace a recording's earlier files that SOURCE lacks.")
]
PruneOption = Annotated[
    bool, typer.Option("--prune", help="Remove recordings whose files once stood in SOURCE, a folder, and are gone.")
]
RebuildOption = Annotated[
    bool,
    typer.Option("--rebuild", help="Begin the lake anew in its place, also one of another schema version; redo all."),
]
MinutesOption = Annotated[float | None, typer.Option("--minutes", help="Length of the generated recordings.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Of the generated sample: same seed, same bytes.")]


def main() -> None:
    """Entry point of the `tracklake` command."""
    keep_freed_memory()
    app()


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help=f"Show the traceback of every error (or {DEBUG}=1).")] = False,
) -> None:
    if debug:
        os.environ[DEBUG] = "1"
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"tracklake {version_of('tracklake')}")
        raise typer.Exit(DONE)


@app.command()
def run(
    source: Annotated[
        str | None, typer.Argument(metavar="[SOURCE]", help="A raw file or a folder of them; none: a generated sample.")
    ] = None,
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    replace: ReplaceOption = False,
    prune: PruneOption = False,
    rebuild: RebuildOption = False,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """The whole pipeline: raw files to tables, checks, repair, samples, split, tensors, first score and report."""
    from tracklake.pipeline.orchestration.run_plan import ALL_STEPS

    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake, workers=workers, protocol=protocol)
        check = refuse_mixing if source is None else None
        if source is None:
            if prune or rebuild:
                raise typer.BadParameter("--prune and --rebuild need SOURCE, the folder with the raw files")
            source = str(provide_sample(settings.lake, minutes, seed, terminal))
        elif minutes is not None or seed is not None:
            raise typer.BadParameter("--minutes and --seed are for the generated sample, which takes no SOURCE")
        flags = {"replace": replace, "prune": prune, "rebuild": rebuild}
        outcome = carry_out(terminal, settings, ALL_STEPS, source, dataset, **flags, check=check)
        conclude(terminal, settings, outcome)


@app.command()
def ingest(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A raw file, or a folder of any mix of them.")],
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    workers: WorkersOption = None,
    replace: ReplaceOption = False,
    prune: PruneOption = False,
    rebuild: RebuildOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Raw files to tracks, vehicles and subsets (the format is detected)."""
    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake, workers=workers)
        flags: dict[str, Any] = {"replace": replace, "prune": prune, "rebuild": rebuild}
        outcome = carry_out(terminal, settings, ("ingest",), source, dataset, **flags)
        conclude(terminal, settings, outcome, headline=False)


@app.command()
def remove(
    recordings: Annotated[list[str], typer.Argument(metavar="RECORDING...", help="For instance 03, or highd/03.")],
    lake: LakeOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Take recordings out of the lake, with all that was made of them; raw files are not touched."""
    from dataclasses import asdict

    with command(quiet=quiet, json=json) as terminal:
        from tracklake.pipeline.ingest.removal import remove_recordings

        root = read_settings(lake=lake).lake
        removed, outdated = remove_recordings(root, recordings)
        for gone in removed:
            terminal.say(f"removed {gone.name}: {', '.join(gone.subsets)}; {gone.entries:,} rows of tracks")
            if gone.files:
                terminal.say(f"note: {gone.files[0]} is still there, and ingesting it brings {gone.name} back")
        if outdated:
            terminal.say(f"note: {', '.join(outdated)} were made of it and went, too; `tracklake run` makes them anew")
        terminal.give({"lake": root, "removed": [asdict(gone) for gone in removed], "outdated": outdated})


def _add_stage(name: str, meaning: str) -> None:
    """One command per stage that works on what is in the lake."""

    def stage(
        lake: LakeOption = None,
        protocol: ProtocolOption = None,
        workers: WorkersOption = None,
        quiet: QuietOption = False,
        json: JsonOption = False,
    ) -> None:
        with command(quiet=quiet, json=json) as terminal:
            settings = read_settings(lake=lake, workers=workers, protocol=protocol)
            outcome = carry_out(terminal, settings, (name,))
            conclude(terminal, settings, outcome, headline=False)

    stage.__doc__ = meaning
    app.command(name=name)(stage)


# The names and meanings of pipeline.stages.registry, which is not imported here: it would cost a second of every call.
STAGE_COMMANDS = {
    "validate": "Check every entry against the rules.",
    "repair": "Find late starts and estimate what is missing of them.",
    "samples": "Draw samples with maneuvers and neighbors.",
    "split": "Divide the subsets into train and eval.",
    "tensors": "Write the split as flat arrays.",
    "report": "Write the quality report.",
}
for _name, _meaning in STAGE_COMMANDS.items():
    if _name not in ("repair", "split", "report"):
        _add_stage(_name, _meaning)


app.command(name="split", help=STAGE_COMMANDS["split"])(planning.split)


@app.command(help=STAGE_COMMANDS["repair"])
def repair(
    lake: LakeOption = None,
    assess: Annotated[
        bool, typer.Option("--assess", help="Measure the estimates on tracks cut on purpose, and report it.")
    ] = False,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Find late starts, and where asked to measure how good the estimates are."""
    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake, workers=workers)
        steps = ("repair", "assess", "report") if assess else ("repair",)
        conclude(terminal, settings, carry_out(terminal, settings, steps), headline=False, assess=assess)


@app.command(help=STAGE_COMMANDS["report"])
def report(
    lake: LakeOption = None,
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="OTHER_LAKE", help="Also show what differs from this lake.")
    ] = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the quality report, and where asked to compare the lake with another."""
    with command(quiet=quiet, json=json) as terminal:
        if compare is not None:
            from tracklake.pipeline.lake import load

            load(compare)  # raises where there is no lake, before any work is done
        settings = read_settings(lake=lake, workers=workers, protocol=protocol)
        conclude(terminal, settings, carry_out(terminal, settings, ("report",)), compare=compare)


@app.command()
def sql(
    query: Annotated[str | None, typer.Argument(help="One SELECT; `-` reads it from standard input.")] = None,
    lake: LakeOption = None,
    format: Annotated[str, typer.Option("--format", help="table, csv, json or parquet.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="Write the result to this file.")] = None,
    names: Annotated[bool, typer.Option("--list", help="List the tables and macros, and what they are.")] = False,
) -> None:
    """Ask SQL of the tracks, read-only, from anywhere."""
    from tracklake.pipeline.cli.query_result import FORMATS, show_names, write_result
    from tracklake.pipeline.lake import connect, query_errors
    from tracklake.pipeline.lake import query as run_query

    with command() as terminal:
        if format not in FORMATS:
            raise typer.BadParameter(f"--format is one of {', '.join(FORMATS)}; got {format!r}")
        if names:
            show_names(terminal)
            return
        if query is None:
            raise typer.BadParameter("give one SELECT, `-` to read it from standard input, or --list")
        with connect(read_settings(lake=lake).lake) as connection:
            relation = run_query(connection, sys.stdin.read() if query == "-" else query)
            with query_errors():  # DuckDB computes while the result is fetched
                write_result(relation, format, out, terminal)


app.command()(training_command.train)
app.command()(evaluating.evaluate)
app.command()(predicting.predict)
app.command("lane-forest")(lane_forest.lane_forest)


@app.command()
def sample(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new or empty folder.")],
    format: Annotated[
        list[str] | None, typer.Option("--format", help="highd, ngsim-text, ngsim-csv, socrata; repeatable.")
    ] = None,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Generate recordings in the raw formats with SUMO, with known defects and their truth."""
    from tracklake.pipeline.cli.console import command_here

    with command(quiet=quiet, json=json) as terminal:
        summary = write_generated(out, minutes, seed, terminal, formats=format)
        terminal.say(f"{summary.rows:,} rows of {summary.recordings} recordings in {out} ({summary.seconds:.0f} s)")
        terminal.say(f"Try next:\n  {command_here()} run {out}")
        terminal.give({"out": out, "rows": summary.rows, "recordings": summary.recordings, "seconds": summary.seconds})


@app.command()
def serve() -> None:
    """Serve the flows as Prefect deployments (run, ingest, quality) until interrupted."""
    if not os.environ.get("PREFECT_API_URL"):
        typer.echo("PREFECT_API_URL is not set: runs would be seen by nobody. Start a server, for instance", err=True)
        typer.echo("  prefect server start\n  export PREFECT_API_URL=http://127.0.0.1:4200/api", err=True)
        raise typer.Exit(FAILED)
    from tracklake.pipeline.orchestration.flows import serve_deployments

    serve_deployments()


if __name__ == "__main__":
    main()
