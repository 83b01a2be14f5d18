"""Plot of one vehicle's speed and acceleration, recorded and reconstructed."""

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
from tracklake.schemas.chart_theme import BLUE, ORANGE

WIDTH, HEIGHT, LEFT, RIGHT, GAP = 1112, 190, 56, 40, 62
"""Size of a panel and distances to its left, right and below it, in pixels."""
PANELS = (("speed_mps", "speed (m/s)", 1.0, True), ("accel_mps2", "acceleration (m/s\N{SUPERSCRIPT TWO})", 1.0, False))
"""Column, title, least range of values, and whether it is a speed, of each panel from above."""
LINES = (("recorded_", ORANGE, "recorded", 1.2), ("", BLUE, "reconstructed", 2.2))
"""Prefix of the columns, colour, name and width in pixels of each line, the lowest first."""


def draw_reconstruction(track: pl.DataFrame) -> str:
    """Draw one vehicle's speed and acceleration over time.

    Args:
        track: rows of one vehicle of subset_reconstructed.sql.
    """
    low, high = find_range(track["time_s"], 1.0)
    x = Scale(low, high, LEFT, WIDTH - RIGHT)
    drawn = []
    for number, (column, title, least, is_speed) in enumerate(PANELS):
        top = 30 + number * (HEIGHT + GAP)
        both = pl.concat([track[f"{prefix}{column}"].cast(pl.Float64) for prefix, *_ in LINES])
        y = Scale(*find_range(both, least), top + HEIGHT, top)
        drawn.append(draw_frame(x, y, "time (s)", title, x_ticks=12, y_ticks=6, y_kmh=is_speed))
        drawn += [
            draw_path(draw_line(track, x, y, f"{prefix}{column}", "time_s"), colour, width)
            for prefix, colour, _, width in LINES
        ]
    right = WIDTH - RIGHT - 60.0
    for _, colour, name, width in reversed(LINES):
        right -= 6.4 * len(name) + 44
        drawn += [draw_path(f"M{right:.0f} 14h24", colour, width), draw_text(f"{right + 30:.0f}", 18, name)]
    height = 30 + len(PANELS) * (HEIGHT + GAP) - 20
    return wrap_svg(WIDTH, height, "Speed and acceleration of one vehicle, recorded and reconstructed", "".join(drawn))
