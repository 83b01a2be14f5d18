"""Plots of speeds and first positions by our own axes: every subset has a page, and Altair takes 85 ms a plot."""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tracklake.quality_reports.plots.axes import Scale, draw_frame, draw_path, draw_text, wrap_svg
from tracklake.schemas.chart_theme import BLUE, INK, MUTED, ORANGE

Row = Mapping[str, Any]

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 900, 52, 14, 30, 55
"""Width of a plot and the margins around its axes, in pixels."""
SPEED_TITLE = "recorded speed (m/s, below in km/h)"
"""Title of an axis of speeds."""
HISTOGRAM_HEIGHT = 130
"""Height of a histogram's axes, in pixels."""
LABELS, LABEL_CHARS = 190, 26
"""Space for the names of subsets, in pixels, and the longest name shown there, in characters; tables show it whole."""
ROW_HEIGHT = 18
"""Height of one subset's line, in pixels."""
JUDGED = {"on time": BLUE, "late": ORANGE, "not judged": MUTED}
"""Colours of first positions by their judgement."""
LEAST_RADIUS, GREATEST_RADIUS = 3.0, 10.0
"""Radius of the mark of a single vehicle and of the most vehicles, in pixels."""


def draw_speed_histogram(histogram: Sequence[Row], summary: Sequence[Row]) -> str:
    """Draw the recorded speed per dataset: share of its entries by bin of 1 m/s, with median and 95 % range.

    Args:
        histogram: rows of speed_histogram.sql.
        summary: rows of speeds.sql.
    """
    speeds = [row["speed_mps"] for row in histogram]
    x = Scale(*find_speed_range(speeds), LEFT, WIDTH - RIGHT)
    drawn = []
    height = TOP
    for dataset in list_names(histogram, "dataset"):
        bins = [row for row in histogram if row["dataset"] == dataset]
        marks = [row for row in summary if row["dataset"] == dataset and row["subset"] is None]
        y = Scale(0, 105 * max(row["share"] for row in bins), height + HISTOGRAM_HEIGHT, height)
        drawn.append(draw_frame(x, y, SPEED_TITLE, "share of entries (%)", x_ticks=12, y_ticks=4, x_kmh=True))
        bars = "".join(
            f"M{x.to_pixels(row['speed_mps']) + 0.5:.1f} {y.start}V{y.to_pixels(100 * row['share']):.1f}"
            f"H{x.to_pixels(row['speed_mps'] + 1) - 0.5:.1f}V{y.start}Z"
            for row in bins
        )
        drawn.append(f'<path d="{bars}" fill="{BLUE}" fill-opacity="0.75"/>')
        for row in marks:
            low, median, high = (f"{x.to_pixels(row[name]):.1f}" for name in ("p2_5_mps", "median_mps", "p97_5_mps"))
            drawn.append(draw_path(f"M{low} {height - 4}H{high}", INK, 2))
            drawn.append(f'<path d="M{median} {height}V{y.start}" stroke="{INK}" stroke-dasharray="5 3" fill="none"/>')
            drawn.append(draw_heading(WIDTH - RIGHT, height - 11, dataset, anchor="end"))
        height += HISTOGRAM_HEIGHT + BOTTOM + TOP
    return wrap_svg(WIDTH, height - TOP, "Share of entries by recorded speed", "".join(drawn))


def draw_speed_ranges(summary: Sequence[Row]) -> str:
    """Draw the recorded speed per subset: extremes (thin), 95 % range (thick) and median (tick).

    Args:
        summary: rows of speeds.sql.
    """
    rows = [row for row in summary if row["subset"] is not None]
    x = Scale(*find_speed_range([row[name] for row in rows for name in ("min_mps", "max_mps")]), LABELS, WIDTH - RIGHT)
    lines, (thin, thick, median) = _place_lines(rows), ("", "", "")
    for row in rows:
        y = lines[row["dataset"], row["subset"]]
        least, low, middle, high, greatest = (
            f"{x.to_pixels(row[f'{name}_mps']):.1f}" for name in ("min", "p2_5", "median", "p97_5", "max")
        )
        thin += f"M{least} {y}H{greatest}"
        thick += f"M{low} {y}H{high}"
        median += f"M{middle} {y - 6}v12"
    marks = (
        f'<path d="{thin}" stroke="{MUTED}" fill="none"/>'
        f'<path d="{thick}" stroke="{BLUE}" stroke-opacity="0.75" stroke-width="7" fill="none"/>'
        f'<path d="{median}" stroke="{INK}" stroke-width="2" fill="none"/>'
    )
    return _wrap_lines(lines, x, SPEED_TITLE, "Range of recorded speed per subset", marks)


