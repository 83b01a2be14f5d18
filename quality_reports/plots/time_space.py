"""Time-space diagrams: one raster per lane, coloured by mean speed, with marks where errors were found."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from tracklake.quality_reports.plots.axes import (
    Scale,
    draw_frame,
    draw_path,
    draw_text,
    format_points,
    make_ticks,
    wrap_svg,
)
from tracklake.quality_reports.plots.rasters import LEVELS, encode_uri, grade_values
from tracklake.schemas.arrays import Floats

COLUMNS, ROWS = 1000, 140
"""Most cells of a raster, in time and along the road."""
LEAST_SECONDS, LEAST_METRES = 0.2, 1.0
"""Least size of a cell; in smaller ones the gaps between entries, 0.04 or 0.1 s apart, would look like data."""
MARK_COLUMNS, MARK_ROWS = 8, 7
"""Cells of the raster, in time and along the road, that share one mark; this bounds the number of marks."""
MARK_PIXELS = 3
"""Half of a mark's width, in pixels."""
SPEED_STEP_MPS = 5
"""Step of the colour scale's upper end, in m/s."""
PANEL, HALO, MARK = "#f4f6f8", "#ffffff", "#000000"
LEFT, RIGHT, TOP, WIDTH, HEIGHT, BOTTOM = 52, 14, 24, 1000, 140, 40
"""Margins and size of a diagram, in pixels; WIDTH includes the margins."""
CROSS = "l6 6m0-6l-6 6"
"""Path of a mark from its upper left corner."""


@dataclass(frozen=True)
class Grid:
    """Cells of a subset's diagrams.

    Args:
        first_s: beginning of the first column.
        seconds: length of a column.
        columns: number of columns.
        first_x_m: beginning of the first row.
        metres: length of a row.
        rows: number of rows.
        top_mps: upper end of the colour scale.
    """

    first_s: float
    seconds: float
    columns: int
    first_x_m: float
    metres: float
    rows: int
    top_mps: float

    def parameters(self, columns: int = 1, rows: int = 1) -> dict[str, float]:
        """Return the parameters of the statements that count cells of so many columns and rows."""
        cell = {"seconds": self.seconds * columns, "metres": self.metres * rows}
        return {"first_s": self.first_s, "first_x_m": self.first_x_m, **cell}


def make_grid(extent: Mapping[str, Any]) -> Grid:
    """Divide a subset's recording and road into at most COLUMNS x ROWS cells.

    Args:
        extent: row of subset_extent.sql, of a subset with entries.
    """
    duration, length = extent["last_s"] - extent["first_s"], extent["last_x_m"] - extent["first_x_m"]
    # A little more than the extent, so that the last entry lies within the last cell.
    seconds = max(LEAST_SECONDS, duration * 1.0001 / COLUMNS)
    metres = max(LEAST_METRES, length * 1.0001 / ROWS)
    return Grid(
        first_s=extent["first_s"],
        seconds=seconds,
        columns=math.floor(duration / seconds) + 1,
        first_x_m=extent["first_x_m"],
        metres=metres,
        rows=math.floor(length / metres) + 1,
        top_mps=find_top_speed(extent),
    )


def find_top_speed(extent: Mapping[str, Any]) -> float:
    """Return the upper end of a subset's colour scale, in m/s; `extent` is a row of subset_extent.sql."""
    return float(SPEED_STEP_MPS * max(1, math.ceil((extent["fast_mps"] or 0) / SPEED_STEP_MPS)))


def draw_lanes(grid: Grid, cells: pl.DataFrame, marks: pl.DataFrame) -> list[tuple[int | None, str]]:
    """Draw the diagrams as (lane, svg), the leftmost lane first; lane is None for entries without one.

    Args:
        grid: cells of the subset.
        cells: lane, grid_column, grid_row, speed_mps: rows of subset_time_space.sql.
        marks: lane, grid_column, grid_row: rows of subset_errors.sql on cells of MARK_COLUMNS by MARK_ROWS.
    """
    drawn = []
    for lane in cells["lane"].unique().sort().to_list():
        in_lane = pl.col("lane").eq_missing(pl.lit(lane))
        drawn.append((lane, _draw_lane(grid, cells.filter(in_lane), marks.filter(in_lane))))
    return drawn


