"""Axes, ticks and lines as plain SVG: the fast path for plots that a subset's page draws by the dozen.

A plot takes 2 ms this way and 85 to 185 ms by Altair, and every subset has a page. Plots that a whole report has once
are Altair's, in `charts.py`.
"""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.arrays import Floats
from tracklake.schemas.chart_theme import GRID, MUTED

MINUS = "\N{MINUS SIGN}"
KMH_PER_MPS = 3.6
"""Factor from m/s to km/h."""

Number = TypeVar("Number", float, Floats)


@dataclass(frozen=True)
class Scale:
    """A linear scale from data to pixels.

    Args:
        low: least value, drawn at `start`.
        high: greatest value, above `low`, drawn at `end`.
        start: position of `low`, in pixels.
        end: position of `high`, in pixels.
    """

    low: float
    high: float
    start: float
    end: float

    def to_pixels(self, values: Number) -> Number:
        """Convert one value or an array of values to pixels."""
        return self.start + (values - self.low) / (self.high - self.low) * (self.end - self.start)


def make_ticks(low: float, high: float, most: int) -> list[float]:
    """Return multiples of 1, 2 or 5 times a power of ten from `low` to `high`, at most `most` + 1 of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step *= next(factor for factor in (1, 2, 5, 10) if factor == 10 or (high - low) / (factor * step) <= most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 9) + 0.0 for number in range(first, last + 1)]


def find_range(values: pl.Series, least: float) -> tuple[float, float]:
    """Return the range of some numbers, at least `least` wide, widened by a twentieth on either side.

    Args:
        values: numbers, at least one of them not null.
        least: least width before it is widened.
    """
    numbers = values.cast(pl.Float64).to_numpy()
    low, high = float(np.nanmin(numbers)), float(np.nanmax(numbers))
    if high - low < least:
        middle = (low + high) / 2
        low, high = middle - least / 2, middle + least / 2
    margin = (high - low) / 20
    return low - margin, high + margin


def format_number(value: float) -> str:
    """Return a tick's label."""
    return f"{value:,.10g}".replace("-", MINUS)


def draw_text(x: float | str, y: float | str, text: str, *, anchor: str = "") -> str:
    """Return a label in the muted colour; `text` is plain text of our own.

    Args:
        x: position in pixels.
        y: position of the baseline in pixels.
        text: the label.
        anchor: middle or end; empty for the start.
    """
    anchored = f' text-anchor="{anchor}"' if anchor else ""
    return f'<text x="{x}" y="{y}"{anchored} fill="{MUTED}">{text}</text>'


def draw_path(shape: str, colour: str, width: float) -> str:
    """Return a path with round ends, its width in pixels."""
    return (
        f'<path d="{shape}" fill="none" stroke="{colour}" stroke-width="{width}" stroke-linecap="round" '
        'stroke-linejoin="round"/>'
    )


def draw_frame(
    x: Scale,
    y: Scale,
    x_title: str,
    y_title: str,
    *,
    x_ticks: int,
    y_ticks: int,
    x_kmh: bool = False,
    y_kmh: bool = False,
) -> str:
    """Return the grid, the tick labels and the titles around the rectangle of two scales.

    Args:
        x: scale across.
        y: scale upwards.
        x_title: text below.
        y_title: text above the left end.
        x_ticks: most steps between ticks across.
        y_ticks: most steps between ticks upwards; 0 for none.
        x_kmh: whether x is a speed in m/s, which is written in km/h as well, in a second row.
        y_kmh: whether y is one, which is written in km/h on the right as well.
    """
    left, right, bottom, top = x.start, x.end, y.start, y.end
    parts = []
    if x_kmh:
        for value in make_ticks(x.low * KMH_PER_MPS, x.high * KMH_PER_MPS, x_ticks):
            at = f"{x.to_pixels(value / KMH_PER_MPS):.1f}"
            parts.append(f'<path d="M{at} {bottom}v4" stroke="{MUTED}" fill="none"/>')
            parts.append(draw_text(at, bottom + 29, format_number(value), anchor="middle"))
    if y_kmh:
        parts += [
            draw_text(right + 4, f"{y.to_pixels(value / KMH_PER_MPS) + 4:.1f}", format_number(value))
            for value in make_ticks(y.low * KMH_PER_MPS, y.high * KMH_PER_MPS, y_ticks + 1)
        ]
        parts.append(draw_text(right + 20, top - 7, "km/h", anchor="end"))
    for value in make_ticks(x.low, x.high, x_ticks):
        at = f"{x.to_pixels(value):.1f}"
        parts.append(f'<path d="M{at} {top}V{bottom + 4}" stroke="{GRID}" fill="none"/>')
        parts.append(draw_text(at, bottom + 16, format_number(value), anchor="middle"))
    for value in make_ticks(y.low, y.high, y_ticks) if y_ticks else ():
        height = y.to_pixels(value)
        parts.append(f'<path d="M{left - 4} {height:.1f}H{right}" stroke="{GRID}" fill="none"/>')
        parts.append(draw_text(left - 7, f"{height + 4:.1f}", format_number(value), anchor="end"))
    parts.append(f'<path d="M{left} {top}V{bottom}H{right}" stroke="{MUTED}" fill="none"/>')
    parts.append(draw_text(f"{(left + right) / 2:.1f}", bottom + (45 if x_kmh else 32), x_title, anchor="middle"))
    parts.append(draw_text(left - 40, top - 7, y_title))
    return "".join(parts)


def draw_line(points: pl.DataFrame, x: Scale, y: Scale, of: str, against: str) -> str:
    """Return the path data of a line that breaks at gaps; a single point becomes a dot of the line's width.

    Args:
        points: rows in order: `of`, `against`, and `follows`, which is true where no time is missing since the row
            before.
        x: scale of `against`.
        y: scale of `of`.
        of: drawn column; its nulls break the line.
        against: column along the horizontal axis.
    """
    known = points[of].is_not_null().to_numpy()
    follows = points["follows"].to_numpy() & np.concatenate([[False], known[:-1]])
    values = points[of].cast(pl.Float64).to_numpy()  # NaN where it is null
    at = format_points(x.to_pixels(points[against].to_numpy()[known]), y.to_pixels(values[known]))
    # A point that does not follow begins a line, and is drawn by itself as well.
    begun = np.char.add(np.where(follows[known], "L", "M"), at)
    return "".join(np.char.add(begun, np.where(follows[known], "", "h0")).tolist())


def format_points(across: Floats, down: Floats) -> NDArray[np.str_]:
    """Return pixels as "across down", to a tenth."""
    return np.char.add(np.char.mod("%.1f ", across), np.char.mod("%.1f", down))


def wrap_svg(width: float, height: float, label: str, content: str) -> str:
    """Return an `<svg>` element; `label` describes it in plain text of our own."""
    return (
        f'<svg role="img" aria-label="{label}" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" font-family="sans-serif" font-size="11">{content}</svg>'
    )
