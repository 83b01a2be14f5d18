"""Plots of flow, density and speed: over time, and flow against density."""

import math
from collections.abc import Sequence

import numpy as np
import polars as pl

from tracklake.quality_reports.plots.axes import Scale, draw_frame, draw_line, draw_path, draw_text, wrap_svg
from tracklake.quality_reports.plots.distributions import Row, draw_heading
from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.schemas.chart_theme import BLUE, MUTED

FLOW = (
    ("flow_veh_per_h", "flow (veh/h/lane)"),
    ("density_veh_per_km", "density (veh/km)"),
    ("speed_mps", "speed (m/s)"),
)
"""Columns of subset_flow.sql and their axis titles."""

PANEL_WIDTH, PANEL_HEIGHT, LEFT, TOP, BOTTOM, APART = 250, 80, 58, 40, 38, 28
"""Size of a plot, the margins around it, and the space between two, in pixels."""
SPEEDS_KMH = (20, 60, 100)
"""Speeds of the lines in plots of flow against density, in km/h."""
MOST_LARGE = 100
"""Most marks per lane that are drawn large."""
MOST_COLUMNS, WIDEST = 3, 420
"""Most plots of flow against density side by side, and the greatest width of one, in pixels."""


def draw_flow(intervals: Sequence[Row]) -> str:
    """Draw flow, density and speed against time side by side, one row of plots per lane, on scales shared by the lanes.

    Args:
        intervals: rows of subset_flow.sql, at least one of them with a flow.
    """
    data = pl.DataFrame(list(intervals), infer_schema_length=None).with_columns(
        middle_s=pl.col("start_s") + pl.col("interval_s") / 2
    )
    end_s = max(row["start_s"] + row["interval_s"] for row in intervals)
    lanes = data["lane"].unique(maintain_order=True).to_list()
    drawn = []
    for line, lane in enumerate(lanes):
        top = TOP + line * (PANEL_HEIGHT + BOTTOM + TOP)
        points = data.filter(pl.col("lane").eq_missing(pl.lit(lane))).with_columns(
            follows=(pl.col("interval").diff() == 1).fill_null(value=False)
        )
        drawn.append(draw_heading(LEFT - 40, top - 22, name_lane(lane)))
        for number, (column, title) in enumerate(FLOW):
            left = number * (PANEL_WIDTH + LEFT + APART) + LEFT
            x = Scale(0, end_s, left, left + PANEL_WIDTH)
            low, high = data.select(pl.col(column).min().alias("low"), pl.col(column).max().alias("high")).row(0)
            y = Scale(min(0.0, low or 0.0), 1.05 * max(1.0, high or 0.0), top + PANEL_HEIGHT, top)
            drawn.append(draw_frame(x, y, "time (s)", title, x_ticks=6, y_ticks=4, y_kmh=column == "speed_mps"))
            path = draw_line(points, x, y, column, "middle_s")
            dots = draw_line(points.with_columns(follows=pl.lit(value=False)), x, y, column, "middle_s")
            drawn += [draw_path(path, BLUE, 1.4), draw_path(dots, BLUE, 4)]
    size = len(FLOW) * (PANEL_WIDTH + LEFT + APART), len(lanes) * (PANEL_HEIGHT + BOTTOM + TOP)
    return wrap_svg(*size, "Flow, density and speed over time", "".join(drawn))


def draw_fundamental(intervals: Sequence[Row], top_mps: float) -> str:
    """Draw flow against density: a plot per lane, a mark per interval or cell, coloured by speed, lines of equal speed.

    Args:
        intervals: rows of subset_edie.sql or subset_flow.sql, at least one of them with a flow.
        top_mps: upper end of the colour scale.
    """
    rows = [row for row in intervals if row["entries"]]
    lanes: list[int | None] = list(dict.fromkeys(row["lane"] for row in intervals))
    columns = min(len(lanes), MOST_COLUMNS)
    width, height = min(WIDEST, len(FLOW) * (PANEL_WIDTH + LEFT + APART) // columns - LEFT - APART), 2 * PANEL_HEIGHT
    high = [max(row[name] for row in rows) * 1.05 for name in ("density_veh_per_km", "flow_veh_per_h")]
    radius = 4 if len(rows) <= MOST_LARGE * len(lanes) else 3
    drawn = []
    for number, lane in enumerate(lanes):
        left = number % columns * (width + LEFT + APART) + LEFT
        top = TOP + number // columns * (height + BOTTOM + TOP)
        x, y = Scale(0, high[0], left, left + width), Scale(0, high[1], top + height, top)
        drawn.append(draw_heading(LEFT - 40 + left - LEFT, top - 22, name_lane(lane)))
        drawn.append(draw_frame(x, y, "density (veh/km)", "flow (veh/h/lane)", x_ticks=5, y_ticks=5))
        drawn += [_draw_speed(x, y, kmh) for kmh in SPEEDS_KMH]
        own = [row for row in rows if row["lane"] == lane]
        colours = colour_values(np.array([row["speed_mps"] for row in own], np.float64), 0, top_mps)
        drawn += [
            f'<circle cx="{x.to_pixels(row["density_veh_per_km"]):.1f}" cy="{y.to_pixels(row["flow_veh_per_h"]):.1f}" '
            f'r="{radius}" fill="{colour}" stroke="{MUTED}" stroke-width="0.5"/>'
            for row, colour in zip(own, colours, strict=True)
        ]
    size = columns * (width + LEFT + APART), math.ceil(len(lanes) / columns) * (height + BOTTOM + TOP)
    return wrap_svg(*size, "Flow against density", "".join(drawn))


def _draw_speed(x: Scale, y: Scale, kmh: float) -> str:
    """Return the line of equal speed in a plot of flow (veh/h) against density (veh/km), with its speed at the end."""
    density = min(x.high, y.high / kmh)
    right, top = x.to_pixels(density), y.to_pixels(density * kmh)
    line = f'<path d="M{x.start} {y.start}L{right:.1f} {top:.1f}" stroke="{MUTED}" stroke-width="0.6" fill="none"/>'
    label = f"{kmh:g} km/h" if kmh == SPEEDS_KMH[0] else f"{kmh:g}"
    return line + draw_text(f"{right - 3:.1f}", f"{top + 11:.1f}", label, anchor="end")


def name_lane(lane: int | None) -> str:
    """Return a lane's name for plots."""
    return "no lane" if lane is None else f"lane {lane}"
