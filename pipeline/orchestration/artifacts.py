"""What Prefect's UI shows of a flow run: its name, the report's figures and address, its refusals and notes."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
from prefect.artifacts import create_table_artifact
from prefect.context import FlowRunContext

from tracklake.pipeline.lake import load_recent
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.orchestration.run_plan import RunRequest, RunResult
from tracklake.pipeline.stages.report import PAGE, read_quality
from tracklake.schemas.text import make_visible

OUR_FAULTS = (400, 422)
"""HTTP statuses with which Prefect's API answers a request that is wrong in itself."""
MAX_NAMED = 3
"""Most recordings in a run's name."""
MAX_NAME_CHARS = 40
"""Longest part of the lake's folder name in a key, in characters."""

FILE_COLUMNS = ("dataset", "file", "recording", "dialect", "rows_read", "rows_kept", "rows_dropped")
"""Figures of each source file that a run shows."""
COUNT_COLUMNS = ("dataset", "recording", "measure", "authority", "expected", "found", "agrees")
"""Figures of what was announced that a run shows."""


@dataclass(frozen=True)
class FigureTable:
    """A table of the report's figures: plain values by heading, and what a row means.

    The key has lowercase letters, digits and dashes; it is the same in every run over this lake, another in another
    lake.
    """

    key: str
    description: str
    rows: list[dict[str, Any]]


def summarise_report(root: Path) -> tuple[list[FigureTable], dict[str, Any]]:
    """Return the tables of reports/quality.json, and the link to reports/index.html as Prefect takes it.

    Raises:
        OSError: the lake has no report.
    """
    quality = read_quality(root)
    make_key = partial(_make_key, root=root, lake_id=load_recent(root).lake_id)
    figures = (
        ("findings", "Per rule: what breaks it in the whole lake.", _list_findings(quality)),
        ("subsets", "Per subset: its size, and the entries that break each rule.", _list_subsets(quality)),
        (
            "ingestion",
            "Per source file: rows read = rows kept + rows dropped.",
            _select(quality["ingestion"]["files"], FILE_COLUMNS),
        ),
        (
            "completeness",
            "Per recording: what was announced beside what was found.",
            _select(quality["completeness"], COUNT_COLUMNS),
        ),
    )
    link: dict[str, Any] = {
        "key": make_key("report"),
        "description": "A page on the disk of the machine that made it; browsers open it by its address, not by a "
        "click.",
        "link": (root / REPORTS / PAGE).resolve().as_uri(),
        # Brackets would end the link's text in the Markdown that Prefect makes of it.
        "link_text": "quality report of " + re.sub(r"[^\w .-]", "_", root.resolve().name),
    }
    return [FigureTable(make_key(what), meaning, rows) for what, meaning, rows in figures], link


def tabulate_messages(root: Path, lake_id: str, result: RunResult) -> FigureTable:
    """Return a table of a run's failures, refusals and notes, with the level that each has in the run's log."""
    kinds = (
        ("failed", "ERROR", result.failed),
        ("refused", "WARNING", result.refused),
        ("note", "INFO", result.notes),
        ("removed", "INFO", result.removed),
        ("skipped, no raw data", "INFO", result.skipped),
    )
    rows = [
        {"kind": kind, "level": level, "message": make_visible(message, keep="\n")}
        for kind, level, messages in kinds
        for message in dict.fromkeys(messages)
    ]
    key = _make_key("messages", root=root, lake_id=lake_id)
    return FigureTable(key, "What the run has to say: failures, refusals, notes.", rows)


def name_run(request: RunRequest, recordings: list[str]) -> None:
    """Name the flow run after its source, or lake, and recordings: `run highd: 04, 05`."""
    context = FlowRunContext.get()
    if context is None or context.flow_run is None:
        return
    named = ", ".join(recordings[:MAX_NAMED]) or "nothing new"
    if len(recordings) > MAX_NAMED:
        named += f" and {len(recordings) - MAX_NAMED} more"
    place = Path(request.source or request.lake).name
    name = f"{context.flow_run.name.partition(' ')[0]} {place}: {named}"
    attach(partial(context.client.set_flow_run_name, context.flow_run.id, name))


def publish(tables: list[FigureTable]) -> list[str]:
    """Attach tables to the flow run; returns a note where Prefect's API fails."""
    make = create_table_artifact
    return attach(*(partial(make, table=t.rows, key=t.key, description=t.description) for t in tables))


def attach(*calls: Callable[[], object]) -> list[str]:
    """Call Prefect's API for what only shows a run; returns a note where it fails.

    The lake is whole without it, so that a server that is busy, missing or forbids it fails no run. One that
    understands the request and calls it wrong has found a fault of ours, which is raised.
    """
    try:
        for call in calls:
            call()
    except (httpx.TransportError, httpx.HTTPStatusError) as failed:
        if isinstance(failed, httpx.HTTPStatusError) and failed.response.status_code in OUR_FAULTS:
            raise
        reason = str(failed).splitlines()[0] if str(failed) else type(failed).__name__
        return [f"Prefect did not take all that describes this run ({reason}); the lake and its report are whole"]
    return []


def _make_key(what: str, *, root: Path, lake_id: str) -> str:
    return "-".join(filter(None, ("tracklake", what, _make_slug(root.resolve().name), _make_slug(lake_id)[:8])))


def _make_slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:MAX_NAME_CHARS].strip("-")


def _select(rows: list[dict[str, Any]], names: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{name: row[name] for name in names} for row in rows]


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
