"""Pages: one of the report per subset, drawn anew only where what it shows has changed."""

from collections.abc import Iterable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, connect, is_intact, scan
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, recordings
from tracklake.quality_reports.pages.page_names import FOLDER, name_pages
from tracklake.schemas import SPLITS
from tracklake.schemas.files import write_file

VERSION = 1


def plan(root: Path, manifest: Manifest, _settings: Settings) -> list[Job]:
    """One job per recording, made of all that was made of it, and of where it stands in the splits."""
    held = recordings(manifest)
    names = name_pages(
        [{"dataset": each["dataset"], "subset": subset["subset"]} for each in held for subset in each["subsets"]]
    )
    parts = _find_parts(root, manifest)
    jobs = []
    for each in held:
        tail = f"{each['dataset']}/{each['recording']}"
        subsets = [(each["dataset"], subset["subset"]) for subset in each["subsets"]]
        own = manifest.of_recording(tail).commits.values()
        made_of = {
            "entries": {entry.key: entry.fingerprint for entry in own if "/" in entry.key and entry.stage != "pages"},
            "parts": [parts.get(key, []) for key in subsets],
            "pages": [names[key] for key in subsets],
        }
        inputs = {"recording": tail, "pages": [(*key, names[key]) for key in subsets]}
        jobs.append(make_job(f"pages/{tail}", version_of_stage=VERSION, made_of=made_of, inputs=inputs))
    return jobs


def _find_parts(root: Path, manifest: Manifest) -> dict[tuple[str, str], list[Any]]:
    """The rows of `splits` by (dataset, subset); none where its files are not whole, so that it is made anew first."""
    if not is_intact(root, manifest.live(SPLITS.name)):
        return {}
    rows = scan(root, manifest, SPLITS).sort(SPLITS.key).collect()
    return {
        (str(dataset), str(subset)): [list(row) for row in of_subset.drop("dataset", "subset").iter_rows()]
        for (dataset, subset), of_subset in rows.group_by("dataset", "subset")
    }


def build(root: Path, job: Job, _settings: Settings) -> Commit:
    """Query what the lake holds of one recording and write its subsets' pages into reports/subsets/."""
    from tracklake.quality_reports.pages.subsets import render_pages
    from tracklake.quality_reports.summaries import collect

    provenance = {
        "lake": root.resolve().name,
        "created": datetime.now(tz=UTC).isoformat(timespec="seconds"),
        "tracklake": version("tracklake"),
    }
    names = {(dataset, subset): name for dataset, subset, name in job.inputs["pages"]}
    with connect(root, recording=job.inputs["recording"]) as connection:
        pages = render_pages(connection, collect(connection, provenance), names=names)
        files = [write_report_file(root, f"{FOLDER}/{name}", content) for name, content in pages]
    return make_commit(job, {REPORTS: files}, {"pages": job.inputs["pages"]})


def find_pages(root: Path, entries: Iterable[Commit]) -> dict[tuple[str, str], str]:
    """File names of the pages that are there, by (dataset, subset), of this stage's entries."""
    return {
        (dataset, subset): name
        for entry in entries
        if is_intact(root, entry.files[REPORTS])
        for dataset, subset, name in entry.info["pages"]
    }


def write_report_file(root: Path, name: str, content: str) -> LakeFile:
    """Put one file of the report into its place."""
    target = root / REPORTS / name
    target.parent.mkdir(parents=True, exist_ok=True)
    write_file(target, content.encode("utf-8", "backslashreplace"))
    return LakeFile(f"{REPORTS}/{name}", None, target.stat().st_size)
