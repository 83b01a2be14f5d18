"""Summaries of a run in the terminal: what was done, the report's figures, the quality of estimates."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tracklake.pipeline.cli.console import Terminal, find_command
from tracklake.pipeline.cli.drives import list_drives
from tracklake.pipeline.lake import connect, load_recent
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.orchestration.run_plan import RunResult
from tracklake.pipeline.stages.drive_score import collect_drive_scores
from tracklake.quality_reports.drives import describe_drive, describe_drives
from tracklake.quality_reports.groups import describe_subset_origins
from tracklake.quality_reports.reconstruction import collect_reconstruction, describe_reconstruction
from tracklake.quality_reports.summaries import query
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.start_assessments import ESTIMATORS
from tracklake.schemas.text import quote_shell

NUMBER = re.compile(r"\d[\d.,]*")
MOST_DRIVES = 10
"""Most drives that have a line of their own."""
FEW_NOTES = 3
"""Most notes that differ only in names and numbers and are printed one by one."""


def join_notes(notes: Iterable[str]) -> list[str]:
    """Return notes once each; of many that differ only in the name before a colon and in numbers, one and a count."""
    alike: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        name, separator, text = note.partition(": ")
        alike.setdefault(NUMBER.sub("0", text if separator and " " not in name else note), []).append(note)
    return [
        *(note for same in alike.values() if len(same) <= FEW_NOTES for note in same),
        *(f"{same[0]} (and {len(same) - 1} alike)" for same in alike.values() if len(same) > FEW_NOTES),
    ]


def show_result(terminal: Terminal, result: RunResult) -> None:
    """Print the notes, refusals and failures of a run."""
    for note in join_notes(result.notes):
        terminal.print_line(f"note: {note}", style="dim")
    if result.skipped and terminal.verbose:
        shown = ", ".join(result.skipped[:5]) + (", ..." if len(result.skipped) > 5 else "")
        terminal.print_line(f"note: skipped, no raw data: {shown}", style="dim")
    for message in result.refused:
        terminal.print_problem(message, label="refused")
    for message in result.failed:
        terminal.print_problem(message)


def show_headline(terminal: Terminal, quality: dict[str, Any], report: Path, lake: Path) -> None:
    """Print the report's figures, its path, and two commands to try next."""
    terminal.print_origin(describe_subset_origins(quality))
    head, drives = quality["headline"], list_drives(lake, load_recent(lake))
    excluded, judged = _format_count(head["excluded_subsets"]), head["eligible_starts"]
    late = "starts not judged" if judged is None else f"{head['late_starts']:,} late starts of {judged:,} judged"
    lines = {
        "recordings": f"{head['recordings']:,} recordings, {head['subsets']:,} subsets, {excluded} excluded",
        "tracks": f"{head['vehicles']:,} vehicles, {head['entries']:,} entries",
        "rows": f"{head['rows_read']:,} read, {head['rows_dropped']:,} rejected",
        "quality": f"{_format_count(head['vehicles_with_errors'])} vehicles with errors; " + late,
        "samples": "none" if head["samples"] is None else f"{head['samples']:,}{_describe_balance(quality)}",
    }
    reconstructed = quality["reconstruction"]["datasets"] if "reconstruction" in quality else []
    lines |= {f"reconstructed ({row['dataset']})": describe_reconstruction(row) for row in reconstructed}
    if drives and not head["subsets"]:
        lines = {"rows": lines["rows"]}  # the others are of recordings from above
    if drives:
        lines = {**_describe_drives(quality), **lines}
        origins = {row["subset"]: row["origin"] for row in drives}
        terminal.print_origin(describe_synthetic(origins, noun="drive", maker="instrument"))
    scores = [score for score in quality["model_scores"] if score["rows"]]
    for score in scores:
        radial = any(row["rmse_m"] is not None for row in score["rows"])
        name, figure = ("RMSE", "rmse_m") if radial else ("longitudinal RMSE", "rmse_longitudinal_m")
        lines[f"{name}, m ({score['model']})"] = _format_errors(score["rows"], figure)
    of_drives = collect_drive_scores(
        lake, load_recent(lake), lambda message: terminal.print_problem(message, label="skipped")
    )
    lines |= {f"MAE, m ({score['model']}, drives)": _format_errors(score["rows"], "mae_m") for score in of_drives}
    width = max(map(len, lines)) + 2
    for name, value in lines.items():
        terminal.print_line(f"{name:<{width}}{value}")
    terminal.print_line(f"{'report':<{width}}{report.resolve()}", style="bold green")
    origin = find_origin(lake)
    named = lake if origin is None else origin.address
    lake_option = "" if lake == Path("lake") else f" --lake {quote_shell(named)}"
    protocol = quality["provenance"]["protocol"]["name"]
    protocol_option = "" if protocol == "csp" else f" --protocol {protocol}"
    terminal.print_line("\nTry next:")
    command = find_command()
    if drives and not head["subsets"]:
        for query in ("FROM drives", "SELECT subset, vehicle_id, messages, lost FROM stations ORDER BY lost DESC"):
            terminal.print_line(f'  {command} sql "{query}"{lake_option}')
        if of_drives:
            terminal.print_line(f"  {command} onboard evaluate{lake_option}")
        return
    terminal.print_line(
        f'  {command} sql "SELECT rule, count(*) AS runs FROM findings GROUP BY rule ORDER BY runs DESC"{lake_option}'
    )
    terminal.print_line(
        f"  {command} train lstm{lake_option}{protocol_option}"
        if any(score["part"] == "eval" for score in scores)
        else f'  {command} sql "FROM subsets"{lake_option}'
    )


