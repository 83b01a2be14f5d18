"""Ingest: raw files to tracks, vehicles and subsets, every row accounted for."""

import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.ingest.discovery import Discovery
from tracklake.pipeline.ingest.memory_budget import MemoryBudget
from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load_recent, write_table
from tracklake.pipeline.lake.catalog import ADDED
from tracklake.pipeline.lake.files import STAGING
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.sources import SOURCES, RawFile, Source, SourceError
from tracklake.pipeline.sources.accounting import account_rows
from tracklake.pipeline.sources.csv import measure_unpacked
from tracklake.pipeline.sources.source import Canonical, DividedSubset, Drive, Part, Subset
from tracklake.pipeline.stages.stage import Job, make_commit, make_job
from tracklake.schemas import COMPLETENESS, INGEST_LOG, REJECTS, SUBSETS, TRACKS, VEHICLES, Table

VERSION = 3
"""Number to raise when the code makes other tables of the same files."""
SPREADSHEET_ROWS = 1_048_575
"""Most rows that a spreadsheet holds under its header."""
REJECTS_FILE = "rejects.parquet"
"""Name of the file, in a spill folder, of lines that belong to no recording."""
TOTALS_FILE = "totals.parquet"
"""File with the totals of a spilled file, in its folder."""
REASONS_SHOWN = 3
"""Reasons named in the message about a recording of which every row was dropped."""
MEMORY_BUDGET = MemoryBudget(256 << 20)
"""Raw text read at once, in bytes; a recording takes four times as much memory, and highD's longest has 240 MB."""
_PLANNING_FACTS = ("subset", "freeway")
"""Columns of `subsets` that stages are planned with."""
Files = dict[str, list[LakeFile]]
"""Files by table."""
Sources = Mapping[str, Mapping[str, Any]]
"""What the manifest knows of raw files, by sha256."""
SOURCE_BY_NAME: dict[str, Source] = {source.name: source for source in SOURCES}


def find_unread_files(discovery: Discovery, manifest: Manifest) -> list[tuple[Source, RawFile]]:
    """Return files that hold several recordings and whose contents the manifest does not know."""
    return [
        (source, unit.files[0])
        for source, unit in discovery.units
        if source.spill is not None and not _find_contents(source, unit.files[0], manifest)
    ]


def _find_contents(source: Source, file: RawFile, manifest: Manifest) -> dict[str, Any] | None:
    contents = manifest.sources.get(file.sha256)
    if contents is None or contents["version"] != source.version or contents["dataset"] != source.name:
        return None
    # Older lakes know no mappings.
    read_by = (contents.get("columns", ""), contents.get("recording", ""))
    return contents if read_by == (file.columns, file.recording) else None


def locate_spill(root: Path, file: RawFile) -> Path:
    """Return the folder where a file's rows wait, by recording, for the length of a writing session.

    Of a lake on an object store it is one that all workers of a machine share.
    """
    origin = find_origin(root)
    return (root / STAGING if origin is None else origin.staging) / "spilled" / file.sha256


