"""Page of the differences between two lakes: self-contained, in the report's style."""

from tracklake.quality_reports.pages.lake_differences import COUNTED
from tracklake.quality_reports.pages.rendering import format_cell, make_environment
from tracklake.quality_reports.summaries import Row

MINUS = "\N{MINUS SIGN}"


def render_comparison(compared: Row, report: str | None = None) -> str:
    """Render the differences between two lakes as a page; everything but our own style sheet is escaped.

    Args:
        compared: result of `compare`; the facts of each side hold `lake` and, where known, `lake_id` and `compared`
            (the time).
        report: address of the report to link to, relative to the page.
    """
    environment = make_environment()
    environment.filters.update(value=format_value, difference=format_difference)
    sides = {side: {"lake": "", "lake_id": "", "compared": "", **compared[side]} for side in ("then", "now")}
    return environment.get_template("compare.html.j2").render(
        **{**compared, **sides}, counted=COUNTED, report=report, banner=describe_sides(compared)
    )


def describe_sides(compared: Row) -> str | None:
    """Describe what is synthetic in each of two compared lakes; None where nothing is."""
    texts = [f"{side}: {compared[side]['synthetic']}" for side in ("now", "then") if compared[side].get("synthetic")]
    return " ".join(texts).capitalize() if texts else None


def format_value(value: object) -> str:
    """Format a figure of any kind: six digits of a fraction, all digits of a whole number, a dash for null."""
    if isinstance(value, bool):
        return format_cell(value, "bool")
    if isinstance(value, int):
        return f"{value:,}".replace("-", MINUS)
    if isinstance(value, float):
        return f"{value:,.6g}".replace("-", MINUS)
    return format_cell(value)


def format_difference(change: Row) -> str:
    """Format a difference with its sign; return nothing where there is none."""
    difference = change["difference"]
    return f"+{format_value(difference)}" if difference and difference > 0 else format_value(difference or "")
