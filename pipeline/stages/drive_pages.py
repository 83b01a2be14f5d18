"""Drive pages: one page of the report per drive, written again only where what it shows has changed."""

from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Manifest, open_recordings
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.pages import describe_origin, write_report_file
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.quality_reports.pages.page_names import DRIVES_FOLDER, name_pages


def _find_inputs(_root: Path, manifest: Manifest, _settings: Settings) -> dict[str, dict[str, Any]]:
    """Return by recording all that was made of its drives, and the names of their pages."""
    drives = {commit.tail: commit.info.get("drives", ()) for commit in manifest.of_stage(INGEST)}
    names = name_pages([{"dataset": "v2v", "subset": name} for own in drives.values() for name in own])
    made: dict[str, dict[str, str]] = {tail: {} for tail, own in drives.items() if own}
    for commit in manifest.commits.values():
        if commit.tail in made and commit.stage != "drive_pages":
            made[commit.tail][commit.key] = commit.fingerprint
    return {
        tail: {"commits": commits, "pages": {name: names["v2v", name] for name in drives[tail]}}
        for tail, commits in made.items()
    }


def build(reader: SubsetReader, _settings: Settings) -> StageResult:
    """Query what the lake holds of a drive and write its page into reports/drives/."""
    from tracklake.quality_reports.pages.drives import render_drive

    tail, name = reader.job.tail, reader.job.built_from["pages"][reader.subset]
    findings = reader.manifest.commits.get(f"drive_findings/{tail}")
    thresholds = findings.built_from["thresholds"] if findings else None
    with open_recordings(reader.root, reader.manifest, [tail]) as connection:
        content = render_drive(connection, reader.subset, describe_origin(reader.root), thresholds)
    file = write_report_file(reader.root, f"{DRIVES_FOLDER}/{name}", content)
    return StageResult(files={REPORTS: [file]}, info={"pages": [(reader.partition["dataset"], reader.subset, name)]})


STAGE = Stage(
    name="drive_pages",
    meaning="Draw the report's page of each drive.",
    scope="drive",
    after=(),  # a page shows what there is
    version=2,
    build=build,
    extra_inputs=_find_inputs,
)
