"""The command line: one group that imports a command's module only when that command is called."""

import os
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from tracklake.pipeline.cli.streams import guard_streams
from tracklake.training.runs.memory import keep_freed_memory

COMMANDS = {
    "run": "Run the whole pipeline: raw files to tables, checks, samples, split, tensors, first score and report.",
    "ingest": "Read raw files into tracks, vehicles and subsets (the format is detected).",
    "remove": "Take recordings out of the lake, with all that was made of them; raw files stay.",
    "validate": "Check every entry against the rules.",
    "repair": "Find late starts and estimate what is missing of them.",
    "samples": "Draw samples with maneuvers and neighbors.",
    "split": "Divide the subsets into train and eval.",
    "tensors": "Write the split as flat arrays.",
    "report": "Write the quality report.",
    "check": "Compare every live file with its checksum; what is damaged is made again by the next run.",
    "sql": "Query the tables with SQL, read-only, from anywhere.",
    "train": "Train a model on the split's training part and evaluate it once on the evaluation part.",
    "evaluate": "Score runs and models at each horizon, beside published figures.",
    "predict": "Draw samples on the road: history, neighbors, truth, predictions and their uncertainty.",
    "lane-forest": "Fit a forest that predicts lane changes; score it, and the grid cells that models predict.",
    "export": "Write the lake's data in other projects' formats.",
    "sample": "Generate recordings in the raw formats with SUMO, with known defects and their truth.",
    "serve": "Serve the flows as Prefect deployments, by hand or on a schedule, until interrupted.",
}
"""Short help of each command, in the order of the help page; a command is a function in the module of its name."""

MODULES = {"validate": "stage", "samples": "stage", "tensors": "stage"}
"""Modules of the commands that have none of their own."""


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
    return get_command(target)


app = typer.Typer(
    cls=LazyGroup,
    name="tracklake",
    help="Highway trajectory recordings (NGSIM, highD) to a Parquet lake, quality reports, splits and tensors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
    epilog="Exit codes: 0 done, 1 failed, 2 usage, 3 done but some recordings were refused, 130 interrupted.",
)


@app.callback(invoke_without_command=True)
def _read_global_options(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of every error (or TRACKLAKE_DEBUG=1).")
    ] = False,
) -> None:
    if debug:
        os.environ["TRACKLAKE_DEBUG"] = "1"
    if show_version:
        typer.echo(f"tracklake {version('tracklake')}")
        raise typer.Exit


def main() -> None:
    """Entry point of the `tracklake` command."""
    keep_freed_memory()
    guard_streams()
    app()


if __name__ == "__main__":
    main()
