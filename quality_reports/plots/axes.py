"""Plain SVG axes: round ticks, scales, lines of points; for drawings too many or too large for a chart library."""

import math
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.schemas.chart_theme import GRID, MUTED

Floats = NDArray[np.float64]
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Scale:
    """A linear scale from data to pixels.

    Args:
        low: the least value, drawn at `start`.
        high: the greatest value, drawn at `end`; above `low`.
        start: pixels.
        end: pixels.
    """

    low: float
    high: float
    start: float
    end: float

    def place(self, value: float) -> float:
        """The pixel of a value."""
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)

    def place_all(self, values: Floats) -> Floats:
        """The pixels of values."""
        return self.start + (values - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self, most: int) -> list[float]:
        """Round values within the scale: multiples of 1, 2 or 5 times a power of ten, at most `most` + 1."""
        return make_ticks(self.low, self.high, most)


def make_ticks(low: float, high: float, most: int) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten from `low` to `high`, at most `most` + 1 of them."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    for factor in (1, 2, 5, 10):
        if (high - low) / (factor * step) <= most:
            step *= factor
            break
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 9) + 0.0 for number in range(first, last + 1)]


def span(values: pl.Series) -> tuple[float, float]:
    """The least and the greatest of some numbers, of which there are any."""
    numbers = values.cast(pl.Float64).to_numpy()
    return float(np.nanmin(numbers)), float(np.nanmax(numbers))


def widen(low: float, high: float, least: float) -> tuple[float, float]:
    """The range with a twentieth either side, at least `least` wide."""
    if high - low < least:
        middle = (low + high) / 2
        low, high = middle - least / 2, middle + least / 2
    margin = (high - low) / 20
    return low - margin, high + margin


def write_number(value: float) -> str:
    """A tick's label."""
    return f"{value:,.10g}".replace("-", MINUS)


def draw_frame(x: Scale, y: Scale, x_title: str, y_title: str, *, x_ticks: int, y_ticks: int) -> str:
    """Grid, tick labels and titles (with their units: plain text of our own) around the rectangle of two scales."""
    left, right = x.start, x.end
    bottom, top = y.start, y.end
    parts = []
    for value in x.ticks(x_ticks):
        at = f"{x.place(value):.1f}"
        parts.append(f'<path d="M{at} {top}V{bottom + 4}" stroke="{GRID}" fill="none"/>')
        parts.append(
            f'<text x="{at}" y="{bottom + 16}" text-anchor="middle" fill="{MUTED}">{write_number(value)}</text>'
        )
    for value in y.ticks(y_ticks):
        height = y.place(value)
        parts.append(f'<path d="M{left - 4} {height:.1f}H{right}" stroke="{GRID}" fill="none"/>')
        parts.append(
            f'<text x="{left - 7}" y="{height + 4:.1f}" text-anchor="end" fill="{MUTED}">{write_number(value)}</text>'
        )
    parts.append(f'<path d="M{left} {top}V{bottom}H{right}" stroke="{MUTED}" fill="none"/>')
    parts.append(
        f'<text x="{(left + right) / 2:.1f}" y="{bottom + 32}" text-anchor="middle" fill="{MUTED}">{x_title}</text>'
    )
    parts.append(f'<text x="{left - 40}" y="{top - 7}" fill="{MUTED}">{y_title}</text>')
    return "".join(parts)


def draw_line(points: pl.DataFrame, x: Scale, y: Scale, of: str, against: str) -> str:
    """The path data of a line through points, begun anew after every gap; a lone point is a dot of the line's width.

    Args:
        points: in order; `of`, `against`, and `follows`: whether the point before is the one just before in time.
        x: scale of `against`.
        y: scale of `of`.
        of: what is drawn; points where it is null are left out.
        against: along which.
    """
    known = points.with_columns(follows=pl.col("follows") & pl.col(of).shift().is_not_null()).drop_nulls(of)
    follows = known["follows"].to_numpy()
    at = write_points(x.place_all(known[against].to_numpy()), y.place_all(known[of].to_numpy()))
    commands = np.char.add(np.where(follows, "L", "M"), at)
    return "".join(np.char.add(commands, np.where(follows, "", "h0")).tolist())


def write_points(across: Floats, down: Floats) -> NDArray[np.str_]:
    """Pixels as "across down", to a tenth."""
    return np.char.add(np.char.mod("%.1f ", across), np.char.mod("%.1f", down))


def wrap_svg(width: float, height: float, label: str, content: str) -> str:
    """An `<svg>` of our own text; `label` says what it shows, and must be no text of the data's."""
    return (
        f'<svg role="img" aria-label="{label}" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" font-family="sans-serif" font-size="11">{content}</svg>'
    )
