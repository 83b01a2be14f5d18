"""Page of the differences between two lakes: self-contained, in the report's style."""

import re

from tracklake.quality_reports.pages.lake_differences import COUNTED
from tracklake.quality_reports.pages.rendering import format_cell, make_environment
from tracklake.quality_reports.summaries import Row

MINUS = "\N{MINUS SIGN}"
LESS_IS_BETTER = re.compile(
    r"findings|vehicles_with_errors|excluded_subsets|late_starts|late(_share)?|rows_dropped|rmse_m|.*_rms_.*|"
    r"(high_jerk|jerk_flicker)_share|worst_jerk_mps3|dropped|collisions|crowded_out"
)
"""Figures that are better when they are less; those of findings by rule are as well."""
MORE_IS_BETTER = re.compile(r"share_without_.*|vehicles_without_.*|samples|kept_share|found(_share)?|rows_kept")
"""Figures that are better when they are more."""
PARTS = {
    "subsets": "subsets",
    "rules": "findings",
    "files": "source files",
    "completeness": "completeness",
    "samples": "samples",
    "sample_drops": "dropped samples",
    "splits": "splits",
    "split_balance": "balance of the splits",
    "evaluation": "scores",
}
"""Compared parts that hold differences, and their names."""
ANCHORS = {"sample_drops": "samples", "split_balance": "splits"}
"""Sections of the parts that have none of their own."""


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
        **{**compared, **sides},
        counted=COUNTED,
        report=report,
        banner=describe_sides(compared),
        summary=summarise(compared),
        judged=judge_change,
    )


def summarise(compared: Row) -> list[Row]:
    """Return what differs, part by part: name, anchor, differences, those for the better and those for the worse."""
    none = {"better": 0, "worse": 0, "only": 0}
    made_with = len(compared["made_with"])
    rows = [{"name": "settings and versions", "anchor": "made-with", "changed": made_with} | none] if made_with else []
    for part, name in PARTS.items():
        changed = compared[part]["changed"]
        judged = [judge_change(row, row["figure"]) for row in changed if "figure" in row]
        judged += [judge_change(row["entries"], "findings") for row in changed if "figure" not in row]
        only = sum(len(compared[part].get(side, ())) for side in ("only_then", "only_now"))
        if changed or only:
            counts = {side: judged.count(side) for side in ("better", "worse")}
            rows.append(
                {"name": name, "anchor": ANCHORS.get(part, part), "changed": len(changed), "only": only} | counts
            )
    return rows


def judge_change(change: Row, figure: str) -> str:
    """Return better or worse for a figure whose direction is known; nothing for others and where nothing changed."""
    difference = change["difference"]
    if not difference or isinstance(difference, bool):
        return ""
    if LESS_IS_BETTER.fullmatch(figure):
        return "better" if difference < 0 else "worse"
    if MORE_IS_BETTER.fullmatch(figure):
        return "better" if difference > 0 else "worse"
    return ""


def describe_sides(compared: Row) -> str | None:
    """Describe what is synthetic in each of two compared lakes; None where nothing is."""
    now: str | None = compared["now"].get("synthetic")
    then: str | None = compared["then"].get("synthetic")
    if now == then:
        return now
    return " ".join(f"{side}: {text}" for side, text in (("Now", now), ("Then", then)) if text)


def format_value(value: object) -> str:
    """Format a figure of any kind: six digits of a fraction, all digits of a whole number, a dash for null."""
    if isinstance(value, bool):
        return format_cell(value, "bool")
    if isinstance(value, int):
        return f"{value:,}".replace("-", MINUS)
    if isinstance(value, float):
        return (f"{value:,.6g}" if abs(value) < 1e6 else f"{value:,.0f}").replace("-", MINUS)
    return format_cell(value)


def format_difference(change: Row) -> str:
    """Format a difference with its sign; return nothing where there is none."""
    difference = change["difference"]
    return f"+{format_value(difference)}" if difference and difference > 0 else format_value(difference or "")
