"""`tracklake report --compare`: two lakes opened and compared, the page beside the report, a table for people."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import cut_text, print_table
from tracklake.pipeline.lake import Manifest, connect, load, scan
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.stages.report import DOCUMENT, PAGE, make_report_error
from tracklake.pipeline.stages.score import collect_scores
from tracklake.quality_reports.pages.comparison import (
    describe_sides,
    format_difference,
    format_value,
    render_comparison,
)
from tracklake.quality_reports.pages.lake_differences import COUNTED, Side, compare
from tracklake.schemas import SUBSETS
from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import UNREADABLE
from tracklake.schemas.files import write_file
from tracklake.schemas.origin import describe_synthetic

COMPARISON = "compare.html"
MAX_ROWS = 20
"""Rows printed of each table; the page and --json have all."""

MAX_CELL_CHARS = 40
"""Longest cell printed in a table, in characters."""

MADE_WITH = (
    "tracklake", "schema_version", "stage_version", "source_version", "thresholds", "max_backward_share",
    "on_ramp_lanes", "protocol", "validation_part", "seed", "model",
)  # fmt: skip
"""Settings and versions, without inputs, among the facts that the manifest keeps of each build."""

SETTINGS_IN_DIGESTS = ("protocol", "min_future_s", "drop_error_findings", "nearest")
"""Settings of which the manifest keeps a digest only; the report names them."""

LIBRARIES = ("python", "versions")
"""Keys of the versions in the report's provenance."""

TABLES_SHOWN = {
    "subsets": ("subset",),
    "files": ("file",),
    "completeness": ("recording", "measure", "authority"),
    "samples": ("subset", "protocol"),
    "sample_drops": ("reason", "dataset"),
    "splits": ("subset", "split"),
    "split_balance": ("part", "dataset"),
    "evaluation": ("model", "part", "seconds"),
}
"""Columns that identify a row of each compared table."""


def compare_lakes(terminal: Terminal, root: Path, other: Path) -> dict[str, Any]:
    """Compare a lake with another, write reports/compare.html, and print what changed.

    Returns the `comparison` and the `comparison_page`, which is written into the reports of the lake now.
    """
    compared_at = datetime.now(tz=UTC).isoformat(timespec="seconds")
    # A missing report is no difference between the lakes' data.
    reported = all((lake / REPORTS / DOCUMENT).exists() for lake in (root, other))
    with (
        _open_side(terminal, other, reported=reported) as then,
        _open_side(terminal, root, reported=reported, compared=compared_at) as now,
    ):
        compared = compare(then, now)
    page = root / REPORTS / COMPARISON
    page.parent.mkdir(exist_ok=True)
    write_file(page, render_comparison(compared, report=PAGE).encode())
    terminal.print_line(f"\nnow:  {root.resolve()}\nthen: {other.resolve()}\n")
    terminal.print_origin(describe_sides(compared))
    show_comparison(terminal, compared)
    terminal.print_line(f"comparison  {page.resolve()}", style="bold green")
    return {"comparison": compared, "comparison_page": page.resolve()}


@contextmanager
def _open_side(terminal: Terminal, root: Path, *, reported: bool, **facts: str) -> Iterator[Side]:
    manifest = load(root)
    validated = manifest.of_stage("validate")
    origins = scan(root, manifest, SUBSETS).select("subset", "origin").collect()
    with connect(root) as connection:
        yield Side(
            connection=connection,
            facts={
                "lake": root.resolve().name,
                "lake_id": manifest.lake_id,
                "synthetic": describe_synthetic(dict(origins.iter_rows())),
                **facts,
            },
            rules=list(dict.fromkeys(name for entry in validated for name in entry.built_from["rules"])),
            made_with=_list_made_with(manifest) | ({"report": _read_provenance(root)} if reported else {}),
            scores=collect_scores(root, manifest, lambda message: terminal.print_problem(message, label="note")),
        )


