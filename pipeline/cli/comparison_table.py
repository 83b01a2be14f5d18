"""`tracklake report --compare`: two lakes opened and compared, the page beside the report, a table for people."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.lake import Manifest, connect, load
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.stages.report import DOCUMENT, PAGE
from tracklake.pipeline.stages.score import collect_scores
from tracklake.quality_reports.pages.comparison import format_difference, format_value, render_comparison
from tracklake.quality_reports.pages.lake_differences import COUNTED, Side, compare
from tracklake.schemas.files import write_file

COMPARISON = "compare.html"
SHOWN_ROWS = 20
"""Of each table for people; the page and --json have all."""
SHOWN_CHARACTERS = 40
"""Of one value in them."""

MADE_WITH = (
    "tracklake", "schema_version", "stage_version", "source_version", "thresholds", "max_backward_share",
    "on_ramp_lanes", "protocol", "validation_part", "seed", "model",
)  # fmt: skip
"""Of what the lake remembers its tables were built from: settings and versions, not inputs."""
SETTINGS_IN_DIGESTS = ("protocol", "min_future_s", "drop_error_findings", "nearest")
"""Settings that the tables remember as a digest only; the report names them."""
LIBRARIES = ("python", "versions")
"""Of the report's provenance."""

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
"""What identifies a row for people."""


def compare_lakes(terminal: Terminal, root: Path, other: Path) -> dict[str, Any]:
    """Compare a lake with another, write reports/compare.html, and print what changed.

    Args:
        terminal: for the tables.
        root: the lake now; the page goes into its reports.
        other: the lake then.

    Returns:
        What `quality_reports.pages.lake_differences.compare` returns as `comparison`, and the page as
        `comparison_page`.

    Raises:
        LakeMissingError: no lake there.
        LakeError: a live file is missing or unreadable.
    """
    compared_at = datetime.now(tz=UTC).isoformat(timespec="seconds")
    # That one of them has no report says nothing about what is in the lakes.
    reported = all((lake / REPORTS / DOCUMENT).exists() for lake in (root, other))
    with (
        _side(terminal, other, reported=reported) as then,
        _side(terminal, root, reported=reported, compared=compared_at) as now,
    ):
        compared = compare(then, now)
    page = root / REPORTS / COMPARISON
    page.parent.mkdir(exist_ok=True)
    write_file(page, render_comparison(compared, report=PAGE).encode())
    terminal.say(f"\nnow:  {root.resolve()}\nthen: {other.resolve()}\n")
    show_comparison(terminal, compared)
    terminal.say(f"comparison  {page.resolve()}", style="bold green")
    return {"comparison": compared, "comparison_page": page.resolve()}


@contextmanager
def _side(terminal: Terminal, root: Path, *, reported: bool, **facts: str) -> Iterator[Side]:
    manifest = load(root)
    validated = manifest.of_stage("validate")
    with connect(root) as connection:
        yield Side(
            connection=connection,
            facts={"lake": root.resolve().name, "lake_id": manifest.lake_id, **facts},
            rules=list(dict.fromkeys(name for entry in validated for name in entry.built_from["rules"])),
            made_with=_made_with(manifest) | ({"report": _cited(root)} if reported else {}),
            scores=collect_scores(root, manifest, lambda told: terminal.complain(told, label="note")),
        )


def _made_with(manifest: Manifest) -> dict[str, Any]:
    """Settings and versions by stage, as the tables remember them."""
    found: dict[str, dict[str, list[Any]]] = {}
    for entry in sorted(manifest.commits.values(), key=lambda entry: entry.key):
        if entry.stage in ("pages", "report"):
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


def _cited(root: Path) -> dict[str, Any]:
    """What the report was written with."""
    provenance = json.loads((root / REPORTS / DOCUMENT).read_text(encoding="utf-8"))["provenance"]
    settings = {name: provenance["settings"].get(name) for name in SETTINGS_IN_DIGESTS}
    return settings | {name: provenance[name] for name in LIBRARIES}


def show_comparison(terminal: Terminal, compared: dict[str, Any]) -> None:
    """Print what differs between two lakes, the first rows of each kind."""
    if compared["equal"]:
        terminal.say("nothing differs: figures, findings, source files, settings, versions and scores are the same")
        return
    shown = _Tables(terminal)
    shown.show("figures", ("figure",), [row for row in compared["headline"] if row["then"] != row["now"]])
    shown.show("made with", ("name",), [{**row, "difference": None} for row in compared["made_with"]])
    for name, column in (("subsets", "subset"), ("rules", "rule"), ("files", "file")):
        for side in ("then", "now"):
            rows = compared[name][f"only_{side}"]
            only = [format_value(row[column] if isinstance(row, dict) else row) for row in rows]
            if only:
                rest = f" and {len(only) - SHOWN_ROWS} more" if len(only) > SHOWN_ROWS else ""
                terminal.say(f"{name} only {side}: {', '.join(only[:SHOWN_ROWS])}{rest}\n")
    for row in compared["files"]["renamed"]:
        then, now = (format_value(row[side]) for side in ("then", "now"))
        terminal.say(f"renamed: {then} is {now} now, with the same bytes\n")
    shown.show_counts("findings per rule, of the subsets of both", ("rule",), compared["rules"]["totals"])
    shown.show_counts("findings per rule and subset", ("rule", "subset"), compared["rules"]["changed"])
    for name, key in TABLES_SHOWN.items():
        shown.show(name.replace("_", " "), (*key, "figure"), compared[name]["changed"])


class _Tables:
    """Prints tables of changes."""

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal

    def show(self, title: str, key: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
        """Rows of {key, then, now, difference}."""
        cells = [[*(format_value(row[name]) for name in key), *_pair(row)] for row in rows]
        self._print(title, key, ("then", "now", "difference"), cells)

    def show_counts(self, title: str, key: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
        """Rows of {key, findings, vehicles, entries} of which anything differs."""
        different = [row for row in rows if any(row[name]["then"] != row[name]["now"] for name in COUNTED)]
        cells = [
            [*(format_value(row[name]) for name in key), *(cell for name in COUNTED for cell in _pair(row[name]))]
            for row in different
        ]
        self._print(title, key, [heading for name in COUNTED for heading in (f"{name} then", "now", "+-")], cells)

    def _print(self, title: str, key: Sequence[str], numbers: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        if not rows:
            return
        cells = [(*key, *numbers), *([_cut(cell) for cell in row] for row in rows[:SHOWN_ROWS])]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        self._terminal.say(title, style="bold")
        for row in cells:
            shown = [
                cell.ljust(width) if number < len(key) else cell.rjust(width)
                for number, (cell, width) in enumerate(zip(row, widths, strict=True))
            ]
            self._terminal.say("  " + "  ".join(shown).rstrip())
        if len(rows) > SHOWN_ROWS:
            self._terminal.say(f"  the first {SHOWN_ROWS} of {len(rows):,}; the page and --json have all", style="dim")
        self._terminal.say("")


def _cut(text: str) -> str:
    return text if len(text) <= SHOWN_CHARACTERS else text[: SHOWN_CHARACTERS - 1] + "…"


def _pair(change: dict[str, Any]) -> tuple[str, str, str]:
    return format_value(change["then"]), format_value(change["now"]), format_difference(change)
