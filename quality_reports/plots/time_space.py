"""Time-space diagrams: one raster per lane, coloured by mean speed, with the cells that hold errors marked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from tracklake.quality_reports.plots.axes import Scale, draw_frame, wrap_svg, write_points
from tracklake.quality_reports.plots.rasters import LEVELS, encode_uri, grade
from tracklake.schemas.chart_theme import MUTED

COLUMNS, ROWS = 1000, 140
"""Cells at most: about one per pixel across, and along the road."""
LEAST_SECONDS, LEAST_METRES = 0.2, 1.0
"""No finer: entries are 0.04 or 0.1 s and up to some metres apart, and gaps between them would look like data."""
MARK_COLUMNS, MARK_ROWS = 8, 7
"""Cells of the raster that share one mark, so that marks can be told apart and are bounded in number."""
MARK_PIXELS = 3
"""Half of a mark's width."""
SPEED_STEP_MPS = 5
PANEL, HALO, MARK = "#f4f6f8", "#ffffff", "#000000"
LEFT, RIGHT, TOP, WIDTH, HEIGHT, BOTTOM = 52, 14, 24, 1000, 140, 40


@dataclass(frozen=True)
class Grid:
    """Where the cells of a subset's diagrams lie.

    Args:
        first_s: the first column's beginning.
        seconds: of a column.
        columns: how many.
        first_x_m: the first row's beginning.
        metres: of a row.
        rows: how many.
        top_mps: the colour scale ends here.
    """

    first_s: float
    seconds: float
    columns: int
    first_x_m: float
    metres: float
    rows: int
    top_mps: float

    def parameters(self, columns: int = 1, rows: int = 1) -> dict[str, float]:
        """What subset_time_space.sql and subset_errors.sql take, for cells of so many columns and rows."""
        cell = {"seconds": self.seconds * columns, "metres": self.metres * rows}
        return {"first_s": self.first_s, "first_x_m": self.first_x_m, **cell}


def lay_grid(extent: Mapping[str, Any]) -> Grid:
    """The grid of a subset: its whole recording and road, in at most COLUMNS x ROWS cells.

    Args:
        extent: the row of subset_extent.sql; not of an empty subset.
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
        top_mps=SPEED_STEP_MPS * max(1, math.ceil((extent["fast_mps"] or 0) / SPEED_STEP_MPS)),
    )


def draw_lanes(grid: Grid, cells: pl.DataFrame, marks: pl.DataFrame) -> list[tuple[int | None, str]]:
    """The diagrams as (lane, svg), the leftmost lane first; lane is None for entries without one.

    Args:
        grid: where the cells lie.
        cells: lane, grid_column, grid_row, speed_mps: rows of subset_time_space.sql.
        marks: lane, grid_column, grid_row: rows of subset_errors.sql on cells of MARK_COLUMNS by MARK_ROWS.
    """
    lanes = cells["lane"].unique().sort().to_list()
    return [
        (
            lane,
            _draw_lane(
                grid,
                cells.filter(pl.col("lane").eq_missing(pl.lit(lane))),
                marks.filter(pl.col("lane").eq_missing(pl.lit(lane))),
            ),
        )
        for lane in lanes
    ]


def rasterise(grid: Grid, cells: pl.DataFrame) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Speeds as (rows, columns), the road's end uppermost; NaN in cells without entries."""
    speeds = np.full((grid.rows, grid.columns), np.nan)
    row = np.clip(cells["grid_row"].to_numpy(), 0, grid.rows - 1)
    column = np.clip(cells["grid_column"].to_numpy(), 0, grid.columns - 1)
    speeds[grid.rows - 1 - row, column] = cells["speed_mps"].to_numpy()
    return speeds


def _draw_lane(grid: Grid, cells: pl.DataFrame, marks: pl.DataFrame) -> str:
    x = Scale(grid.first_s, grid.first_s + grid.columns * grid.seconds, LEFT, WIDTH - RIGHT)
    y = Scale(grid.first_x_m, grid.first_x_m + grid.rows * grid.metres, TOP + HEIGHT, TOP)
    image = encode_uri(grade(rasterise(grid, cells), 0, grid.top_mps))
    wide = WIDTH - LEFT - RIGHT
    time_s = grid.first_s + (marks["grid_column"].to_numpy() + 0.5) * MARK_COLUMNS * grid.seconds
    x_m = grid.first_x_m + (marks["grid_row"].to_numpy() + 0.5) * MARK_ROWS * grid.metres
    # The last cells may reach beyond the raster.
    at = write_points(
        np.minimum(x.place_all(time_s), x.end) - MARK_PIXELS, np.maximum(y.place_all(x_m), y.end) - MARK_PIXELS
    )
    crosses = "".join(f"M{point}l6 6m0-6l-6 6" for point in at.tolist())
    return wrap_svg(
        WIDTH,
        TOP + HEIGHT + BOTTOM,
        "Time-space diagram coloured by speed",
        f'<rect x="{LEFT}" y="{TOP}" width="{wide}" height="{HEIGHT}" fill="{PANEL}"/>'
        + draw_frame(x, y, "time since the recording began (s)", "position (m)", x_ticks=10, y_ticks=5)
        + f'<image x="{LEFT}" y="{TOP}" width="{wide}" height="{HEIGHT}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="{image}"/>'
        + "".join(
            f'<path d="{crosses}" fill="none" stroke="{colour}" stroke-width="{stroke}" stroke-linecap="round"/>'
            for colour, stroke in ((HALO, 3.6), (MARK, 1.6))
            if crosses
        ),
    )


def draw_scale(grid: Grid) -> str:
    """The legend of the diagrams: the colour of every speed, and the mark."""
    x = Scale(0, grid.top_mps, 12, 332)
    strip = encode_uri(np.arange(1, LEVELS + 1, dtype=np.uint8)[None, :])
    labels = "".join(
        f'<text x="{x.place(value):.1f}" y="36" text-anchor="middle" fill="{MUTED}">{value:g}</text>'
        for value in x.ticks(6)
    )
    cross = "M470 12l6 6m0-6l-6 6"
    return wrap_svg(
        760,
        56,
        "Legend: colour of mean speed, and the mark of errors",
        f'<image x="12" y="8" width="320" height="14" preserveAspectRatio="none" href="{strip}"/>{labels}'
        f'<text x="172" y="51" text-anchor="middle" fill="{MUTED}">mean speed in a cell of {grid.seconds:.2g} s by '
        f"{grid.metres:.2g} m (m/s)</text>"
        f'<rect x="461" y="5" width="24" height="20" fill="{PANEL}"/>'
        f'<path d="{cross}" fill="none" stroke="{HALO}" stroke-width="3.6" stroke-linecap="round"/>'
        f'<path d="{cross}" fill="none" stroke="{MARK}" stroke-width="1.6" stroke-linecap="round"/>'
        f'<text x="493" y="19" fill="{MUTED}">findings of severity error near here</text>',
    )