def _list_made_with(manifest: Manifest) -> dict[str, Any]:
    """Collect settings and versions by stage from the manifest."""
    found: dict[str, dict[str, list[Any]]] = {}
    for entry in sorted(manifest.commits.values(), key=lambda entry: entry.key):
        if entry.stage in ("pages", "drive_pages", "report"):
            continue  # no table
        for name in (name for name in MADE_WITH if name in entry.built_from):
            values = found.setdefault(entry.stage, {}).setdefault(name, [])
            if entry.built_from[name] not in values:
                values.append(entry.built_from[name])
    return {
        # Recordings may have been made at different times, with different versions.
        stage: {
            name: values[0] if len(values) == 1 else list(map(json.dumps, values)) for name, values in names.items()
        }
        for stage, names in found.items()
    }


def _read_provenance(root: Path) -> dict[str, Any]:
    """Read the settings and versions that the report was written with."""
    file = root / REPORTS / DOCUMENT
    try:
        provenance = read_json(file)["provenance"]
        settings = {name: provenance["settings"].get(name) for name in SETTINGS_IN_DIGESTS}
        return settings | {name: provenance[name] for name in LIBRARIES}
    except UNREADABLE as broken:
        raise make_report_error(file, repr(broken)) from broken


def show_comparison(terminal: Terminal, compared: dict[str, Any]) -> None:
    """Print what differs between two lakes, the first rows of each kind."""
    if compared["equal"]:
        terminal.print_line(
            "nothing differs: figures, findings, source files, settings, versions and scores are the same"
        )
        return
    _show_changes(terminal, "figures", ("figure",), [row for row in compared["headline"] if row["then"] != row["now"]])
    _show_changes(terminal, "made with", ("name",), [{**row, "difference": None} for row in compared["made_with"]])
    for name, column in (("subsets", "subset"), ("rules", "rule"), ("files", "file")):
        for side in ("then", "now"):
            rows = compared[name][f"only_{side}"]
            only = [format_value(row[column] if isinstance(row, dict) else row) for row in rows]
            if only:
                rest = f" and {len(only) - MAX_ROWS} more" if len(only) > MAX_ROWS else ""
                terminal.print_line(f"{name} only {side}: {', '.join(only[:MAX_ROWS])}{rest}\n")
    for row in compared["files"]["renamed"]:
        then, now = (format_value(row[side]) for side in ("then", "now"))
        terminal.print_line(f"renamed: {then} is {now} now, with the same bytes\n")
    _show_counts(terminal, "findings per rule, of the subsets of both", ("rule",), compared["rules"]["totals"])
    _show_counts(terminal, "findings per rule and subset", ("rule", "subset"), compared["rules"]["changed"])
    for name, key in TABLES_SHOWN.items():
        _show_changes(terminal, name.replace("_", " "), (*key, "figure"), compared[name]["changed"])


def _show_changes(terminal: Terminal, title: str, key: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print rows of {key, then, now, difference}."""
    cells = [[*(format_value(row[name]) for name in key), *_format_change(row)] for row in rows]
    _show_table(terminal, title, key, ("then", "now", "difference"), cells)


def _show_counts(terminal: Terminal, title: str, key: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Print rows of {key, findings, vehicles, entries} in which any count differs."""
    different = [row for row in rows if any(row[name]["then"] != row[name]["now"] for name in COUNTED)]
    cells = [
        [*(format_value(row[name]) for name in key), *(cell for name in COUNTED for cell in _format_change(row[name]))]
        for row in different
    ]
    numbers = [heading for name in COUNTED for heading in (f"{name} then", "now", "+-")]
    _show_table(terminal, title, key, numbers, cells)


def _show_table(
    terminal: Terminal, title: str, key: Sequence[str], numbers: Sequence[str], rows: Sequence[Sequence[str]]
) -> None:
    if not rows:
        return
    cells = [[cut_text(cell, MAX_CELL_CHARS) for cell in row] for row in rows[:MAX_ROWS]]
    right = [False] * len(key) + [True] * len(numbers)
    print_table(terminal, [*key, *numbers], cells, title=title, right=right, indent=2)
    if len(rows) > MAX_ROWS:
        terminal.print_line(f"  the first {MAX_ROWS} of {len(rows):,}; the page and --json have all", style="dim")
    terminal.print_line("")


def _format_change(change: dict[str, Any]) -> tuple[str, str, str]:
    return format_value(change["then"]), format_value(change["now"]), format_difference(change)
