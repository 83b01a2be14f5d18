"""The command line: one group that imports a command's module only when that command is called."""

import os
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from tracklake.pipeline.cli.logs import choose_file, choose_verbose
from tracklake.pipeline.cli.memory import collect_seldom, keep_freed_memory
from tracklake.pipeline.cli.streams import guard_streams

COMMANDS = {
    "run": "Run the whole pipeline: raw files to tables, checks, samples, split, tensors, first score and report.",
    "ingest": "Read raw files into tracks, vehicles and subsets (the format is detected).",
    "remove": "Take recordings out of the lake, with all that was made of them; raw files stay.",
    "validate": "Check every entry of recordings from above against the rules; `tracklake run` also checks drives.",
    "reconstruct": "Reconstruct physically possible tracks near the recorded ones, and check them against the rules.",
    "repair": "Find late starts and estimate what is missing of them.",
    "traffic": "Derive tables for traffic research: car following, lane changes, safety, detectors, flow and density.",
    "samples": "Draw samples with maneuvers and neighbors.",
    "split": "Divide the subsets into train and eval.",
    "tensors": "Write the split as flat arrays.",
    "fuse": "Track the vehicles around an instrumented vehicle, by its messages, LiDAR and camera.",
    "probe": "Print the format, columns, counts and units of raw files, without any value: to paste into an issue.",
    "report": "Write the quality report.",
    "check": 'Compare every file with its checksum, and judge quality gates such as "error_share > 0.05".',
    "info": "Show a lake's recordings, stages, what is stale and why, and sizes on disk.",
    "config": "Show the settings in force, and where each comes from.",
    "sql": "Query the tables with SQL, read-only, from anywhere.",
    "train": "Train a model on the split's training part and evaluate it once on the evaluation part.",
    "evaluate": "Score runs and models at each horizon, beside published figures.",
    "predict": "Draw samples on the road: history, neighbors, truth, predictions and their uncertainty.",
    "lane-forest": "Fit a forest that predicts lane changes; score it, and the grid cells that models predict.",
    "onboard": "Predict the vehicles around an instrumented vehicle from its own logs; train, evaluate, warn.",
    "export": "Write the lake's data in other projects' formats.",
    "publish": "Put the lake where others can read it: on an object store, or as a DuckLake catalog.",
    "fetch": "Copy a lake from an object store to a folder, or bring that copy up to date.",
    "sample": "Generate recordings in the raw formats with SUMO, with known defects and their truth.",
    "instrument": "Write what a car of a recording would have logged: V2V messages, LiDAR, camera, and the truth.",
    "serve": "Serve the flows as Prefect deployments, by hand or on a schedule, until interrupted.",
}
"""Short help of each command, in the order of the help page; a command is a function in the module of its name."""

MODULES = dict.fromkeys(("validate", "reconstruct", "traffic", "samples", "tensors", "fuse"), "stage")
MODULES["fetch"] = "publish"
"""Modules of the commands that have none of their own."""
DIAGNOSIS = "Diagnosis"
"""Title of the options that every command takes, on its help page."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as that of a program that the signal ended."""


class LazyGroup(TyperGroup):
    """A group whose help page needs none of its commands' modules."""

    def __init__(self, **attributes: Any) -> None:  # noqa: ANN401  (handed on as Typer gives them)
        """Register a stand-in for every command."""
        stand_ins = {name: TyperCommand(name, help=text) for name, text in COMMANDS.items()}
        super().__init__(**{**attributes, "commands": stand_ins})

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401  (see resolve_command)
        """Run the command; Ctrl-C before it has its own frame, while modules are imported, is a message as well."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("error: interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:  # noqa: ANN401  (Typer keeps its types private)
        """Import the command that is called."""
        name, stand_in, rest = super().resolve_command(ctx, args)
        return name, stand_in and load_command(args[0]), rest


def load_command(name: str) -> Any:  # noqa: ANN401  (see LazyGroup)
    """Import a command's module and build the command."""
    function = name.replace("-", "_")
    target = getattr(import_module(f"tracklake.pipeline.cli.{MODULES.get(name, function)}"), function)
    if not isinstance(target, typer.Typer):
        alone = typer.Typer(add_completion=False)
        alone.command(name)(target)
        target = alone
    built = get_command(target)
    common = typer.Typer(add_completion=False)
    common.command()(_read_common_options)
    for each in (built, *getattr(built, "commands", {}).values()):
        each.params += [parameter for parameter in get_command(common).params if parameter.name != "help"]
    return built


def _choose_debugging(debug: bool) -> None:
    """Show tracebacks, also in worker processes."""
    if debug:
        os.environ["TRACKLAKE_DEBUG"] = "1"


VerboseOption = Annotated[
    bool,
    typer.Option(
        "--verbose",
        "-v",
        callback=choose_verbose,
        expose_value=False,
        rich_help_panel=DIAGNOSIS,
        help="Print each step with its time on stderr, instead of progress bars.",
    ),
]
LogFileOption = Annotated[
    Path | None,
    typer.Option(
        "--log-file",
        metavar="FILE",
        callback=choose_file,
        expose_value=False,
        rich_help_panel=DIAGNOSIS,
        help="Append each step with its time, and tracebacks, to this file.",
    ),
]
DebugOption = Annotated[
    bool,
    typer.Option(
        "--debug",
        callback=_choose_debugging,
        expose_value=False,
        rich_help_panel=DIAGNOSIS,
        help="Show the traceback of every error (or TRACKLAKE_DEBUG=1).",
    ),
]


def _read_common_options(
    verbose: VerboseOption = False, log_file: LogFileOption = None, debug: DebugOption = False
) -> None:
    """Stand for the options that every command takes; their callbacks do what they ask."""


app = typer.Typer(
    cls=LazyGroup,
    name="tracklake",
    help="Highway trajectory recordings (NGSIM, highD) to a Parquet lake, quality reports, splits and tensors.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog="Exit codes: 0 done, 1 failed, 2 usage, 3 done but some recordings were refused, 4 a quality gate failed, "
    "130 interrupted.",
)


@app.callback(invoke_without_command=True)
def _read_global_options(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    verbose: VerboseOption = False,
    log_file: LogFileOption = None,
    debug: DebugOption = False,
) -> None:
    del verbose, log_file, debug  # their callbacks have done what they ask
    if show_version:
        typer.echo(f"tracklake {version('tracklake')}")
        raise typer.Exit


def main() -> None:
    """Entry point of the `tracklake` command."""
    keep_freed_memory()
    collect_seldom()
    guard_streams()
    app()


if __name__ == "__main__":
    main()
