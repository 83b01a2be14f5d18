"""Data of the scene player: its road, its findings and its packed entries."""

from collections.abc import Sequence

import numpy as np
import polars as pl
from markupsafe import Markup

from tracklake.quality_reports.pages.subset_scenes import SubsetScenes
from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.quality_reports.plots.scenes import (
    Selection,
    find_stretches,
    pack_entries,
    prepare_entries,
    select_ticks,
)
from tracklake.quality_reports.plots.time_space import find_top_speed, write_data
from tracklake.quality_reports.summaries import Row

MOST_BYTES = 1_500_000
"""Greatest size of the packed entries in a page, in bytes."""
COLOURS = 64
"""Number of colours of speeds."""


def make_player(scenes: SubsetScenes, extent: Row, examples: Sequence[Row]) -> Row | None:
    """Make the player's `data` (JSON as markup), and say what it holds; None where no entry is in it.

    Args:
        scenes: scenes of the subset.
        extent: row of subset_extent.sql.
        examples: listed findings, the gravest first.
    """
    ticks = pl.Series(scenes.ticks).implode()
    entries = prepare_entries(
        scenes.entries.filter(pl.col("frame") % scenes.stride == 0)
        .with_columns(tick=pl.col("frame") // scenes.stride)
        .filter(pl.col("tick").is_in(ticks))
    )
    if entries.is_empty():
        return None
    selection = select_ticks(entries, scenes.windows, scenes.first, MOST_BYTES)
    if not selection.ticks.size:
        return None
    seconds = scenes.stride / scenes.rate_hz
    content = {
        "seconds": seconds,
        "zero_s": find_zero(extent, scenes),
        "stretches": find_stretches(selection.ticks),
        "markings": scenes.markings,
        "lanes": scenes.lanes,
        "x_m": entries.select(low=pl.col("x_m").min(), high=pl.col("x_m").max()).row(0),
        "y_m": entries.select(low=pl.col("y_m").min(), high=pl.col("y_m").max()).row(0),
        "top_mps": find_top_speed(extent),
        "colours": colour_values(np.linspace(0.0, 1.0, COLOURS), 0, 1),
        "findings": _list_findings(examples, scenes, selection),
        **pack_entries(entries, selection.ticks),
    }
    text = write_data(content)
    return {
        "data": Markup(text),  # numbers, base64 and names of rules; no "<" is left
        "accepted": selection.accepted,
        "first_s": selection.first_ticks * seconds,
        "seconds": len(selection.ticks) * seconds,
        "rate_hz": 1 / seconds,
        "megabytes": len(text) / 1e6,
    }


def find_zero(extent: Row, scenes: SubsetScenes) -> float:
    """Return the time of frame 0, in seconds."""
    return float(extent["first_s"] - extent["first_frame"] / scenes.rate_hz)


def _list_findings(examples: Sequence[Row], scenes: SubsetScenes, selection: Selection) -> list[Row]:
    """List the findings in the player, with the vehicles that it keeps in view."""
    listed = []
    for number, (example, window, partner) in enumerate(zip(examples, scenes.windows, scenes.partners, strict=True)):
        if selection.accepted[number]:
            own = example["vehicle_id"]
            listed.append(
                {
                    "number": number,
                    "rule": example["rule"],
                    "vehicles": [own] if partner is None else [own, partner],
                    "from": window[0],
                    "to": window[1],
                    "begins": round(example["first_frame"] / scenes.stride, 3),
                    "ends": round(example["last_frame"] / scenes.stride, 3),
                }
            )
    return listed
