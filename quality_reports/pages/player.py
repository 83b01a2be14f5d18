"""Data of the scene player: where it begins and ends, its road, its findings and its packed entries."""

import json
from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
from markupsafe import Markup

from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.quality_reports.plots.scenes import (
    Selection,
    Window,
    find_stretches,
    pack_entries,
    prepare_entries,
    select_ticks,
)
from tracklake.quality_reports.plots.time_space import find_top_speed
from tracklake.quality_reports.summaries import Connection, Row, query, query_frame

RATE_HZ = 5.0
"""Scenes per second; the nearest rate that divides the source's is taken."""
AROUND_S = 5.0
"""Time before and after a finding, and the longest shown part of the finding itself, in seconds."""
FIRST_S = 120.0
"""Time from the recording's beginning, in seconds, as far as it fits."""
MOST_BYTES = 1_500_000
"""Greatest size of the packed entries in a page, in bytes."""
COLOURS = 64
"""Number of colours of speeds."""
SIZES = {"vehicle_id": pl.Int32, "length_m": pl.Float64, "width_m": pl.Float64}
"""Columns of the vehicles' sizes."""


def make_player(
    connection: Connection, where: Mapping[str, str], extent: Row, examples: Sequence[Row], rate_hz: float
) -> Row | None:
    """Make the player's `data` (JSON as markup), and say what it holds; None where no entry is in it.

    Args:
        connection: connection to a lake.
        where: dataset and subset.
        extent: row of subset_extent.sql.
        examples: listed findings, the gravest first: rule, vehicle_id, first_frame, last_frame.
        rate_hz: frame rate of the subset.
    """
    stride = max(1, round(rate_hz / RATE_HZ))
    road = query(connection, "subset_scene_road", {**where, "stride": stride})[0]
    windows = [_find_window(example, road, rate_hz, stride) for example in examples]
    last_of_first = min(road["last_tick"], road["first_tick"] + round(FIRST_S * rate_hz / stride))
    first = (road["first_tick"], last_of_first)
    ticks = np.unique(np.concatenate([np.arange(begin, end + 1) for begin, end in [first, *windows]]))
    if not ticks.size:
        return None
    # Text, since DuckDB looks for pandas once for every number of a list.
    frames = {"frames": ",".join(map(str, (ticks * stride).tolist())), "stride": stride}
    found = query_frame(connection, "subset_scene", {**where, **frames}).sort("vehicle_id", "frame")
    if found.is_empty():
        return None
    entries = prepare_entries(found.with_columns(tick=pl.col("frame") // stride))
    selection = select_ticks(entries, windows, first, MOST_BYTES)
    if not selection.ticks.size:
        return None
    content = {
        "seconds": stride / rate_hz,
        "zero_s": extent["first_s"] - extent["first_frame"] / rate_hz,
        "stretches": find_stretches(selection.ticks),
        "markings": road["lane_markings_m"],
        "lanes": _find_lanes(entries),
        "x_m": entries.select(low=pl.col("x_m").min(), high=pl.col("x_m").max()).row(0),
        "y_m": entries.select(low=pl.col("y_m").min(), high=pl.col("y_m").max()).row(0),
        "top_mps": find_top_speed(extent),
        "colours": colour_values(np.linspace(0.0, 1.0, COLOURS), 0, 1),
        "findings": _list_findings(connection, where, examples, windows, selection, stride),
        **pack_entries(entries, pl.DataFrame(road["sizes"] or [], schema=SIZES), selection.ticks),
    }
    text = json.dumps(content, separators=(",", ":"), sort_keys=True).replace("<", "\\u003c")
    return {
        "data": Markup(text),  # numbers, base64 and names of rules; no "<" is left
        "accepted": selection.accepted,
        "first_s": selection.first_ticks * stride / rate_hz,
        "seconds": len(selection.ticks) * stride / rate_hz,
        "rate_hz": rate_hz / stride,
        "megabytes": len(text) / 1e6,
    }


def _find_window(example: Row, road: Row, rate_hz: float, stride: int) -> Window:
    """Return the ticks around a finding, within the recording."""
    around = AROUND_S * rate_hz
    begin = int((example["first_frame"] - around) // stride)
    end = int((min(example["last_frame"], example["first_frame"] + around) + around) // stride) + 1
    return max(road["first_tick"], begin), min(road["last_tick"], end)


def _find_lanes(entries: pl.DataFrame) -> list[list[float]]:
    """Return each lane with the median of its entries' y_m."""
    lanes = entries.drop_nulls("lane").group_by("lane").agg(pl.col("y_m").median()).sort("lane")
    return [[lane, round(y_m, 2)] for lane, y_m in lanes.iter_rows()]


def _list_findings(
    connection: Connection,
    where: Mapping[str, str],
    examples: Sequence[Row],
    windows: Sequence[Window],
    selection: Selection,
    stride: int,
) -> list[Row]:
    """List the findings in the player, with the vehicles that it keeps in view."""
    overlaps = [example for example in examples if example["rule"] == "overlap"]
    frames = {
        "vehicles": [example["vehicle_id"] for example in overlaps],
        "frames": [example["first_frame"] for example in overlaps],
    }
    rows = query(connection, "subset_overlap_partners", {**where, **frames}) if overlaps else []
    partners = {(row["vehicle_id"], row["frame"]): row["partner_id"] for row in rows}
    listed = []
    for number, (example, window) in enumerate(zip(examples, windows, strict=True)):
        if selection.accepted[number]:
            own = example["vehicle_id"]
            partner = partners.get((own, example["first_frame"])) if example["rule"] == "overlap" else None
            listed.append(
                {
                    "number": number,
                    "rule": example["rule"],
                    "vehicles": [own] if partner is None else [own, partner],
                    "from": window[0],
                    "to": window[1],
                    "begins": round(example["first_frame"] / stride, 3),
                    "ends": round(example["last_frame"] / stride, 3),
                }
            )
    return listed
