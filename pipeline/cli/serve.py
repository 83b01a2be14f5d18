"""`tracklake serve`: the flows as Prefect deployments."""

import os

import typer

from tracklake.pipeline.cli.command import FAILED, command
from tracklake.pipeline.orchestration.flows import serve_deployments


def serve() -> None:
    """Serve the flows as Prefect deployments (run, ingest, quality) until interrupted."""
    if not os.environ.get("PREFECT_API_URL"):
        typer.echo("PREFECT_API_URL is not set: no server would record the runs. Start one, for instance", err=True)
        typer.echo("  prefect server start\n  export PREFECT_API_URL=http://127.0.0.1:4200/api", err=True)
        raise typer.Exit(FAILED)
    with command():
        serve_deployments()
