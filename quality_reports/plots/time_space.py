"""Time-space diagrams as small integers: every lane's tracks coloured by speed, with marks where errors were found."""

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.quality_reports.plots.axes import draw_text, make_ticks, wrap_svg
from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.quality_reports.plots.scenes import LARGEST_STEP, pack_speeds

MOST_POINTS, MOST_MARKS = 100_000, 3_000
"""Greatest number of points and of marks in a page."""
FASTEST_MPS = 60.0
"""Speed up to which the points of a track are joined, in m/s; behind a faster step a new segment begins."""
NO_LANE = -1
"""Packed lane of entries without one."""
SPEED_STEP_MPS = 5
"""Step of the colour scale's upper end, in m/s."""
COLOURS = 48
"""Number of colours of speeds."""


def find_top_speed(extent: Mapping[str, Any]) -> float:
    """Return the upper end of a subset's colour scale, in m/s; `extent` is a row of subset_extent.sql."""
    return float(SPEED_STEP_MPS * max(1, math.ceil((extent["fast_mps"] or 0) / SPEED_STEP_MPS)))


def choose_step(entries: int, stride: int) -> int:
    """Return the frames between points of a track: a multiple of `stride` that makes MOST_POINTS at most."""
    return stride * max(1, math.ceil(entries / stride / MOST_POINTS))


def pack_diagrams(points: pl.DataFrame, errors: pl.DataFrame, step: int, rate_hz: float) -> dict[str, Any]:
    """Pack tracks and marks for the page's script.

    `segments` holds five 32-bit integers per segment: lane (NO_LANE: none), vehicle, first tick, points, and x in
    units of `unit_m`. `points` holds two bytes per point: the step of x since the point before, 0 for a segment's
    first, and speed (km/h + 40, unsigned). `marks` lists lane, tick, x_m, findings, rule and vehicle of the first.

    Args:
        points: vehicle_id, frame, lane, x_m, speed_mps at frames that are multiples of `step`.
        errors: vehicle_id, rule, first_frame, last_frame of findings of severity error.
        step: frames from one tick to the next.
        rate_hz: frames per second.
    """
    seconds = step / rate_hz
    unit_m = math.ceil(FASTEST_MPS * seconds / LARGEST_STEP * 10) / 10
    placed = points.select(
        pl.col("lane").cast(pl.Int32).fill_null(NO_LANE),
        "vehicle_id",
        "frame",
        "x_m",
        (pl.col("frame") // step).alias("tick"),
        (pl.col("x_m") / unit_m).round().cast(pl.Int32).alias("x"),
        pack_speeds().alias("speed"),
    ).sort("lane", "vehicle_id", "tick")
    follows = (
        (pl.col("lane").diff() == 0)
        & (pl.col("vehicle_id").diff() == 0)
        & (pl.col("tick").diff() == 1)
        & (pl.col("x").diff().abs() <= LARGEST_STEP)
    ).fill_null(value=False)
    placed = placed.with_columns(step_of_x=pl.when(follows).then(pl.col("x").diff()).otherwise(0), begins=~follows)
    starts = np.flatnonzero(placed["begins"].to_numpy())
    heads = placed[starts].select(
        "lane", "vehicle_id", "tick", pl.Series("points", np.diff(starts, append=placed.height)), "x"
    )
    bytes_of_points: NDArray[np.uint8] = np.empty((placed.height, 2), np.uint8)
    bytes_of_points[:, 0] = placed["step_of_x"].cast(pl.Int8).to_numpy().view(np.uint8)
    bytes_of_points[:, 1] = placed["speed"].to_numpy()
    return {
        "seconds": seconds,
        "unit_m": unit_m,
        "segments": _encode(heads.to_numpy().astype("<i4")),
        "points": _encode(bytes_of_points),
        "marks": [list(row) for row in place_marks(placed, errors).iter_rows()],
    }


def place_marks(points: pl.DataFrame, errors: pl.DataFrame, most: int = MOST_MARKS) -> pl.DataFrame:
    """Place findings at the nearest point in time of their vehicle's track; those of a cell share a mark.

    Args:
        points: lane, vehicle_id, frame, tick, x_m.
        errors: vehicle_id, rule, first_frame, last_frame.
        most: greatest number of marks.

    Returns:
        Rows of lane, tick, x_m, findings, rule and vehicle_id: those of the first finding in a cell.
    """
    found = errors.with_columns(frame=(pl.col("first_frame") + pl.col("last_frame")) // 2).sort("frame")
    placed = found.join_asof(
        points.sort("frame"), on="frame", by="vehicle_id", strategy="nearest", check_sortedness=False
    ).drop_nulls("tick")
    cell = 1
    while placed.select(pl.struct(_find_cell(cell)).n_unique()).item() > most:
        cell *= 2
    first = pl.col("tick", "x_m", "rule", "vehicle_id").first().name.prefix("first_")
    return (
        placed.group_by(_find_cell(cell), maintain_order=True)
        .agg(first, pl.len().alias("findings"))
        .select("lane", "first_tick", pl.col("first_x_m").round(1), "findings", "first_rule", "first_vehicle_id")
    )


def _find_cell(size: int) -> list[pl.Expr]:
    """Return the cell of a mark: its lane, and `size` ticks and metres each."""
    return [pl.col("lane"), (pl.col("tick") // size).alias("column"), (pl.col("x_m") // size).alias("row")]


def _encode(numbers: NDArray[Any]) -> str:
    """Return numbers as base64."""
    return base64.b64encode(numbers.tobytes()).decode("ascii")


def write_data(content: Mapping[str, Any]) -> str:
    """Return data of a page's script as JSON that ends no element."""
    return json.dumps(content, separators=(",", ":"), sort_keys=True).replace("<", "\\u003c")


def draw_scale(top_mps: float) -> str:
    """Draw the legend of speeds: colours between km/h above and m/s below."""
    left, width, top_kmh = 36, 290, top_mps * 3.6
    colours = colour_values(np.linspace(0.0, 1.0, COLOURS), 0, 1)
    wide = width / COLOURS
    strip = "".join(
        f'<path d="M{left + wide * number:.1f} 18h{wide + 0.3:.1f}v12h-{wide + 0.3:.1f}Z" fill="{colour}"/>'
        for number, colour in enumerate(colours)
    )
    labels = "".join(
        draw_text(f"{left + width * value / top:.1f}", height, f"{value:g}", anchor="middle")
        for top, height, most in ((top_kmh, 12, 6), (top_mps, 44, 6))
        for value in make_ticks(0.0, top, most)
    )
    units = draw_text(left - 6, 12, "km/h", anchor="end") + draw_text(left - 6, 44, "m/s", anchor="end")
    return wrap_svg(left + width + 12, 50, "Legend: colours of speeds", strip + labels + units)
