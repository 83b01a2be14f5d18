"""What differs between two lakes as a page: self-contained, in the report's style."""

from markupsafe import Markup

from tracklake.quality_reports.pages.lake_differences import COUNTED
from tracklake.quality_reports.pages.rendering import format_cell, make_environment, read_style
from tracklake.quality_reports.summaries import Row

MINUS = "\N{MINUS SIGN}"


def render_comparison(compared: Row, report: str | None = None) -> str:
    """Render the differences between two lakes as a page; everything but our own style sheet is escaped.

    Args:
        compared: with `lake`, and where they are known `lake_id` and `compared` (when), in the facts of each side.
        report: address of the report to link to, relative to the page.
    """
    environment = make_environment()
    environment.filters.update(value=format_value, difference=format_difference)
    sides = {side: {"lake": "", "lake_id": "", "compared": "", **compared[side]} for side in ("then", "now")}
    return environment.get_template("compare.html.j2").render(
        **{**compared, **sides}, counted=COUNTED, report=report, style=Markup(read_style())
    )


def format_value(value: object) -> str:
    """Put a figure of any kind into words: six digits of a fraction, all of a whole number, a dash for null."""
    if isinstance(value, bool):
        return format_cell(value, "bool")
    if isinstance(value, int):
        return f"{value:,}".replace("-", MINUS)
    if isinstance(value, float):
        return f"{value:,.6g}".replace("-", MINUS)
    return format_cell(value)


def format_difference(change: Row) -> str:
    """The difference with its sign; nothing where there is none, or none that is a number."""
    difference = change["difference"]
    return f"+{format_value(difference)}" if difference and difference > 0 else format_value(difference or "")
