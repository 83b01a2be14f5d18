"""Worst findings of every rule in a subset: facts, a plot of x, v and a around them, and their SQL."""

from collections.abc import Mapping, Sequence

import polars as pl

from tracklake.quality_reports.plots.axes import (
    Scale,
    draw_frame,
    draw_line,
    draw_path,
    draw_text,
    find_range,
    wrap_svg,
)
from tracklake.quality_reports.summaries import Connection, Row, query, query_frame
from tracklake.schemas.chart_theme import BLUE, ORANGE

EXAMPLES = 2
"""Findings shown per rule, each of another vehicle."""
AROUND_S = 5.0
"""Time drawn before and after a finding, in seconds."""
LONGEST_S = 15.0
"""Longest drawn time of a finding, in seconds; the rest is cut."""
PANELS = (("x_m", "position (m)", 2.0), ("speed_mps", "speed (m/s)", 2.0), ("accel_mps2", "acceleration (m/s²)", 1.0))
"""Drawn columns, their axis titles, and the least range of each axis, in the column's unit."""
PANEL_WIDTH, PANEL_HEIGHT, LEFT, TOP, BOTTOM = 260, 100, 56, 22, 38
"""Size of a panel and the margins around it, in pixels."""


def find_examples(connection: Connection, where: Mapping[str, str], rules: Sequence[Row], rate_hz: float) -> list[Row]:
    """Find the worst findings of each rule: rows of subset_worst.sql with `unit`, `sql` and `plot` (safe markup).

    Args:
        connection: connection to a lake.
        where: dataset and subset.
        rules: rows of name, unit and extreme (min or max).
        rate_hz: frame rate of the subset.
    """
    about = {rule["name"]: rule for rule in rules}
    worst = query(
        connection,
        "subset_worst",
        {
            **where,
            "rules": list(about),
            "extremes": [rule["extreme"] for rule in rules],
            "examples": EXAMPLES,
        },
    )
    if not worst:
        return []
    around, longest = round(AROUND_S * rate_hz), round(LONGEST_S * rate_hz)
    tracks = query_frame(
        connection,
        "subset_example_tracks",
        {
            **where,
            "vehicles": [row["vehicle_id"] for row in worst],
            "from_frames": [row["first_frame"] - around for row in worst],
            "to_frames": [min(row["last_frame"], row["first_frame"] + longest) + around for row in worst],
        },
    )
    by_number = tracks.partition_by("number", as_dict=True)
    return [
        {
            **row,
            "unit": about[row["rule"]]["unit"],
            "sql": write_sql(where, row),
            "plot": draw_example(by_number[(number,)], row["first_frame"], row["last_frame"])
            if (number,) in by_number
            else None,
        }
        for number, row in enumerate(worst)
    ]


def write_sql(where: Mapping[str, str], finding: Row) -> str:
    """Return the statement that shows a finding's entries."""
    dataset, subset = (_quote(where[name]) for name in ("dataset", "subset"))
    return (
        f"SELECT * FROM track({subset}, {finding['vehicle_id']})\n"
        f"WHERE dataset = {dataset} AND frame BETWEEN {finding['first_frame']} AND {finding['last_frame']}"
    )


def _quote(text: str) -> str:
    """Return a SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def draw_example(entries: pl.DataFrame, first_frame: int, last_frame: int) -> str:
    """Draw position, speed and acceleration against time, side by side, with the finding's entries shaded and thicker.

    Args:
        entries: frame, time_s, x_m, speed_mps, accel_mps2 of one vehicle around the finding, in order.
        first_frame: first frame of the finding.
        last_frame: last frame of the finding.
    """
    low, high = find_range(entries["time_s"], 1.0)
    points = entries.with_columns(follows=(pl.col("frame").diff() == 1).fill_null(value=False))
    found = pl.col("frame").is_between(first_frame, last_frame)
    within = points.filter(found).with_columns(follows=pl.col("follows") & found.shift().fill_null(value=False))
    drawn = []
    for number, (column, title, least) in enumerate(PANELS):
        left = number * (PANEL_WIDTH + LEFT + 14) + LEFT
        x = Scale(low, high, left, left + PANEL_WIDTH)
        values = entries[column].drop_nulls()
        if values.is_empty():
            drawn.append(draw_text(left, TOP + 50, f"no {title.split(' (')[0]} recorded"))
            continue
        y = Scale(*find_range(values, least), TOP + PANEL_HEIGHT, TOP)
        drawn.append(draw_frame(x, y, "time (s)", title, x_ticks=5, y_ticks=4))
        if not within.is_empty():
            begin, end = (x.to_pixels(float(within["time_s"][place])) for place in (0, -1))
            drawn.append(
                f'<rect x="{begin - 2:.1f}" y="{TOP}" width="{end - begin + 4:.1f}" height="{PANEL_HEIGHT}" '
                f'fill="{ORANGE}" fill-opacity="0.22"/>'
            )
        drawn.append(draw_path(draw_line(points, x, y, column, "time_s"), BLUE, 1.4))
        drawn.append(draw_path(draw_line(within, x, y, column, "time_s"), ORANGE, 2.6))
    width = len(PANELS) * (PANEL_WIDTH + LEFT + 14)
    return wrap_svg(width, TOP + PANEL_HEIGHT + BOTTOM, "Position, speed and acceleration over time", "".join(drawn))
