"""`tracklake publish ...` and `tracklake fetch`: the lake for others, on an object store."""

from pathlib import Path
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings, refuse_address
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import FolderOption, JsonOption, QuietOption
from tracklake.pipeline.lake.ducklake import publish_ducklake
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.lake.publication import Transfer, fetch_lake, publish_lake
from tracklake.schemas.errors import UsageError

publish = typer.Typer(
    help="Put the lake where others can read it: on an object store, or as a DuckLake catalog.",
    no_args_is_help=True,
    add_completion=False,
)


@publish.callback()
def _publish() -> None:
    """Put the lake where others can read it: on an object store, or as a DuckLake catalog."""


AddressArgument = Annotated[str, typer.Argument(metavar="ADDRESS", help="For instance s3://bucket/lake.")]


@publish.command()
def store(
    address: AddressArgument,
    lake: FolderOption = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace another lake there, or results that this one lacks.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Make the lake at ADDRESS, on an object store, the same as the lake in the folder, in one commit.

    Only what is not there yet is sent. Credentials come from the environment (docs/object-store.md).
    """
    with command(quiet=quiet, json=json) as terminal:
        place = require_address(address)
        root = refuse_address(read_settings(lake=lake, in_folder=False))
        done = publish_lake(root, place, replace_other=replace)
        _show_transfer(terminal, "published", done, root, place)


@publish.command()
def ducklake(lake: FolderOption = None, quiet: QuietOption = False, json: JsonOption = False) -> None:
    """Write catalog.ducklake beside the lake's files: a frozen DuckLake catalog of the tables as they are now.

    Any DuckDB reads it by ATTACH 'ducklake:LAKE/catalog.ducklake' (READ_ONLY), as long as the lake keeps the generation
    that it shows (setting kept_generations). It names files by their full path: write it again after moving the lake.
    """
    with command(quiet=quiet, json=json) as terminal:
        done = publish_ducklake(refuse_address(read_settings(lake=lake, in_folder=False)))
        terminal.print_line(
            f"{done.path}: generation {done.generation}, {done.tables} tables with rows in {done.files:,} files"
        )
        terminal.print_json(done._asdict())


def fetch(
    address: AddressArgument,
    lake: FolderOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Copy a lake from an object store to a folder, or bring that copy up to date.

    Only what is not there yet is received. Credentials come from the environment (docs/object-store.md).
    """
    with command(quiet=quiet, json=json) as terminal:
        place = require_address(address)
        root = refuse_address(read_settings(lake=lake, in_folder=False))
        _show_transfer(terminal, "fetched", fetch_lake(place, root), root, place)


def require_address(address: str) -> str:
    """Return the address that a user gave.

    Raises:
        UsageError: it is none.
    """
    found = find_address(address)
    if found is None:
        raise UsageError(f"{address}: expected an address on an object store, such as s3://bucket/lake")
    return found


def _show_transfer(terminal: Terminal, what: str, done: Transfer, root: Path, address: str) -> None:
    files = f"{done.files:,} {'file' if done.files == 1 else 'files'}"
    swept = f"; {done.deleted:,} old objects deleted" if done.deleted else ""
    terminal.print_line(f"{what} {address}: {files}, {done.bytes / 1e6:,.1f} MB; generation {done.generation}{swept}")
    terminal.print_json({"lake": root, "address": address, **done._asdict()})