def rasterise(grid: Grid, cells: pl.DataFrame) -> Floats:
    """Return speeds as (rows, columns), the road's end uppermost; NaN in cells without entries."""
    speeds = np.full((grid.rows, grid.columns), np.nan)
    row = np.clip(cells["grid_row"].to_numpy(), 0, grid.rows - 1)
    column = np.clip(cells["grid_column"].to_numpy(), 0, grid.columns - 1)
    speeds[grid.rows - 1 - row, column] = cells["speed_mps"].to_numpy()
    return speeds


def _draw_lane(grid: Grid, cells: pl.DataFrame, marks: pl.DataFrame) -> str:
    """Draw the diagram of one lane."""
    x = Scale(grid.first_s, grid.first_s + grid.columns * grid.seconds, LEFT, WIDTH - RIGHT)
    y = Scale(grid.first_x_m, grid.first_x_m + grid.rows * grid.metres, TOP + HEIGHT, TOP)
    image = encode_uri(grade_values(rasterise(grid, cells), 0, grid.top_mps))
    wide = WIDTH - LEFT - RIGHT
    time_s = grid.first_s + (marks["grid_column"].to_numpy() + 0.5) * MARK_COLUMNS * grid.seconds
    x_m = grid.first_x_m + (marks["grid_row"].to_numpy() + 0.5) * MARK_ROWS * grid.metres
    # The last cells may reach beyond the raster.
    at = format_points(
        np.minimum(x.to_pixels(time_s), x.end) - MARK_PIXELS, np.maximum(y.to_pixels(x_m), y.end) - MARK_PIXELS
    )
    crosses = "".join(f"M{point}{CROSS}" for point in at.tolist())
    return wrap_svg(
        WIDTH,
        TOP + HEIGHT + BOTTOM,
        "Time-space diagram coloured by speed",
        f'<rect x="{LEFT}" y="{TOP}" width="{wide}" height="{HEIGHT}" fill="{PANEL}"/>'
        + draw_frame(x, y, "time since the recording began (s)", "position (m)", x_ticks=10, y_ticks=5)
        + f'<image x="{LEFT}" y="{TOP}" width="{wide}" height="{HEIGHT}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="{image}"/>' + (_draw_marks(crosses) if crosses else ""),
    )


def _draw_marks(crosses: str) -> str:
    """Draw marks with a halo around them."""
    return draw_path(crosses, HALO, 3.6) + draw_path(crosses, MARK, 1.6)


def draw_scale(grid: Grid) -> str:
    """Draw the legend of the diagrams: the colours of speeds, and the mark."""
    x = Scale(0, grid.top_mps, 12, 332)
    strip = encode_uri(np.arange(1, LEVELS + 1, dtype=np.uint8)[None, :])
    labels = "".join(
        draw_text(f"{x.to_pixels(value):.1f}", 36, f"{value:g}", anchor="middle")
        for value in make_ticks(x.low, x.high, 6)
    )
    cell = f"mean speed in a cell of {grid.seconds:.2g} s by {grid.metres:.2g} m (m/s)"
    return wrap_svg(
        760,
        56,
        "Legend: colour of mean speed, and the mark of errors",
        f'<image x="12" y="8" width="320" height="14" preserveAspectRatio="none" href="{strip}"/>{labels}'
        + draw_text(172, 51, cell, anchor="middle")
        + f'<rect x="461" y="5" width="24" height="20" fill="{PANEL}"/>'
        + _draw_marks(f"M470 12{CROSS}")
        + draw_text(493, 19, "findings of severity error near here"),
    )
