"""Templates of the report's pages, and the formats of single values."""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from tracklake.quality_reports.groups import describe_subset_origins
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.quality import Quality
from tracklake.schemas.text import make_visible

DASH = "\N{EN DASH}"
"""Text of a number that is unknown or was not computed."""

COUNTED_UNITS = ("changes", "frames")
"""Units of findings that are whole numbers."""


@cache
def make_environment() -> jinja2.Environment:
    """Make the templates' environment once: text is escaped, a missing name is an error, style and script are there."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tracklake.quality_reports", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        cell=format_cell,
        visible=make_visible,
        integer=_integer,
        percent=_percent,
        fixed=_fixed,
        duration=format_duration,
        labelled=label_sums,
        unit=_unit,
        worst=_format_worst,
    )
    templates = files("tracklake.quality_reports") / "templates"
    for file in ("report.css", "report.js", "canvas.js", "player.js", "diagrams.js"):
        environment.globals[file.replace(".", "_")] = Markup((templates / file).read_text(encoding="utf-8"))
    return environment


def describe_origins(quality: Quality) -> str | None:
    """Describe what of the lake is synthetic; None where nothing is."""
    drives = {row["drive"]: row["origin"] for row in quality["drives"]["drives"]} if "drives" in quality else {}
    texts = [
        describe_subset_origins(quality),
        describe_synthetic(drives, noun="drive", maker="instrument"),
    ]
    return " ".join(text for text in texts if text) or None


def label_sums(row: Mapping[str, Any]) -> dict[str, Any]:
    """Add `label` to a row: its subset, or `all of` the dataset that it sums up."""
    return {**row, "label": row["subset"] if row["subset"] is not None else f"all of {row['dataset']}"}


def format_cell(value: object, kind: str = "text") -> str:
    """Format one value of a table: a dash for null, thousands separated, shares as percentages.

    Args:
        value: plain value.
        kind: text, int, percent, bool, duration, speed or speed_below (m/s with km/h beside or below), or f0 to f4
            for that many decimals.
    """
    if value is None:
        return DASH
    if kind == "bool":
        return "yes" if value else "no"
    if isinstance(value, int | float) and kind != "text":
        return _format_number(value, kind)
    if isinstance(value, list):
        return make_visible(", ".join(str(each) for each in value))
    return make_visible(str(value))


def _format_number(value: float, kind: str) -> str:
    """Format a number of some kind."""
    if kind == "int":
        return _integer(value)
    if kind == "percent":
        return _percent(value)
    if kind == "duration":
        return format_duration(value)
    if kind.startswith("speed"):
        small = '<small class="below">' if kind == "speed_below" else "<small>"
        return Markup(f"{_fixed(value, 2)} {small}{_fixed(value * 3.6, 1)}</small>")  # numbers only
    return _fixed(value, int(kind[1:]))


def format_duration(seconds: float | None) -> str:
    """Format seconds as hours and minutes, minutes, or seconds."""
    if seconds is None:
        return DASH
    if seconds < 120:
        return f"{seconds:,.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def flatten(value: object, prefix: str = "") -> list[tuple[str, str]]:
    """Return a nested mapping as (dotted name, text) pairs, in its own order."""
    if isinstance(value, dict):
        return [pair for key, each in value.items() for pair in flatten(each, f"{prefix}.{key}" if prefix else key)]
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return [pair for number, each in enumerate(value) for pair in flatten(each, f"{prefix}[{number}]")]
    return [(prefix, format_cell(value))]


def _unit(symbol: str) -> str:
    """Format a unit, its exponents raised."""
    return symbol.replace("s2", "s\N{SUPERSCRIPT TWO}").replace("s3", "s\N{SUPERSCRIPT THREE}")


def _format_worst(value: float | None, unit: str) -> str:
    """Format a finding's worst value with its unit; counts have no decimals."""
    if value is None:
        return DASH
    kmh = f" ({_fixed(value * 3.6, 1)} km/h)" if unit == "m/s" else ""
    return f"{_integer(value) if unit in COUNTED_UNITS else _fixed(value, 2)} {_unit(unit)}{kmh}"


def _integer(value: float | None) -> str:
    """Format a whole number with thousands separated."""
    return DASH if value is None else f"{value:,.0f}"


def _fixed(value: float | None, decimals: int) -> str:
    """Format a number with fixed decimals and a true minus sign, which zero does not carry."""
    if value is None:
        return DASH
    text = f"{value:,.{decimals}f}"
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("-")
    return text.replace("-", "\N{MINUS SIGN}")


def _percent(share: float | None) -> str:
    """Format a share as a percentage; one too small for two decimals is shown as such."""
    if share is None:
        return DASH
    if 0 < share < 0.00005:
        return "< 0.01 %"
    return f"{100 * share:.2f} %"