def draw_start_positions(positions: Sequence[Row], starts: Sequence[Row]) -> str:
    """Draw where tracks begin in each freeway subset: a mark per 2 m, sized by vehicles, and a tick at the cut-off.

    Args:
        positions: rows of start_positions.sql.
        starts: rows of starts.sql.
    """
    cutoffs = [row for row in starts if row["cutoff_m"] is not None]
    lines = _place_lines([*positions, *(row for row in cutoffs if not positions)])
    ends = [row["start_x_m"] for row in positions] + [row["cutoff_m"] for row in cutoffs]
    x = Scale(min(ends) - 2, max(ends) + 6, LABELS, WIDTH - RIGHT)
    most = max((row["vehicles"] for row in positions), default=1)
    marks = ""
    for row in sorted(positions, key=lambda row: -row["vehicles"]):
        place = x.to_pixels(row["start_x_m"] + 1), lines[row["dataset"], row["subset"]]
        share = math.sqrt((row["vehicles"] - 1) / max(1, most - 1))
        marks += draw_mark(*place, LEAST_RADIUS + share * (GREATEST_RADIUS - LEAST_RADIUS), row["judged"])
    ticks = "".join(
        f"M{x.to_pixels(row['cutoff_m']):.1f} {lines[row['dataset'], row['subset']] - 9}v18"
        for row in cutoffs
        if (row["dataset"], row["subset"]) in lines
    )
    legend = "".join(
        draw_mark(LABELS + 8 + 110 * number, 10, 5, judged) + draw_text(LABELS + 18 + 110 * number, 14, judged)
        for number, judged in enumerate(JUDGED)
    )
    legend += draw_text(WIDTH - RIGHT, 14, f"the largest mark: {most:,} vehicles in 2 m", anchor="end")
    content = legend + marks + f'<path d="{ticks}" stroke="{INK}" stroke-width="2" fill="none"/>'
    return _wrap_lines(lines, x, "x of the first entry (m)", "First positions of tracks per subset", content)


def find_speed_range(speeds: Sequence[float]) -> tuple[float, float]:
    """Return the ends of a speed axis in m/s: from 0, unless half of the axis would be empty."""
    low, high = min(speeds), max(speeds)
    return (min(low, 0.0) if low < high / 2 else math.floor(low) - 1.0), max(math.floor(high) + 1.0, low + 5.0)


def draw_mark(x: float, y: float, radius: float, judged: str) -> str:
    """Return the mark of a first position: a circle on time, a diamond late, a cross where it is not judged."""
    at, r, colour = f"M{x:.1f} {y:.1f}", f"{radius:.1f}", JUDGED[judged]
    if judged == "not judged":
        return f'<path d="{at}m-{r}-{r}l{2 * radius:.1f} {2 * radius:.1f}m0-{2 * radius:.1f}l-{2 * radius:.1f} ' + (
            f'{2 * radius:.1f}" stroke="{colour}" stroke-width="2" fill="none"/>'
        )
    if judged == "late":
        return f'<path d="{at}m0-{r}l{r} {r}l-{r} {r}l-{r}-{r}Z" fill="{colour}" fill-opacity="0.8"/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r}" fill="{colour}" fill-opacity="0.8"/>'


def draw_heading(x: float, y: float, text: str, *, anchor: str = "start") -> str:
    """Return a bold label in the ink's colour; any text is escaped."""
    return (
        f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}" fill="{INK}" font-weight="bold">{html.escape(text)}</text>'
    )


def list_names(rows: Iterable[Row], column: str) -> list[str]:
    """Return the distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(row[column] for row in rows))


def _place_lines(rows: Iterable[Row]) -> dict[tuple[str, str], int]:
    """Return the middle of each subset's line, in pixels from the top, in order of appearance."""
    subsets = dict.fromkeys((row["dataset"], row["subset"]) for row in rows)
    return {key: TOP + number * ROW_HEIGHT + ROW_HEIGHT // 2 for number, key in enumerate(subsets)}


def _wrap_lines(lines: Mapping[tuple[str, str], int], x: Scale, title: str, label: str, marks: str) -> str:
    """Return the drawing of marks on one line per subset, each beside its name."""
    bottom = TOP + len(lines) * ROW_HEIGHT
    kmh = title == SPEED_TITLE
    frame = draw_frame(x, Scale(0, 1, bottom, TOP), title, "", x_ticks=12, y_ticks=0, x_kmh=kmh)
    names = "".join(
        draw_text(LABELS - 8, y + 4, html.escape(_shorten(subset)), anchor="end") for (_, subset), y in lines.items()
    )
    return wrap_svg(WIDTH, bottom + BOTTOM, label, frame + names + marks)


def _shorten(name: str) -> str:
    """Return a name that fits beside a plot."""
    return name if len(name) <= LABEL_CHARS else f"{name[: LABEL_CHARS - 1]}…"
