"""`tracklake split`: the stage, or with --plan the split that highD's metadata alone allow to plan."""

import sys
from pathlib import Path
from typing import Annotated, Any

import polars as pl
import typer

from tracklake.pipeline.cli.command import REFUSED, command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import (
    JsonOption,
    LakeOption,
    ProtocolOption,
    QuietOption,
    WorkersOption,
    require_choice,
)
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.ingest.discovery import recognise
from tracklake.pipeline.lake import refuse_lake
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.highd_plan import announce_subsets
from tracklake.pipeline.transforms.splits.allocation import allocate_flow_balanced
from tracklake.pipeline.transforms.splits.published import (
    PUBLISHED_SPLITS,
    PublishedSplit,
    compare_published,
    select_published,
)
from tracklake.pipeline.transforms.splits.tables import Allocation
from tracklake.schemas.files import write_output
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.split_recipes import FLOW_BALANCED, SplitRecipe

FORMATS = ("table", "csv", "json")

ESTIMATED = (
    "weights are numFrames of tracksMeta, all entries of a vehicle: which of them are samples is known only to a lake, "
    "and so is which subsets validation excludes (--exclude leaves some out)"
)
"""Note beside a planned split: what its weights are."""

SHOWN = ("dataset", "subset", "site", "direction", "vehicles", "weight", "vehicles_per_lane_s", "part")
"""Columns of a planned split."""


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
    published: Annotated[
        str | None,
        typer.Option(
            "--published",
            metavar="NAME",
            help=f"With --plan of a whole dataset: compare with a published split: {', '.join(PUBLISHED_SPLITS)}.",
        ),
    ] = None,
    format: Annotated[str, typer.Option("--format", help="With --plan: table, csv or json.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="With --plan: write the csv or json to this file.")] = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Divide the subsets into train and eval."""
    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake, workers=workers, protocol=protocol, in_folder=False)
        if plan is None:
            if exclude or published or out is not None or format != "table":
                raise typer.BadParameter("--exclude, --published, --format and --out go with --plan FOLDER")
            with work_in_folder(terminal, settings) as found:
                report_result(terminal, found, run_steps(terminal, found, ("split",)), headline=False)
            return
        require_choice("--format", format, FORMATS)
        if published is not None:
            require_choice("--published", published, tuple(PUBLISHED_SPLITS))
        if out is not None and format == "table":
            raise typer.BadParameter("--format table goes to the terminal only: with --out, choose csv or json")
        refuse_lake(out)
        known = None if published is None else PUBLISHED_SPLITS[published]
        _plan_split(terminal, settings, plan, exclude or [], known, format, out)


def _plan_split(
    terminal: Terminal,
    settings: Settings,
    folder: Path,
    exclude: list[str],
    published: PublishedSplit | None,
    form: str,
    out: Path | None,
) -> None:
    """Print how the recordings of a folder would be split; nothing is written into a lake."""
    try:
        announced = announce_subsets(recognise(folder, "highd"))
    except SourceError as error:
        named = str(error).startswith(f"{folder}:")
        raise SourceError(str(error) if named else f"{folder}: {error}") from None
    for message in announced.refusals:
        terminal.print_problem(message, label="refused")
    unknown = sorted(set(exclude) - set(announced.subsets["subset"]))
    if unknown:
        known = announced.subsets["subset"].to_list()
        raise typer.BadParameter(f"--exclude {', '.join(unknown)}: no such subset; there are {', '.join(known)}")
    subsets = announced.subsets if published is None else select_published(announced.subsets, published)
    subsets = subsets.filter(~pl.col("subset").is_in(exclude))
    if subsets.is_empty():
        raise SourceError(f"{folder}: no recording whose metadata can be used, so there is nothing to plan.")
    trained = settings.get_protocol().train_share
    recipe = SplitRecipe(FLOW_BALANCED, trained, settings.validation_part, settings.split_seed)
    allocation = allocate_flow_balanced(subsets, recipe)
    parts = subsets.join(allocation.splits.select("dataset", "subset", "part"), on=["dataset", "subset"])
    terminal.print_origin(describe_synthetic(dict(subsets.select("subset", "origin").iter_rows())))
    parts = parts.select(SHOWN).sort("dataset", "subset")
    beside = None if published is None else compare_published(allocation.balance, published)
    _show_plan(terminal, parts, allocation, beside, form, out)
    record: dict[str, Any] = {
        "splits": parts.to_dicts(),
        "balance": allocation.balance.to_dicts(),
        "notes": [ESTIMATED],
        "published": beside,
        "refused": list(announced.refusals),
    }
    terminal.print_json(record)
    if announced.refusals:
        raise typer.Exit(REFUSED)


def _show_plan(
    terminal: Terminal,
    parts: pl.DataFrame,
    allocation: Allocation,
    beside: dict[str, Any] | None,
    form: str,
    out: Path | None,
) -> None:
    """Print or write the table, and print how the parts compare."""
    if form != "table" and not (terminal.as_json and out is None):
        text = parts.write_csv() if form == "csv" else parts.write_json() + "\n"
        if out is None:
            sys.stdout.write(text)
            return
        write_output(out, text.encode())
        terminal.print_line(f"{parts.height:,} subsets in {out}")
    else:
        rows = [
            [f"{value:.4f}" if isinstance(value, float) else str(value) for value in row] for row in parts.iter_rows()
        ]
        print_table(terminal, parts.columns, rows, right=[dtype.is_numeric() for dtype in parts.dtypes])
    for row in allocation.balance.reverse().iter_rows(named=True):
        if row["vehicles_per_lane_s_mean"] is None:
            terminal.print_line(f"{row['part']}: nothing")
            continue
        terminal.print_line(
            f"{row['part']}: {row['subsets']} subsets, {row['vehicle_share']:.2%} of the vehicles; "
            f"vehicles_per_lane_s {row['vehicles_per_lane_s_mean']:.5f} +- {row['vehicles_per_lane_s_std']:.5f}"
        )
    for reason in allocation.relaxations.values():
        terminal.print_line(f"note: relaxed: {reason}", style="dim")
    if beside is not None:
        flows = ", ".join(f"{part} {own['mean']} +- {own['std']}" for part, own in beside["published"].items())
        terminal.print_line(
            f"published for these {beside['carriageways']} carriageways: {flows}, apart by "
            f"{beside['published_difference']}; here apart by {beside['difference']:.6f}. {beside['reference']}"
        )
    for note in (ESTIMATED, *(beside["notes"] if beside is not None else ())):
        terminal.print_line(f"note: {note}", style="dim")
