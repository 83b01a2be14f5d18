"""The worst findings of every rule in a subset: where, how bad, a plot of x, v and a around them, and their SQL."""

from collections.abc import Mapping, Sequence

import polars as pl

from tracklake.quality_reports.plots.axes import Scale, draw_frame, draw_line, span, widen, wrap_svg
from tracklake.quality_reports.summaries import Connection, Row, query, query_frame
from tracklake.schemas.chart_theme import BLUE, ORANGE

EXAMPLES = 2
"""Shown per rule, of different vehicles."""
AROUND_S = 5.0
"""Shown before and after a finding."""
LONGEST_S = 15.0
"""Of a longer finding only its beginning is drawn."""
PANELS = (("x_m", "position (m)", 2.0), ("speed_mps", "speed (m/s)", 2.0), ("accel_mps2", "acceleration (m/s²)", 1.0))
"""What is drawn, its axis title, and the least range of it."""
PANEL_WIDTH, PANEL_HEIGHT, LEFT, TOP, BOTTOM = 260, 100, 56, 22, 38


def find_examples(connection: Connection, where: Mapping[str, str], rules: Sequence[Row], rate_hz: float) -> list[Row]:
    """The worst findings of each rule: rows of subset_worst.sql with `unit`, `sql` and `plot` (markup of our own).

    Args:
        connection: with the catalog's views.
        where: dataset and subset.
        rules: name, unit and extreme (min or max) of each.
        rate_hz: the subset's frame rate.
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
    """The statement that shows a finding's entries."""
    dataset, subset = (_literal(where[name]) for name in ("dataset", "subset"))
    return (
        f"SELECT * FROM track({subset}, {finding['vehicle_id']})\n"
        f"WHERE dataset = {dataset} AND frame BETWEEN {finding['first_frame']} AND {finding['last_frame']}"
    )


def _literal(text: str) -> str:
    """A SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def draw_example(entries: pl.DataFrame, first_frame: int, last_frame: int) -> str:
    """Position, speed and acceleration against time, side by side, the finding's entries shaded and drawn thicker.

    Args:
        entries: frame, time_s, x_m, speed_mps, accel_mps2 of one vehicle around the finding, in order.
        first_frame: of the finding.
        last_frame: of the finding.
    """
    times = entries["time_s"]
    low, high = widen(*span(times), 1.0)
    points = entries.with_columns(follows=(pl.col("frame").diff() == 1).fill_null(value=False))
    found = pl.col("frame").is_between(first_frame, last_frame)
    within = points.filter(found).with_columns(follows=pl.col("follows") & found.shift().fill_null(value=False))
    drawn = []
    for number, (column, title, least) in enumerate(PANELS):
        left = number * (PANEL_WIDTH + LEFT + 14) + LEFT
        x = Scale(low, high, left, left + PANEL_WIDTH)
        values = entries[column].drop_nulls()
        if values.is_empty():
            drawn.append(f'<text x="{left}" y="{TOP + 50}" fill="#59636e">no {title.split(" (")[0]} recorded</text>')
            continue
        y = Scale(*widen(*span(values), least), TOP + PANEL_HEIGHT, TOP)
        drawn.append(draw_frame(x, y, "time (s)", title, x_ticks=5, y_ticks=4))
        if not within.is_empty():
            begin, end = (x.place(float(within["time_s"][place])) for place in (0, -1))
            drawn.append(
                f'<rect x="{begin - 2:.1f}" y="{TOP}" width="{end - begin + 4:.1f}" height="{PANEL_HEIGHT}" '
                f'fill="{ORANGE}" fill-opacity="0.22"/>'
            )
        for part, colour, width in ((points, BLUE, 1.4), (within, ORANGE, 2.6)):
            drawn.append(
                f'<path d="{draw_line(part, x, y, column, "time_s")}" fill="none" stroke="{colour}" '
                f'stroke-width="{width}" stroke-linecap="round" stroke-linejoin="round"/>'
            )
    width = len(PANELS) * (PANEL_WIDTH + LEFT + 14)
    return wrap_svg(width, TOP + PANEL_HEIGHT + BOTTOM, "Position, speed and acceleration over time", "".join(drawn))
