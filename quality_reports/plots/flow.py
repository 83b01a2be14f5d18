"""Plots of flow, density and speed over time, one row of plots per lane."""

from collections.abc import Sequence

import polars as pl

from tracklake.quality_reports.plots.axes import Scale, draw_frame, draw_line, draw_path, wrap_svg
from tracklake.quality_reports.plots.charts import FLOW, Row, name_lane
from tracklake.schemas.chart_theme import BLUE, INK

PANEL_WIDTH, PANEL_HEIGHT, LEFT, TOP, BOTTOM, APART = 250, 80, 58, 40, 38, 20
"""Size of a plot, the margins around it, and the space between two, in pixels."""


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
        drawn.append(f'<text x="{LEFT - 40}" y="{top - 22}" fill="{INK}" font-weight="bold">{name_lane(lane)}</text>')
        for number, (column, title) in enumerate(FLOW):
            left = number * (PANEL_WIDTH + LEFT + APART) + LEFT
            x = Scale(0, end_s, left, left + PANEL_WIDTH)
            low, high = data.select(pl.col(column).min().alias("low"), pl.col(column).max().alias("high")).row(0)
            y = Scale(min(0.0, low or 0.0), 1.05 * max(1.0, high or 0.0), top + PANEL_HEIGHT, top)
            drawn.append(draw_frame(x, y, "time (s)", title, x_ticks=6, y_ticks=4))
            path = draw_line(points, x, y, column, "middle_s")
            dots = draw_line(points.with_columns(follows=pl.lit(value=False)), x, y, column, "middle_s")
            drawn += [draw_path(path, BLUE, 1.4), draw_path(dots, BLUE, 4)]
    size = len(FLOW) * (PANEL_WIDTH + LEFT + APART), len(lanes) * (PANEL_HEIGHT + BOTTOM + TOP)
    return wrap_svg(*size, "Flow, density and speed over time", "".join(drawn))
