"""Report: the lake's quality as one page for people and one document for programs."""

import platform
import shlex
from collections import Counter
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import polars as pl
from pydantic import TypeAdapter, ValidationError

from tracklake.pipeline.lake import LakeError, Manifest, open_stored, scan
from tracklake.pipeline.lake.files import REPORTS, remove_files
from tracklake.pipeline.settings import PROTOCOL_SETTINGS, Settings
from tracklake.pipeline.sources import SOURCES
from tracklake.pipeline.stages.drive_score import collect_drive_scores, list_finished_drive_runs
from tracklake.pipeline.stages.pages import describe_origin, find_pages, write_report_file
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.score import collect_scores, list_finished_runs
from tracklake.pipeline.stages.stage import Stage, StageResult
from tracklake.quality_reports.pages.page_names import DRIVES_FOLDER, FOLDER
from tracklake.quality_reports.rules.registry import RULES, resolve, select_thresholds
from tracklake.schemas import (
    COMPLETENESS,
    DRIVES,
    FINDINGS,
    INGEST_LOG,
    RECONSTRUCTED_FINDINGS,
    RECONSTRUCTED_SUBSET_SCORES,
    RECONSTRUCTION_QUALITY,
    SAMPLE_COUNTS,
    SAMPLE_DROPS,
    START_ASSESSMENTS,
    START_CUTOFFS,
    SUBSET_SCORES,
    SUBSETS,
    VEHICLES,
)
from tracklake.schemas.documents import read_json
from tracklake.schemas.files import remove_unfinished
from tracklake.schemas.hashing import hash_chunks
from tracklake.schemas.quality import Quality

PAGE = "index.html"
"""Name of the report's page for people."""
DOCUMENT = "quality.json"
"""Name of the report's document for programs."""
READ_OFTEN = (
    *(COMPLETENESS, FINDINGS, INGEST_LOG, SAMPLE_COUNTS, SAMPLE_DROPS, START_ASSESSMENTS, START_CUTOFFS, SUBSETS),
    *(SUBSET_SCORES, VEHICLES, RECONSTRUCTION_QUALITY, RECONSTRUCTED_FINDINGS, RECONSTRUCTED_SUBSET_SCORES),
)
"""Tables that several of the overview's statements read; opening thousands of files takes longer than all else."""
SHOWN_VERSIONS = ("polars", "pyarrow", "duckdb", "pandera", "prefect", "numpy")
"""Libraries whose versions the report names."""


def _find_inputs(root: Path, manifest: Manifest, settings: Settings) -> dict[str, dict[str, Any]]:
    """Return everything in the lake, the subsets' pages and the models' runs among it, as the report's inputs."""
    commits = {key: commit.fingerprint for key, commit in manifest.commits.items() if commit.stage != "report"}
    paths = {path.parent.name: path for path in list_finished_runs(root)}
    paths |= {f"onboard/{path.parent.name}": path for path in list_finished_drive_runs(root)}
    runs = {name: hash_chunks([path.read_bytes()], 16) for name, path in paths.items()}
    return {"": {"commits": commits, "runs": runs, **_find_thresholds(manifest, settings)}}


