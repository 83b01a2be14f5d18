"""Report: the lake's quality as one page for people and one document for programs."""

import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, Manifest, connect, load
from tracklake.pipeline.lake.files import REPORTS, remove
from tracklake.pipeline.settings import PROTOCOL_SETTINGS, Settings
from tracklake.pipeline.sources import SOURCES
from tracklake.pipeline.stages.pages import find_pages, write_report_file
from tracklake.pipeline.stages.score import collect_scores, finished_runs
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, recordings
from tracklake.quality_reports.pages.page_names import FOLDER
from tracklake.quality_reports.pages.splits import SPLITS_PAGE
from tracklake.quality_reports.rules.registry import RULES, resolve
from tracklake.schemas.files import remove_unfinished
from tracklake.schemas.hashing import hash_chunks

VERSION = 4
PAGE, DOCUMENT = "index.html", "quality.json"
SHOWN_VERSIONS = ("polars", "pyarrow", "duckdb", "pandera", "prefect", "numpy")


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over everything that is in the lake, the subsets' pages among it."""
    entries = {key: entry.fingerprint for key, entry in manifest.commits.items() if entry.stage != "report"}
    runs = {path.parent.name: hash_chunks([path.read_bytes()], 16) for path in finished_runs(root)}
    made_of = {"entries": entries, "runs": runs, "settings": _shown(settings), **_find_thresholds(manifest, settings)}
    return [make_job("report", version_of_stage=VERSION, made_of=made_of, inputs={})]


def _shown(settings: Settings) -> dict[str, object]:
    """Settings that change what is in the lake, not where it stands or how fast it is made; thresholds apart.

    Those that are the protocol's where nobody sets them are shown as they are in force.
    """
    shown = settings.model_dump(mode="json", exclude={"lake", "workers", "runner", "dask_address", "thresholds"})
    protocol = settings.get_protocol()
    return shown | {name: getattr(protocol, name) for name in PROTOCOL_SETTINGS}


def _find_thresholds(manifest: Manifest, settings: Settings) -> dict[str, dict[str, Any]]:
    """What validation judged by, whatever the settings are now.

    Returns:
        thresholds: those of most recordings that are not the defaults, by name; of the settings before validation.
        thresholds_elsewhere: those of other recordings that differ from these, by `dataset/recording` and name.
    """
    defaults = resolve(RULES)
    used = {
        entry.key.partition("/")[2]: {
            name: entry.built_from["thresholds"].get(name, defaults[name]) for name in defaults
        }
        for entry in manifest.of_stage("validate")
    }
    usual = max(used.values(), key=list(used.values()).count, default=resolve(RULES, settings.thresholds))
    return {
        "thresholds": {name: value for name, value in usual.items() if value != defaults[name]},
        "thresholds_elsewhere": {
            recording: {name: value for name, value in values.items() if value != usual[name]}
            for recording, values in used.items()
            if values != usual
        },
    }


def build(root: Path, job: Job, settings: Settings) -> Commit:
    """Query the lake and write reports/index.html and reports/quality.json; the subsets' pages are there by then."""
    from tracklake.quality_reports.pages.report import build_report

    manifest = load(root)
    provenance = {
        "lake": root.resolve().name,
        "lake_id": manifest.lake_id,
        "created": datetime.now(tz=UTC).isoformat(timespec="seconds"),
        "tracklake": version("tracklake"),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in SHOWN_VERSIONS},
        **_find_thresholds(manifest, settings),
        "settings": _shown(settings),
        "data": {
            source.name: {"title": source.title, "licence": source.licence, "citation": source.citation}
            for source in SOURCES
            if any(recording["dataset"] == source.name for recording in recordings(manifest))
        },
        "protocol": {"name": settings.protocol, "digest": settings.get_protocol().digest},
    }
    # No overview leads to a page that is not there, and no page is of a subset that is gone.
    made = manifest.of_stage("pages")
    with connect(root) as connection:
        notes: list[str] = []
        scores = collect_scores(root, manifest, notes.append)
        report = build_report(connection, provenance, scores=scores, pages=find_pages(root, made))
    files = [write_report_file(root, PAGE, report.html), write_report_file(root, DOCUMENT, report.json)]
    if report.splits_html is not None:
        files.append(write_report_file(root, SPLITS_PAGE, report.splits_html))
    else:
        (root / REPORTS / SPLITS_PAGE).unlink(missing_ok=True)
    live = {root / file.path for entry in made for file in entry.files[REPORTS]}
    remove(root, [file for file in (root / REPORTS / FOLDER).glob("*.html") if file not in live])
    for folder in (root / REPORTS, root / REPORTS / FOLDER):
        remove_unfinished(folder)
    return make_commit(job, {REPORTS: files}, {"notes": notes})