def _format_errors(rows: list[dict[str, Any]], figure: str) -> str:
    """Return the errors by horizon with n: each has its own, as errors over fewer samples may be less."""
    known = [row for row in rows if row[figure] is not None]
    errors = "  ".join(f"{row['seconds']:g} s {row[figure]:.2f}" for row in known)
    counts = ", ".join(f"{row['n']:,}" for row in known)
    return f"{errors}  (n = {counts})" if known else "none"


def _describe_drives(quality: dict[str, Any]) -> dict[str, str]:
    """Return a line for all drives of the report, one for each, and how many are left out."""
    drives = quality["drives"]["drives"] if "drives" in quality else []
    lines = {"drives": describe_drives(drives)} | {
        f"  {row['drive']}": describe_drive(row) for row in drives[:MOST_DRIVES]
    }
    return lines | ({"  ...": f"and {len(drives) - MOST_DRIVES} more"} if len(drives) > MOST_DRIVES else {})


def _format_count(count: int | None) -> str:
    return "no" if count is None else f"{count:,}"


def _describe_balance(quality: dict[str, Any]) -> str:
    others = {row["split"] for row in quality["splits"]["recipes"] if not row["trains"]}
    parts = [
        f"{row['dataset']} {row['part']} {row['vehicle_share']:.1%}"
        for row in quality["splits"]["balance"]
        if row["vehicle_share"] is not None and row["split"] not in others
    ]
    return f"; split by vehicles: {', '.join(parts)}" if parts else ""


def show_reconstruction(terminal: Terminal, root: Path) -> None:
    """Print how noisy the tracks of each dataset were, how far they were moved and what could not be kept."""
    with connect(root) as connection:
        figures = collect_reconstruction(connection)
    for row in figures["datasets"] if figures else ():
        terminal.print_line(f"{row['dataset']}: {describe_reconstruction(row)}")


def show_assessment(terminal: Terminal, root: Path) -> list[dict[str, Any]]:
    """Print coverage and excess of the estimated windows, beside those of other estimators.

    Returns the rows of assessed_subsets.sql over the whole lake, one per estimator; none where no track could be cut.
    """
    with connect(root) as connection:
        rows = query(connection, "assessed_subsets", {"estimators": list(ESTIMATORS)})
    overall = [row for row in rows if row["dataset"] is None]
    if not overall:
        terminal.print_line(
            "no estimate could be measured: no vehicle is fully tracked as far as 20 m beyond the cut-off"
        )
        return []
    ours, *others = overall
    terminal.print_line(
        f"the windows cover {ours['coverage']:.2%} of the time truly missing, and exclude another {ours['excess']:.2%} "
        f"without need ({ours['starts']:,} cut tracks, {ours['missing_s']:,.1f} s)"
    )
    others_text = (
        f"{row['estimator'].replace('_', ' ')} {row['coverage']:.2%} / {row['excess']:.2%}" for row in others
    )
    terminal.print_line(f"other estimators: {', '.join(others_text)}")
    return overall