def read_file(root: Path, dataset: str, file: RawFile) -> dict[str, Any]:
    """Spill one file that holds several recordings; returns its contents, as the manifest keeps them by its sha256.

    Raises:
        SourceError: not one of its rows could be read.
    """
    source = SOURCE_BY_NAME[dataset]
    assert source.spill is not None
    folder = locate_spill(root, file)
    aside = folder.with_name(f"{uuid.uuid4().hex}.tmp")  # what a killed worker leaves is not taken for the whole
    aside.mkdir(parents=True)
    try:
        spilled = source.spill(file, aside)
        if not spilled.recordings:
            raise SourceError(_explain_unreadable(file, spilled.rows_read, spilled.rejects))
        spilled.rejects.write_parquet(aside / REJECTS_FILE)
        if spilled.totals is not None:
            spilled.totals.write_parquet(aside / TOTALS_FILE)
        if not folder.exists():
            aside.replace(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return {
        "dataset": dataset,
        "version": source.version,
        "rows_read": spilled.rows_read,
        "recordings": sorted(spilled.recordings),
        "unassigned": spilled.rejects.height if len(spilled.recordings) > 1 else 0,
        "columns": file.columns,
        "recording": file.recording,
        "notes": spilled.notes,
    }


def _explain_unreadable(file: RawFile, rows_read: int, rejects: pl.DataFrame) -> str:
    if rejects.is_empty():
        return f"{file.name}: a header and no rows. Download it again."
    line, reason, text = rejects.row(0)
    return (
        f"{file.name}, line {line}: none of its {rows_read} rows can be read; this one: {reason}. "
        f"Got {text[:100]!r}. Download the file again, or repair it."
    )


def plan(discovery: Discovery, manifest: Manifest) -> list[Job]:
    """Return a job for each recording that the files hold, and for each file with lines of no recording.

    Files whose contents are not known yet (see `find_unread_files`) give no jobs.
    """
    by_recording: dict[tuple[str, str], list[RawFile]] = {}
    jobs = []
    for source, unit in discovery.units:
        if unit.recording is not None:
            by_recording[source.name, unit.recording] = list(unit.files)
            continue
        contents = _find_contents(source, unit.files[0], manifest)
        if contents is None:
            continue
        for recording in contents["recordings"]:
            by_recording.setdefault((source.name, recording), []).extend(unit.files)
        if contents["unassigned"]:
            jobs.append(_make_job(source.name, f"lines-{unit.files[0].sha256[:12]}", unit.files, recording=None))
    # Several files of a recording may have the same one beside them.
    jobs += [
        _make_job(name, recording, list(dict.fromkeys(files)), recording)
        for (name, recording), files in sorted(by_recording.items())
    ]
    return jobs


def find_replaced(jobs: Sequence[Job], manifest: Manifest) -> dict[str, str]:
    """Return messages, by key, about recordings that would lose the rows of files that these jobs do not hold.

    A file of the same name with other content is a new version of that file, and replaces it.
    """
    messages = {}
    for job in jobs:
        commit = manifest.commits.get(job.key)
        if commit is None:
            continue
        if others := _find_other_drive(job, commit):
            messages[job.key] = (
                f"recording {job.title}: another drive of this name is in the lake, from {others[0]['path']}, which is "
                f"still there, and now came {job.built_from['sources'][0]['path']}. Give both at once (a folder above "
                "them), name this one with --recording NAME, or let it replace the other with --replace."
            )
        elif lost := find_lost(job, commit):
            names = (source["file"] for source in job.built_from["sources"])
            messages[job.key] = (
                f"recording {job.title}: it is in the lake already, from {', '.join(s['file'] for s in lost)}, and now "
                f"came from {', '.join(sorted(names))}. Give all its files at once (a folder), or let these replace "
                "those with --replace."
            )
    return messages


def find_lost(job: Job, commit: Commit) -> list[dict[str, Any]]:
    """Return the sources of a recording's commit that a job for it does not hold, neither by name nor by content."""
    names, hashes = ({source[part] for source in job.built_from["sources"]} for part in ("file", "sha256"))
    sources = commit.built_from["sources"]
    others = _find_other_drive(job, commit)
    return others or [s for s in sources if s["file"] not in names and s["sha256"] not in hashes]


def _find_other_drive(job: Job, commit: Commit) -> list[dict[str, Any]]:
    """Return the sources of a drive's commit where they are all elsewhere than those of a job for the same name.

    Logs of several drives often have the same names, so that these do not tell a new version from another drive.
    """
    now, before = job.built_from["sources"], commit.built_from["sources"]
    shared = any({s[part] for s in now} & {s[part] for s in before} for part in ("path", "sha256"))
    if not commit.info.get("drives") or shared:
        return []
    return [source for source in before if os.path.lexists(source["path"])]


def _make_job(dataset: str, title: str, files: Sequence[RawFile], recording: str | None) -> Job:
    sources = [
        {"file": file.name, "sha256": file.sha256, "dialect": file.dialect}
        | ({"columns": file.columns} if file.columns else {})
        for file in files
    ]
    job = make_job(
        f"ingest/{dataset}/{title}",
        version_of_stage=VERSION,
        made_of={"sources": sources, "source_version": SOURCE_BY_NAME[dataset].version},
        inputs={"dataset": dataset, "recording": recording, "files": [file.to_dict() for file in files]},
    )
    # Where they stand is remembered, and is no part of the fingerprint: a moved folder has the same content.
    placed = [{**source, "path": str(file.path)} for source, file in zip(sources, files, strict=True)]
    return replace(job, built_from={**job.built_from, "sources": placed})


def list_files(job: Job) -> list[RawFile]:
    """Return the raw files of an ingest job."""
    return [RawFile.from_dict(file) for file in job.inputs["files"]]


def list_spilled(job: Job) -> list[RawFile]:
    """Return the raw files of an ingest job that must have been read into the staging folder first."""
    source = SOURCE_BY_NAME[job.inputs["dataset"]]
    return [] if source.spill is None else [file for file in list_files(job) if file.dialect not in source.beside]


def build(root: Path, job: Job, slice_entries: int = 2_000_000, manifest: Manifest | None = None) -> Commit:
    """Make one recording's tables and account for the rows of its files.

    Args:
        root: folder of the lake.
        job: the recording.
        slice_entries: the setting: entries of a subset that are held at once, where its source can do with that.
        manifest: the lake's manifest, or what it knows of the job's files; None: it is read.

    Raises:
        SourceError, schemas.StructureError: the recording cannot be used.
    """
    started = time.perf_counter()
    recording, files, spilled = job.inputs["recording"], list_files(job), list_spilled(job)
    known = (manifest or load_recent(root)).sources
    for file in spilled:
        if not locate_spill(root, file).exists():  # a worker on another machine has read it
            read_file(root, job.inputs["dataset"], file)
    if recording is None:
        tables, info = _build_unassigned(root, job, files[0])
    elif spilled:
        parts = [_open_spilled(root, file, recording) if file in spilled else Part(file) for file in files]
        parts = [replace(part, slice_entries=slice_entries) for part in parts]
        tables, info = _build_recording(root, job, parts, known)
    else:
        with MEMORY_BUDGET.reserve(sum(map(measure_unpacked, files))):
            tables, info = _build_recording(root, job, [Part(file) for file in files], known)
    facts = {"dataset": job.inputs["dataset"], "recording": recording, ADDED: sorted(VEHICLES.added)}
    return make_commit(job, tables, {**facts, **info}, started)


def _build_recording(root: Path, job: Job, parts: Sequence[Part], known: Sources) -> tuple[Files, dict[str, Any]]:
    dataset, recording = job.inputs["dataset"], job.inputs["recording"]
    source = SOURCE_BY_NAME[dataset]
    canonical = source.to_canonical(parts, recording)
    if not canonical.subsets and not canonical.drives:
        raise SourceError(_explain_emptiness(recording, canonical, source.lacking))
    tables = _write_tables(root, job, canonical)
    of_batches = (note for drive in canonical.drives for note in drive.describe_batches())
    suspicions = _suspect_truncation(list_files(job), canonical, known)
    info = {
        "notes": [*_recall_notes(job, known), *canonical.notes, *of_batches, *suspicions],
        "subsets": [subset.facts.select(*_PLANNING_FACTS).row(0, named=True) for subset in canonical.subsets],
        "drives": [drive.name for drive in canonical.drives],
        "row_order": canonical.row_order,
        "rows_read": int(canonical.log["rows_read"].sum()),
        "rows_dropped": int(canonical.log["rows_dropped"].sum()),
    }
    return tables, info


def _explain_emptiness(recording: str, canonical: Canonical, lacking: str) -> str:
    """Return why no row of a recording could be used: the commonest reasons, and a line of each."""
    reasons = (
        canonical.rejects.sort("file", "line")
        .group_by("reason")
        .agg(pl.len().alias("rows"), pl.col("file", "line", "text").first())
        .sort("rows", "reason", descending=[True, False])
    )
    shown = [
        f"{rows:,} {'row' if rows == 1 else 'rows'} ({reason}; first {file}, line {line}: {text[:60]!r})"
        for reason, rows, file, line, text in reasons.head(REASONS_SHOWN).rows()
    ]
    more = [f"{reasons['rows'][REASONS_SHOWN:].sum():,} for other reasons"] if len(reasons) > REASONS_SHOWN else []
    if not shown:
        read = "; ".join(canonical.notes or canonical.log["file"])
        return (
            f"recording {recording}: {lacking}. Expected rows that can be used, got none ({read}). Give all files of "
            "the recording."
        )
    return (
        f"recording {recording}: {lacking}. Expected rows that can be used, got dropped ones only: "
        f"{', '.join([*shown, *more])}. Restore the original files, or repair these lines."
    )


def _suspect_truncation(files: Sequence[RawFile], canonical: Canonical, known: Sources) -> list[str]:
    """Return notes about files of exactly as many rows as a spreadsheet can hold, whose end may be missing."""
    rows = dict(canonical.log.select("sha256", "rows_read").iter_rows())
    rows |= {file.sha256: known[file.sha256]["rows_read"] for file in files if file.sha256 in known}
    return [
        f"{file.name}: exactly {SPREADSHEET_ROWS:,} rows, a spreadsheet's limit: probably TRUNCATED. Compare with the "
        "publisher's count and download the file again."
        for file in files
        if rows.get(file.sha256) == SPREADSHEET_ROWS
    ]


def _recall_notes(job: Job, known: Sources) -> list[str]:
    """Return the notes about how files were read, with the first recording of each file."""
    contents = [known[file.sha256] for file in list_files(job) if file.sha256 in known]
    named = (found for found in contents if found["recordings"][:1] == [job.inputs["recording"]])
    return [note for found in named for note in found.get("notes", ())]


def _open_spilled(root: Path, file: RawFile, recording: str) -> Part:
    folder = locate_spill(root, file)
    alone = sum(1 for item in folder.iterdir() if item.is_dir()) == 1
    rejects = pl.read_parquet(folder / REJECTS_FILE, glob=False) if alone else None
    totals = pl.read_parquet(folder / TOTALS_FILE, glob=False) if (folder / TOTALS_FILE).exists() else None
    rows = pl.scan_ipc(sorted((folder / recording).rglob("*.arrow")), glob=False)
    return Part(file, rows, rejects, totals, folder / recording)


def _write_tables(root: Path, job: Job, canonical: Canonical) -> Files:
    dataset, recording = job.inputs["dataset"], job.inputs["recording"]
    files: Files = {}
    for own in (*canonical.subsets, *canonical.drives):
        values = {"dataset": dataset, "subset": own.name}
        for part, table, rows in _list_tables(own):
            name = "-".join(filter(None, [job.fingerprint, part]))
            written = write_table(root, table, rows, values, name, where=f"recording {recording}")
            files.setdefault(table.name, []).extend(written)
    for table, frame in (
        (INGEST_LOG, canonical.log),
        (REJECTS, canonical.rejects),
        (COMPLETENESS, canonical.completeness),
    ):
        files[table.name] = write_table(
            root, table, frame, {"dataset": dataset}, job.fingerprint, where=f"recording {recording}"
        )
    return files


def _list_tables(
    own: Subset | DividedSubset | Drive,
) -> Iterator[tuple[str, Table, pl.DataFrame | Iterable[pl.DataFrame]]]:
    """Yield what is to be written of a subset or drive: name of the slice (empty without one), table and rows."""
    if isinstance(own, Drive):
        yield from (("", table, rows) for table, rows in own.tables.items())
        return
    if isinstance(own, DividedSubset):
        yield from ((name, TRACKS, tracks) for name, tracks in own.slices)
    else:
        yield "", TRACKS, own.tracks
    yield "", VEHICLES, own.vehicles
    yield "", SUBSETS, own.facts


def _build_unassigned(root: Path, job: Job, file: RawFile) -> tuple[Files, dict[str, Any]]:
    dataset = job.inputs["dataset"]
    lines = pl.read_parquet(locate_spill(root, file) / REJECTS_FILE, glob=False)
    log, rejects = account_rows(dataset, None, [Part(file, rejects=lines)], [0], [])
    values = {"dataset": dataset}
    files = {
        table.name: write_table(root, table, frame, values, job.fingerprint, where=file.name)
        for table, frame in ((INGEST_LOG, log), (REJECTS, rejects))
    }
    info = {
        "notes": [f"{file.name}: {lines.height} lines belong to no recording and stand in rejects"],
        "subsets": [],
        "rows_read": lines.height,
        "rows_dropped": lines.height,
    }
    return files, info
