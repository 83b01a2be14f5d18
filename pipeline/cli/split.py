"""`tracklake split`: the stage, or with --plan the allocation that highD's metadata alone allow to plan.

Like the other commands, it imports heavy libraries where they are used.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import REFUSED, carry_out, command, conclude, read_settings

if TYPE_CHECKING:
    import polars as pl

    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.settings import Settings
    from tracklake.pipeline.transforms.splits.tables import Allocation

FORMATS = ("table", "csv", "json")
ESTIMATED = (
    "weights are numFrames of tracksMeta, all entries of a vehicle: which of them are samples is known only to a lake, "
    "and so is which subsets validation excludes (--exclude leaves some out)"
)
SHOWN = ("dataset", "subset", "site", "direction", "vehicles", "weight", "flow", "part")


def split(
    lake: LakeOption = None,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan",
            metavar="FOLDER",
            help="Only print how the highD recordings in FOLDER would be split, by their metadata.",
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option("--exclude", metavar="SUBSET", help="With --plan: leave it out; repeatable.")
    ] = None,
    format: Annotated[str, typer.Option("--format", help="With --plan: table, csv or json.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="With --plan: write the csv or json to this file.")] = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Divide the subsets into train and eval, or plan from metadata how they would be divided."""
    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake, workers=workers, protocol=protocol)
        if plan is None:
            if exclude or out is not None or format != "table":
                raise typer.BadParameter("--exclude, --format and --out go with --plan FOLDER")
            conclude(terminal, settings, carry_out(terminal, settings, ("split",)), headline=False)
            return
        if format not in FORMATS:
            raise typer.BadParameter(f"--format is one of {', '.join(FORMATS)}; got {format!r}")
        if out is not None and format == "table":
            raise typer.BadParameter("--format table goes to the terminal only: with --out, choose csv or json")
        _plan(terminal, settings, plan, exclude or [], format, out)


def _plan(
    terminal: "Terminal", settings: "Settings", folder: Path, exclude: list[str], form: str, out: Path | None
) -> None:
    """Print the allocation, and what it rests on; nothing is written into a lake."""
    import polars as pl

    from tracklake.pipeline.ingest.discovery import recognise
    from tracklake.pipeline.sources import SourceError
    from tracklake.pipeline.sources.highd_plan import announce_subsets
    from tracklake.pipeline.transforms.splits.allocation import allocate_flow_balanced

    try:
        announced = announce_subsets(recognise(folder, "highd"))
    except SourceError as nothing:
        named = str(nothing).startswith(f"{folder}:")
        raise SourceError(str(nothing) if named else f"{folder}: {nothing}") from None
    for message in announced.refusals:
        terminal.complain(message, label="refused")
    unknown = sorted(set(exclude) - set(announced.subsets["subset"]))
    if unknown:
        known = announced.subsets["subset"].to_list()
        raise typer.BadParameter(f"--exclude {', '.join(unknown)}: no such subset; there are {', '.join(known)}")
    subsets = announced.subsets.filter(~pl.col("subset").is_in(exclude))
    if subsets.is_empty():
        raise SourceError(f"{folder}: no recording whose metadata can be used, so there is nothing to plan.")
    allocation = allocate_flow_balanced(
        subsets,
        train_share=settings.get_protocol().train_share,
        validation=settings.validation_part,
        seed=settings.split_seed,
    )
    parts = subsets.join(allocation.splits.select("dataset", "subset", "part"), on=["dataset", "subset"])
    parts = parts.select(SHOWN).sort("dataset", "subset")
    _show(terminal, parts, allocation, form, out)
    record: dict[str, Any] = {
        "splits": parts.to_dicts(),
        "balance": allocation.balance.to_dicts(),
        "notes": [ESTIMATED],
        "refused": list(announced.refusals),
    }
    terminal.give(record)
    if announced.refusals:
        raise typer.Exit(REFUSED)


def _show(terminal: "Terminal", parts: "pl.DataFrame", allocation: "Allocation", form: str, out: Path | None) -> None:
    """The table in the form that was asked for; beneath it, for people, how the parts compare."""
    if form != "table" and not (terminal.as_json and out is None):
        text = parts.write_csv() if form == "csv" else parts.write_json() + "\n"
        if out is None:
            sys.stdout.write(text)
            return
        from tracklake.schemas.errors import explain_file_errors

        with explain_file_errors(out):
            out.write_text(text, encoding="utf-8")
        terminal.say(f"{parts.height:,} subsets in {out}")
    elif terminal.talks:
        _print_rows(terminal, parts)
    for row in allocation.balance.reverse().iter_rows(named=True):
        if row["flow_mean"] is None:
            terminal.say(f"{row['part']}: nothing")
            continue
        terminal.say(
            f"{row['part']}: {row['subsets']} subsets, {row['vehicle_share']:.2%} of the vehicles, flow "
            f"{row['flow_mean']:.5f} +- {row['flow_std']:.5f} veh/lane/s"
        )
    for reason in allocation.relaxations.values():
        terminal.say(f"note: relaxed: {reason}", style="dim")
    terminal.say(f"note: {ESTIMATED}", style="dim")


def _print_rows(terminal: "Terminal", parts: "pl.DataFrame") -> None:
    from rich.table import Table

    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name, dtype in parts.schema.items():
        table.add_column(name, justify="right" if dtype.is_numeric() else "left")
    for row in parts.iter_rows():
        table.add_row(*(f"{value:.4f}" if isinstance(value, float) else str(value) for value in row))
    terminal.out.print(table)
