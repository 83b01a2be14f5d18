"""The quality report: `index.html`, self-contained, and the same numbers as `quality.json`."""

import json
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import jinja2
from markupsafe import Markup

from quality_reports import plots
from quality_reports.rules import RULES, Rule
from quality_reports.summaries import Connection, Row, collect

DASH = "\N{EN DASH}"
"""What a table shows where a number is unknown or was not computed."""


@dataclass(frozen=True)
class Report:
    """A rendered report.

    Args:
        html: the page; it fetches nothing.
        quality: the page's numbers as plain values; its keys are those of `quality_reports.summaries.collect`.
    """

    html: str
    quality: dict[str, Any]

    @property
    def json(self) -> str:
        """The text of `quality.json`: the numbers, strictly JSON, ending in a newline."""
        return json.dumps(self.quality, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def build_report(
    connection: Connection,
    provenance: Mapping[str, Any],
    *,
    rules: Sequence[Rule] = RULES,
    scores: Sequence[Mapping[str, Any]] | None = None,
) -> Report:
    """Query the lake's views and render the report.

    Args:
        connection: with the catalog's views; see `quality_reports.summaries.collect`.
        provenance: lake, tracklake, versions, settings, created...: shown as given; `thresholds` are the overrides.
        rules: what validation judged by.
        scores: [{model, part, rows: [{seconds, rmse_m, n}]}], where models were evaluated.

    Raises:
        ThresholdError: provenance["thresholds"] names a threshold that the rules do not have.
    """
    quality = collect(connection, provenance, rules=rules, scores=scores)
    return Report(html=render(quality), quality=quality)


def render(quality: Row) -> str:
    """Render the page from what `collect` returns. Everything but our own style sheet and plots is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("quality_reports", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        cell=format_cell,
        visible=visible,
        integer=_integer,
        percent=_percent,
        fixed=_fixed,
        duration=format_duration,
        labelled=_labelled,
        unit=_unit,
    )
    style = (files("quality_reports") / "templates" / "report.css").read_text(encoding="utf-8")
    return environment.get_template("report.html.j2").render(
        **quality,
        style=Markup(style),
        drawings=_drawings(quality),
        stage={row["stage"]: row for row in quality["stages"]},
        found_in={
            (rule["name"], row["dataset"], row["subset"]): row for rule in quality["rules"] for row in rule["subsets"]
        },
        settings=flatten(_without_known(quality["provenance"])),
        horizons=sorted({row["seconds"] for score in quality["scores"] for row in score["rows"]}),
    )


def _without_known(provenance: Row) -> Row:
    """What the provenance table lists: everything but the files, which have a table of their own."""
    return {key: value for key, value in provenance.items() if key != "source_files"}


def _labelled(row: Row) -> Row:
    """A row with `label`: its subset, or `all` where it sums up the dataset."""
    return {**row, "label": row["subset"] if row["subset"] is not None else f"all of {row['dataset']}"}


def _drawings(quality: Row) -> dict[str, Any]:
    """The page's plots by name, as markup; None where there is nothing to draw."""
    speeds, starts, splits = quality["speeds"], quality["starts"], quality["splits"]
    parts = dict.fromkeys((row["split"], row["dataset"]) for row in splits["balance"])
    return {
        "speed_histogram": Markup(plots.draw_speed_histogram(speeds["histogram"], speeds["summary"]))
        if speeds["histogram"]
        else None,
        "speed_ranges": Markup(plots.draw_speed_ranges(speeds["summary"])) if speeds["summary"] else None,
        "start_positions": Markup(plots.draw_start_positions(starts["positions"], starts["subsets"]))
        if starts["positions"] and starts["subsets"]
        else None,
        "splits": {
            (split, dataset): Markup(plots.draw_split(splits["members"], splits["balance"], split, dataset))
            for split, dataset in parts
        },
    }


def format_cell(value: Any, kind: str = "text") -> str:  # noqa: ANN401 - any plain value
    """Put one value of a table into words: a dash for null, thousands separated, shares as percentages.

    Args:
        value: a plain value.
        kind: text, int, percent, bool, duration, or f0 to f4 for that many decimals.
    """
    if value is None:
        return DASH
    if kind == "int":
        return _integer(value)
    if kind == "percent":
        return _percent(value)
    if kind == "bool":
        return "yes" if value else "no"
    if kind == "duration":
        return format_duration(value)
    if kind[1:].isdigit():
        return _fixed(value, int(kind[1:]))
    if isinstance(value, list):
        return visible(", ".join(str(each) for each in value))
    return visible(str(value))


def visible(text: str) -> str:
    """Show what would not be seen or would rearrange the line: control, format and surrogate characters as escapes."""
    return "".join(
        character if unicodedata.category(character) not in {"Cc", "Cf", "Cs"} else ascii(character)[1:-1]
        for character in text
    )


def format_duration(seconds: float | None) -> str:
    """Seconds as hours and minutes, minutes, or seconds."""
    if seconds is None:
        return DASH
    if seconds < 120:
        return f"{seconds:,.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:  # noqa: ANN401 - any plain value
    """A nested mapping as (dotted name, text) pairs, in its own order."""
    if isinstance(value, dict):
        return [pair for key, each in value.items() for pair in flatten(each, f"{prefix}.{key}" if prefix else key)]
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return [pair for number, each in enumerate(value) for pair in flatten(each, f"{prefix}[{number}]")]
    return [(prefix, format_cell(value))]


def _unit(symbol: str) -> str:
    """A unit as it is printed: m/s2 with its exponent raised."""
    return symbol.replace("s2", "s\N{SUPERSCRIPT TWO}").replace("s3", "s\N{SUPERSCRIPT THREE}")


def _integer(value: float | None) -> str:
    """A whole number with thousands separated."""
    return DASH if value is None else f"{value:,.0f}"


def _fixed(value: float | None, decimals: int) -> str:
    """A number with fixed decimals and a true minus sign; what rounds to zero carries none."""
    if value is None:
        return DASH
    text = f"{value:,.{decimals}f}"
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("-")
    return text.replace("-", "\N{MINUS SIGN}")


def _percent(share: float | None) -> str:
    """A share as a percentage; one too small for two decimals is not shown as nothing."""
    if share is None:
        return DASH
    if 0 < share < 0.00005:
        return "< 0.01 %"
    return f"{100 * share:.2f} %"
