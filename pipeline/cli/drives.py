"""Drives of a lake for the terminal: what each holds, and which are synthetic."""

from typing import Any

import polars as pl

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.lake import Manifest, scan
from tracklake.pipeline.lake.places import LakePlace
from tracklake.schemas import DRIVES, STATIONS
from tracklake.schemas.origin import describe_synthetic

SHOWN = ("subset", "recording", "origin", "seconds", "stations", "messages", "scans", "images")
"""Columns of `drives` that are shown of each; stations and messages are those of other vehicles, as in the report."""


def list_drives(place: LakePlace, manifest: Manifest) -> list[dict[str, Any]]:
    """Return what a lake's drives hold, sorted by name."""
    others = (
        scan(place, manifest, STATIONS)
        .filter(~pl.col("own"))
        .group_by("subset")
        .agg(stations=pl.len(), messages=pl.col("messages").sum())
    )
    drives = scan(place, manifest, DRIVES).drop("stations", "messages").join(others, on="subset", how="left")
    counted = drives.with_columns(pl.col("stations", "messages").fill_null(0))
    return counted.select(SHOWN).sort("subset").collect().to_dicts()


def print_drives(terminal: Terminal, drives: list[dict[str, Any]]) -> None:
    """Print a row per drive, and what of them is synthetic; nothing where there is none."""
    if not drives:
        return
    terminal.print_origin(
        describe_synthetic({row["subset"]: row["origin"] for row in drives}, noun="drive", maker="instrument")
    )
    rows = [
        [row["subset"], row["origin"], *(f"{row[name]:,}" for name in SHOWN[4:]), f"{row['seconds']:,.1f}"]
        for row in drives
    ]
    print_table(terminal, ("drive", "origin", *SHOWN[4:], "s"), rows, right=(False, False, *[True] * 5), fold=True)
