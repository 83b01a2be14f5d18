"""Artifacts of a flow run in Prefect's UI, as plain values: the report's tables of figures and its address."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.stages.report import DOCUMENT, PAGE

MAX_NAME_CHARS = 40
"""Longest part of the lake's folder name in a key, in characters."""


@dataclass(frozen=True)
class FigureTable:
    """A table of the report's figures.

    Args:
        key: lowercase letters, digits and dashes; the same in every run over this lake, another in another lake.
        description: meaning of a row.
        rows: plain values by heading.
    """

    key: str
    description: str
    rows: list[dict[str, Any]]


@dataclass(frozen=True)
class ReportLink:
    """A link to the report's page.

    Args:
        key: as that of a table.
        description: meaning of the link.
        address: file URI of the page.
        text: words shown instead of the address.
    """

    key: str
    description: str
    address: str
    text: str


def summarise_report(root: Path) -> tuple[list[FigureTable], ReportLink]:
    """Return the tables of reports/quality.json and the link to reports/index.html.

    Args:
        root: a lake with a report.

    Raises:
        OSError: the lake has no report.
    """
    quality = json.loads((root / REPORTS / DOCUMENT).read_text(encoding="utf-8"))
    lake, name = load(root), root.resolve().name

    def make_key(what: str) -> str:
        return "-".join(filter(None, ("tracklake", what, _make_slug(name), _make_slug(lake.lake_id)[:8])))

    tables = [
        FigureTable(make_key("findings"), "Per rule: what breaks it in the whole lake.", _list_findings(quality)),
        FigureTable(
            make_key("subsets"), "Per subset: its size, and the entries that break each rule.", _list_subsets(quality)
        ),
        FigureTable(
            make_key("ingestion"), "Per source file: rows read = rows kept + rows dropped.", _list_files(quality)
        ),
        FigureTable(
            make_key("completeness"),
            "Per recording: what was announced beside what was found.",
            _list_completeness(quality),
        ),
    ]
    page = (root / REPORTS / PAGE).resolve()
    # Brackets would end the link's text in the Markdown that Prefect makes of it.
    text = "quality report of " + re.sub(r"[^\w .-]", "_", name)
    where = "A page on the disk of the machine that made it; browsers open it by its address, not by a click."
    return tables, ReportLink(make_key("report"), where, page.as_uri(), text)


def _make_slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:MAX_NAME_CHARS].strip("-")


def _list_findings(quality: dict[str, Any]) -> list[dict[str, Any]]:
    counted = ("runs", "vehicles", "entries", "entry_share", "worst")
    return [
        {
            "rule": rule["name"],
            "severity": rule["severity"],
            **{("findings" if name == "runs" else name): rule["total"][name] for name in counted},
            "unit": rule["unit"],
            "subsets checked": f"{rule['total']['subsets_checked']} of {rule['total']['subsets_all']}",
        }
        for rule in quality["rules"]
    ]


def _list_subsets(quality: dict[str, Any]) -> list[dict[str, Any]]:
    entries = {
        (rule["name"], row["dataset"], row["subset"]): row["entries"]
        for rule in quality["rules"]
        for row in rule["subsets"]
    }
    shown = ("dataset", "subset", "vehicles", "entries", "excluded")
    names = [rule["name"] for rule in quality["rules"]]
    return [
        {name: row[name] for name in shown}
        | {name: entries.get((name, row["dataset"], row["subset"])) for name in names}
        for row in quality["subsets"]
    ]


def _list_files(quality: dict[str, Any]) -> list[dict[str, Any]]:
    shown = ("dataset", "file", "recording", "dialect", "rows_read", "rows_kept", "rows_dropped")
    return [{name: row[name] for name in shown} for row in quality["ingestion"]["files"]]


def _list_completeness(quality: dict[str, Any]) -> list[dict[str, Any]]:
    shown = ("dataset", "recording", "measure", "authority", "expected", "found", "agrees")
    return [{name: row[name] for name in shown} for row in quality["completeness"]]
