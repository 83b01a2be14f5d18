"""Pages of drives: what an instrumented vehicle heard and saw, how well it knows its surroundings, and its findings."""

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from tracklake.quality_reports.drives import collect_drives, describe_drive, read_drive, select_drive
from tracklake.quality_reports.pages.rendering import make_environment
from tracklake.quality_reports.plots import drives as plots
from tracklake.quality_reports.rules.registry import DRIVE_RULES, describe
from tracklake.quality_reports.summaries import Connection, Row, query, query_frame
from tracklake.quality_reports.verdicts import SEVERITIES
from tracklake.schemas.origin import describe_synthetic

MOST_FINDINGS = 20
"""Most findings that a page lists, the worst of each rule first."""
USUAL_SIZE_M = (4.5, 1.8)
"""Length and width drawn of an ego of unknown size, in m."""


def render_drive(
    connection: Connection, drive: str, provenance: Mapping[str, Any], thresholds: Mapping[str, float] | None = None
) -> str:
    """Render the page of one drive.

    Args:
        connection: connection to a lake, or to one recording of it.
        drive: name of the drive.
        provenance: facts that the page shows; see `quality_reports.summaries.collect`.
        thresholds: thresholds that the drive's findings used, where they are no defaults.
    """
    collected = collect_drives(connection, only=drive)
    assert collected is not None
    figures = select_drive(collected, drive)
    (facts,) = figures["drives"]
    declared = {rule["name"]: rule for rule in describe(DRIVE_RULES, thresholds)}
    rules = [{**declared[row["rule"]], **row} for row in figures["rules"] if row["rule"] in declared]
    rules.sort(key=lambda rule: (SEVERITIES.index(rule["severity"]), -rule["entries"]))
    return (
        make_environment()
        .get_template("drive.html.j2")
        .render(
            drive=facts,
            summary=describe_drive(facts),
            provenance=provenance,
            banner=describe_synthetic({drive: facts["origin"]}, noun="drive", maker="instrument"),
            stations=figures["stations"],
            rules=rules,
            findings=query(connection, "drive_worst", {"drive": drive, "most": MOST_FINDINGS}),
            errors=figures["errors"],
            losses=figures["losses"],
            files=query(connection, "drive_files", {"drive": drive}),
            **_draw(connection, drive, figures),
        )
    )


def _draw(connection: Connection, drive: str, figures: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """Draw the plots of a page as markup; None where there are no data."""
    rows = read_drive(connection, drive)
    moments = plots.choose_moments(rows.ticks)
    (size,) = query(connection, "drive_ego", {"drive": drive})
    size_m = size["length_m"] or USUAL_SIZE_M[0], size["width_m"] or USUAL_SIZE_M[1]
    vehicles = plots.list_vehicles(rows.messages, rows.ticks)
    truth = query_frame(connection, "drive_truth", {"drive": drive, "ticks": moments})
    views = plots.draw_surroundings(rows.ticks, truth, moments, size_m) if moments else []
    drawn = {
        "legend": moments and plots.draw_sources(),
        "ways": rows.ticks.height and plots.draw_ways(rows.ticks),
        "support": vehicles and plots.draw_support(rows.messages, rows.ticks, vehicles[: plots.MOST_VEHICLES]),
        "loss_plot": figures["losses"] and plots.draw_losses(figures["losses"]),
        "error_plot": figures["errors"] and plots.draw_errors(figures["errors"]),
    }
    # Of our own words and numbers.
    shown: dict[str, Any] = {name: Markup(svg) if svg else None for name, svg in drawn.items()}
    shown["surroundings"] = [(tick / 10, Markup(view)) for tick, view in zip(moments, views, strict=True)]
    return {**shown, "vehicles_left_out": max(0, len(vehicles) - plots.MOST_VEHICLES)}
