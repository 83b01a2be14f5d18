"""Pages: one of the report per subset, written again only where what it shows has changed."""

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, is_intact, open_recordings, scan
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.quality_reports import groups
from tracklake.quality_reports.pages.page_names import FOLDER, name_pages
from tracklake.schemas import SPLITS
from tracklake.schemas.files import write_file


def _find_inputs(root: Path, manifest: Manifest, settings: Settings) -> dict[str, dict[str, Any]]:
    """Return by recording all that was made of it, its parts of the splits, and the names of its pages.

    Of many subsets, only those have pages that the setting `pages_of` names, or that have had one.
    """
    recordings = manifest.of_stage(INGEST)
    keys = {
        each.tail: [(each.info["dataset"], subset["subset"]) for subset in each.info["subsets"]] for each in recordings
    }
    names = name_pages([{"dataset": dataset, "subset": subset} for own in keys.values() for dataset, subset in own])
    if len(names) > groups.MANY_SUBSETS:
        drawn = {commit.tail for commit in manifest.of_stage("pages")}
        keys = {t: own for t, own in keys.items() if t in drawn or {name for _, name in own} & {*settings.pages_of}}
    parts = _find_parts(root, manifest)
    made: dict[str, dict[str, str]] = {tail: {} for tail in keys}
    for commit in manifest.commits.values():
        if commit.tail in made and commit.stage != "pages":
            made[commit.tail][commit.key] = commit.fingerprint
    return {
        tail: {
            "commits": made[tail],
            "parts": [parts.get(key, []) for key in own],
            "pages": {subset: names[dataset, subset] for dataset, subset in own},
        }
        for tail, own in keys.items()
    }


def _find_parts(root: Path, manifest: Manifest) -> dict[tuple[str, str], list[Any]]:
    """Return the rows of `splits` by (dataset, subset); none where its files are not whole and are made again first."""
    if not is_intact(root, manifest.live(SPLITS.name)):
        return {}
    rows = scan(root, manifest, SPLITS).sort(SPLITS.key).collect()
    return {
        (str(dataset), str(subset)): [list(row) for row in of_subset.drop("dataset", "subset").iter_rows()]
        for (dataset, subset), of_subset in rows.group_by("dataset", "subset")
    }


def build(readers: Sequence[LakeReader], settings: Settings) -> list[StageResult]:
    """Query what the lake holds of some recordings and write their subsets' pages into reports/subsets/."""
    from tracklake.quality_reports.pages.subsets import render_pages

    root, names = readers[0].root, [_name_pages(reader) for reader in readers]
    with open_recordings(root, readers[0].manifest, [reader.job.tail for reader in readers]) as connection:
        provenance = {**describe_origin(root), "settings": {"tracks_from": settings.tracks_from}}
        rendered = render_pages(connection, provenance, names=dict(ChainMap(*names)))
        files = {name: write_report_file(root, f"{FOLDER}/{name}", content) for name, content in rendered}
    return [
        StageResult(
            files={REPORTS: [files[name] for name in own.values()]},
            info={"pages": [(*key, name) for key, name in own.items()]},
        )
        for own in names
    ]


def _name_pages(reader: LakeReader) -> dict[tuple[str, str], str]:
    """Return the names of a recording's pages by (dataset, subset)."""
    dataset, pages = reader.job.inputs["dataset"], reader.job.built_from["pages"]
    return {(dataset, subset): name for subset, name in pages.items()}


STAGE = Stage(
    name="pages",
    meaning="Draw the report's page of each subset.",
    scope="recording",
    after=(),  # a page shows what there is
    version=9,
    build=build,
    batch_entries=500_000,
    extra_inputs=_find_inputs,
)


def describe_origin(root: Path) -> dict[str, str]:
    """Return which lake a report is of, and when and by which version it is made."""
    return {
        "lake": root.resolve().name,
        "created": datetime.now(tz=UTC).isoformat(timespec="seconds"),
        "tracklake": version("tracklake"),
    }


def find_pages(root: Path, commits: Iterable[Commit]) -> Mapping[tuple[str, str], str]:
    """Return the file names of the pages that exist, by (dataset, subset), of this stage's commits."""
    return {
        (dataset, subset): name
        for commit in commits
        if is_intact(root, commit.files[REPORTS])
        for dataset, subset, name in commit.info["pages"]
    }


def write_report_file(root: Path, name: str, content: str) -> LakeFile:
    """Write one file of the report into its place."""
    target = root / REPORTS / name
    target.parent.mkdir(parents=True, exist_ok=True)
    write_file(target, content.encode("utf-8", "backslashreplace"))
    return LakeFile(f"{REPORTS}/{name}", None, target.stat().st_size)