def _describe_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings that change what is made of the tracks; thresholds apart.

    Those that the protocol decides where the user sets none are given as they are in force.
    """
    of_the_run = {"lake", "columns", "recording", "workers", "slice_entries", "runner", "dask_address", "refusals_fail"}
    of_the_files = {"cache", "cache_gb", "kept_generations", "kept_hours", "pages_of"}
    shown = settings.model_dump(mode="json", exclude={*of_the_run, *of_the_files, "thresholds"})
    protocol = settings.get_protocol()
    return {"settings": shown | {name: getattr(protocol, name) for name in PROTOCOL_SETTINGS}}


def _find_thresholds(manifest: Manifest, settings: Settings) -> dict[str, dict[str, Any]]:
    """Return the thresholds that validation used, whatever the settings are now.

    Returns:
        thresholds: those of most recordings that are not the defaults, by name; of the settings before validation.
        thresholds_elsewhere: those of other recordings that differ from these, by `dataset/recording` and name.
    """
    defaults = resolve(RULES)
    used = {
        commit.tail: {name: commit.built_from["thresholds"].get(name, defaults[name]) for name in defaults}
        for commit in manifest.of_stage("validate")
    }
    counts = Counter(tuple(values.values()) for values in used.values())
    if counts:
        ((most, _),) = counts.most_common(1)  # the first of those that are as common
        usual = dict(zip(defaults, most, strict=True))
    else:
        usual = resolve(RULES, select_thresholds(RULES, settings.thresholds))
    return {
        "thresholds": {name: value for name, value in usual.items() if value != defaults[name]},
        "thresholds_elsewhere": {
            recording: {name: value for name, value in values.items() if value != usual[name]}
            for recording, values in used.items()
            if values != usual
        },
    }


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Query the lake and write the overview, the pages beside it and quality.json; the subsets' pages are there."""
    from tracklake.quality_reports.pages.report import OTHER_PAGES, build_report

    root, manifest, built_from = reader.root, reader.manifest, reader.job.built_from
    origins = pl.concat(scan(root, manifest, table).select("dataset", "origin") for table in (SUBSETS, DRIVES))
    datasets = set(origins.filter(pl.col("origin") == "recorded").collect()["dataset"])
    provenance = {
        **{"lake": None, "lake_id": manifest.lake_id, **describe_origin(root)},
        "python": platform.python_version(),
        "versions": {name: version(name) for name in SHOWN_VERSIONS},
        **{name: built_from[name] for name in ("thresholds", "thresholds_elsewhere", "settings")},
        "data": {
            source.name: {"title": source.title, "licence": source.licence, "citation": source.citation}
            for source in SOURCES
            if source.name in datasets
        },
        "protocol": {"name": settings.protocol, "digest": settings.get_protocol().digest},
    }
    made = [*manifest.of_stage("pages"), *manifest.of_stage("drive_pages")]
    with open_stored(root, manifest, READ_OFTEN) as connection:
        notes: list[str] = []
        scores = collect_scores(root, manifest, notes.append)
        drive_scores = collect_drive_scores(root, manifest, notes.append)
        report = build_report(
            connection,
            provenance,
            scores=scores,
            drive_scores=drive_scores,
            published_drive_scores=_list_published() if drive_scores else (),
            pages=find_pages(root, made),
        )
    files = [write_report_file(root, PAGE, report.html), write_report_file(root, DOCUMENT, report.json)]
    files += [write_report_file(root, name, content) for name, content in report.others.items()]
    for name in {*OTHER_PAGES} - report.others.keys():
        (root / REPORTS / name).unlink(missing_ok=True)
    # Pages of subsets and drives that are no longer in the lake, which the overview does not link to.
    live = {root / file.path for commit in made for file in commit.files[REPORTS]}
    folders = [root / REPORTS / name for name in (FOLDER, DRIVES_FOLDER)]
    remove_files(root, [file for folder in folders for file in folder.glob("*.html") if file not in live])
    for folder in (root / REPORTS, *folders):
        remove_unfinished(folder)
    return StageResult(files={REPORTS: files}, notes=notes)


def _list_published() -> list[dict[str, Any]]:
    """List the published scores of models on drives."""
    from tracklake.training.onboard.scores import list_published

    return [asdict(row) for row in list_published()]


def read_quality(root: Path) -> dict[str, Any]:
    """Read a lake's reports/quality.json.

    Raises:
        LakeError: it is damaged, or has other keys than those of `schemas.quality`.
    """
    file = root / REPORTS / DOCUMENT
    try:
        quality = read_json(file)
        _make_quality_type().validate_python(quality)
    except ValidationError as wrong:
        first = wrong.errors()[0]
        raise make_report_error(file, f"`{'.'.join(map(str, first['loc']))}`: {first['msg']}") from None
    except (OSError, ValueError) as broken:
        raise make_report_error(file, str(broken)) from broken
    return dict(quality)


@cache
def _make_quality_type() -> TypeAdapter[Quality]:
    """Make what validates quality.json, once: that takes longer than to validate one."""
    return TypeAdapter(Quality)


def make_report_error(file: Path, reason: str) -> LakeError:
    """Return the error of a quality.json that others wrote or damaged."""
    again = f"delete it and run `tracklake report --lake {shlex.quote(str(file.parents[1]))}`"
    return LakeError(f"{file}: not the figures of a report of this version ({reason}); {again}")


STAGE = Stage(
    name="report",
    meaning="Write the quality report.",
    scope="lake",
    after=(),  # the report shows what there is
    settings=(_describe_settings,),
    version=10,
    build=build,
    extra_inputs=_find_inputs,
)
