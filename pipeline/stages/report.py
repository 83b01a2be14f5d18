"""Report: the lake's quality as one page for people and one document for programs."""

import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from pipeline.lake import Entry, LakeFile, Manifest, connect, load, write_aside
from pipeline.lake.files import REPORTS, remove
from pipeline.lake.manifest import remove_leftovers
from pipeline.settings import Settings
from pipeline.sources import SOURCES
from pipeline.stages.base import Job, make_entry, make_job, recordings
from pipeline.stages.score import collect_scores, finished_runs

VERSION = 2
PAGE, DOCUMENT = "index.html", "quality.json"
SHOWN_VERSIONS = ("polars", "pyarrow", "duckdb", "pandera", "prefect", "numpy")


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over everything that is in the lake."""
    entries = {key: entry.fingerprint for key, entry in manifest.entries.items() if entry.stage != "report"}
    runs = {path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in finished_runs(root)}
    made_of = {"entries": entries, "runs": runs, "settings": _shown(settings)}
    return [make_job("report", version_of_stage=VERSION, made_of=made_of, inputs={})]


def _shown(settings: Settings) -> dict[str, object]:
    """Settings that change what is in the lake, not where it stands or how fast it is made."""
    return settings.model_dump(mode="json", exclude={"lake", "workers", "runner", "dask_address"})


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Query the lake and write reports/subsets/, one page each, then reports/index.html and reports/quality.json."""
    from quality_reports.report import build_report
    from quality_reports.subset_pages import FOLDER, render_pages

    manifest = load(root)
    provenance = {
        "lake": root.resolve().name,
        "lake_id": manifest.lake_id,
        "created": datetime.now(tz=UTC).isoformat(timespec="seconds"),
        "tracklake": version("tracklake"),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in SHOWN_VERSIONS},
        "thresholds": settings.thresholds,
        "settings": _shown(settings),
        "data": {
            source.name: {"title": source.title, "licence": source.licence, "citation": source.citation}
            for source in SOURCES
            if any(recording["dataset"] == source.name for recording in recordings(manifest))
        },
        "protocol": {"name": settings.protocol, "digest": settings.get_protocol().digest},
    }
    with connect(root) as connection:
        report = build_report(connection, provenance, scores=collect_scores(root, manifest))
        pages = [
            _write(root, f"{FOLDER}/{name}", content) for name, content in render_pages(connection, report.quality)
        ]
    # Last, so that no overview leads to a page that is not there.
    files = [*pages, _write(root, PAGE, report.html), _write(root, DOCUMENT, report.json)]
    written = {root / file.path for file in pages}
    remove(root, [file for file in (root / REPORTS / FOLDER).glob("*.html") if file not in written])
    return make_entry(job, {REPORTS: files}, {})


def _write(root: Path, name: str, content: str) -> LakeFile:
    """Put one file of the report into its place."""
    target = root / REPORTS / name
    target.parent.mkdir(parents=True, exist_ok=True)
    # What a killed process left beside it, in whose place this one works now.
    remove_leftovers(target.parent)
    write_aside(target, content.encode("utf-8", "backslashreplace"))
    return LakeFile(f"{REPORTS}/{name}", None, target.stat().st_size)
