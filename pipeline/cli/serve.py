"""`tracklake serve`: the flows as Prefect deployments."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings, refuse_address
from tracklake.pipeline.cli.options import FolderOption
from tracklake.pipeline.orchestration.prefect_home import import_flows

MIN_INTERVAL_S = 1.0
"""Shortest time between two scheduled runs, in seconds."""


def serve(
    source: Annotated[
        Path | None, typer.Argument(metavar="[SOURCE]", help="A raw file, or a folder to watch with a schedule.")
    ] = None,
    lake: FolderOption = None,
    cron: Annotated[
        str | None, typer.Option("--cron", help="When to run the pipeline on SOURCE, such as '0 3 * * *'.")
    ] = None,
    interval: Annotated[
        float | None,
        typer.Option("--interval", metavar="SECONDS", min=MIN_INTERVAL_S, help="Run it again after so many seconds."),
    ] = None,
) -> None:
    """Serve the flows as Prefect deployments, by hand or on a schedule, until interrupted."""
    with command():
        if cron is not None and interval is not None:
            raise typer.BadParameter("give --cron or --interval, not both")
        if source is None and (cron is not None or interval is not None):
            raise typer.BadParameter("--cron and --interval need SOURCE, the file or folder to run on")
        place = refuse_address(read_settings(lake=lake, in_folder=False))
        import_flows()
        deployments = import_module("tracklake.pipeline.orchestration.deployments")
        deployments.serve_deployments(place, source, cron, interval)
