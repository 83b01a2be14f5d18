"""The planner: jobs, fingerprints and staleness from the declared stages, and the loop that builds and writes a job."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, is_intact, load_recent, verify_files, write_table
from tracklake.pipeline.lake.transfers import fetch_files
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.registry import STAGES
from tracklake.pipeline.stages.stage import (
    INGEST,
    RECONSTRUCTION,
    Job,
    Scope,
    Stage,
    StageError,
    list_results,
    make_commit,
    make_job,
)
from tracklake.schemas import TRACKS
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS


class Planner:
    """What the stages have to do, as a lake stands."""

    def __init__(self, root: Path, manifest: Manifest, settings: Settings, stages: Sequence[Stage] = STAGES) -> None:
        self._root = root
        self._manifest = manifest
        self._settings = settings
        self._stages = {stage.name: stage for stage in stages}
        self._jobs: dict[str, list[Job]] = {}
        self._commits: dict[str, dict[str, Commit]] = {}

    def plan(self, name: str) -> list[Job]:
        """Return the jobs that make a stage complete, done or not.

        Raises:
            StageError: a stage before it has not run, or ran on other inputs or with other settings than now.
        """
        if name not in self._jobs:
            self._jobs[name] = self._plan(self._stages[name])
        return self._jobs[name]

    def find_outstanding(self, name: str) -> tuple[list[Job], set[str]]:
        """Return the jobs of a stage that are not done, and the keys of its commits that it would not make now."""
        jobs = self.plan(name)
        stale = {commit.key for commit in self._manifest.of_stage(name)} - {job.key for job in jobs}
        return find_pending(self._root, self._manifest, jobs), stale

    def require(self, name: str) -> Mapping[str, Commit]:
        """Return the commits of a stage by key, each as the stage would make it now."""
        if name not in self._commits:
            if name == INGEST:
                self._commits[name] = {commit.key: commit for commit in find_recordings(self._manifest)}
            else:
                self._commits[name] = {job.key: self._find_commit(name, job) for job in self.plan(name)}
        return self._commits[name]

    def _find_commit(self, stage: str, job: Job) -> Commit:
        commit = self._manifest.commits.get(job.key)
        if commit is None or commit.fingerprint != job.fingerprint:
            what = f"{stage} of {job.title}" if job.tail else stage
            state = "has not been made" if commit is None else "was made from other inputs or with other settings"
            command = self._stages[stage].command or stage
            raise StageError(f"{what} {state}. Run `tracklake {command}` first, or `tracklake run` for everything.")
        return commit

    def _plan(self, stage: Stage) -> list[Job]:
        inputs = {name: self._select(stage, self.require(name)) for name in stage.list_inputs(self._settings)}
        values = stage.describe_settings(self._settings)
        extra = stage.extra_inputs(self._root, self._manifest, self._settings) if stage.extra_inputs else {}

        def make(key: str, tail: str, before: dict[str, Any], facts: dict[str, Any]) -> Job:
            made_of = {**before, **values, **extra.get(tail, {})}
            return make_job(key, version_of_stage=stage.version, made_of=made_of, inputs=facts)

        if stage.scope == "lake":
            if not all(any(commit.all_files for commit in commits.values()) for commits in inputs.values()):
                return []  # a stage before it made nothing, so there is nothing to work on
            all_prints = {
                name: {key: commit.fingerprint for key, commit in found.items()} for name, found in inputs.items()
            }
            return [make(stage.name, "", all_prints, {})]
        jobs = []
        for recording in find_recordings(self._manifest):
            subsets = _list_subsets(recording, stage.scope)
            if subsets and not (stage.extra_inputs and recording.tail not in extra):
                facts = {"dataset": recording.info["dataset"], "subsets": subsets}
                prints = {name: _find_fingerprint(found, name, recording.tail) for name, found in inputs.items()}
                jobs.append(make(f"{stage.name}/{recording.tail}", recording.tail, prints, facts))
        return jobs

    def _select(self, stage: Stage, commits: Mapping[str, Commit]) -> Mapping[str, Commit]:
        """Return the recordings that a stage over the whole lake builds on: drives alone, where it comes after theirs.

        Without this a drive that is added would make splits and tensors stale, which know nothing of drives.
        """
        of_drives = any(self._stages[name].scope == "drive" for name in stage.after if name in self._stages)
        if stage.scope != "lake":
            return commits
        others = "subsets" if of_drives else "drives"
        return {key: commit for key, commit in commits.items() if not commit.info.get(others)}


def open_reader(manifest: Manifest, settings: Settings) -> LakeReader:
    """Return the reader of a lake for commands that read tracks as the setting `tracks_from` says.

    Raises:
        StageError: it says reconstructed, and some recording's tracks are not, or by other settings.
    """
    if settings.tracks_from == RECONSTRUCTED_TRACKS:
        Planner(settings.lake, manifest, settings).require(RECONSTRUCTION)
    return LakeReader(settings.lake, manifest)


def find_recordings(manifest: Manifest) -> list[Commit]:
    """Return the commits of ingestion that hold subsets or drives; lines that belong to no recording have none."""
    return [commit for commit in manifest.of_stage(INGEST) if commit.info.get("subsets") or commit.info.get("drives")]


def _list_subsets(recording: Commit, scope: Scope) -> list[str]:
    """Return the names of a recording's subsets, or drives, that stages of a scope work on."""
    if scope == "drive":
        return list(recording.info.get("drives", ()))
    return [own["subset"] for own in recording.info["subsets"] if own["freeway"] or scope == "recording"]


def _find_fingerprint(commits: Mapping[str, Commit], stage: str, tail: str) -> str | None:
    """Return the fingerprint of a stage's commit for a recording, or of its commit over the whole lake."""
    return next((commits[key].fingerprint for key in (f"{stage}/{tail}", stage) if key in commits), None)


def find_pending(root: Path, manifest: Manifest, jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs without a commit, with a commit made of other inputs, and with files that are not whole."""
    return [job for job in jobs if not _is_done(root, manifest, job)]


def _is_done(root: Path, manifest: Manifest, job: Job) -> bool:
    commit = manifest.commits.get(job.key)
    return commit is not None and commit.fingerprint == job.fingerprint and is_intact(root, commit.all_files)


def group_jobs(stage: Stage, manifest: Manifest, jobs: Sequence[Job], workers: int) -> list[list[Job]]:
    """Divide the jobs of a stage into groups that are built together, at least one for every worker."""
    if not stage.batch_entries:
        return [[job] for job in jobs]
    rows = {
        commit.tail: sum(file.rows or 0 for file in commit.files.get(TRACKS.name, []))
        for commit in manifest.of_stage(INGEST)
    }
    most = min(stage.batch_entries, sum(rows.get(job.tail, 0) for job in jobs) / workers)
    groups: list[list[Job]] = []
    size = 0
    for job in jobs:
        if not groups or size + rows.get(job.tail, 0) > most:
            groups.append([])
            size = 0
        groups[-1].append(job)
        size += rows.get(job.tail, 0)
    return groups


def build_jobs(
    stage: Stage, root: Path, jobs: Sequence[Job], settings: Settings, manifest: Manifest | None = None
) -> list[Commit]:
    """Build jobs that were grouped, and return their commits in the same order; see `build_job`."""
    if not stage.batch_entries:
        return [build_job(stage, root, job, settings, manifest) for job in jobs]
    started = time.perf_counter()
    manifest = narrow_manifest(manifest or load_recent(root), stage, jobs, settings)
    _prepare_files(root, [file for job in jobs for file in _list_inputs(stage, manifest, job, settings)], jobs)
    results = stage.build([LakeReader(root, manifest, stage.list_inputs(settings), job) for job in jobs], settings)
    assert isinstance(results, list)
    share = (time.perf_counter() - started) * (len(jobs) - 1) / len(jobs)  # each has taken its part of the time
    return [
        make_commit(job, {**result.files}, {**result.info, "notes": [*result.notes]}, started + share)
        for job, result in zip(jobs, results, strict=True)
    ]


def build_job(stage: Stage, root: Path, job: Job, settings: Settings, manifest: Manifest | None = None) -> Commit:
    """Build what a job asks for, validate and write its tables, and return the commit to make.

    Args:
        stage: stage of the job.
        root: folder of the lake.
        job: what is to be built.
        settings: settings of the run.
        manifest: the lake's manifest, or what the job reads of it (`narrow_manifest`); None: it is read.

    Raises:
        DamagedFileError: a file that it reads is not as it was written.
        StageError: the stage refuses what it made.
        schemas.StructureError: a frame breaks its table's rules.
    """
    if stage.batch_entries:
        return build_jobs(stage, root, [job], settings, manifest)[0]
    started = time.perf_counter()
    manifest = narrow_manifest(manifest or load_recent(root), stage, [job], settings)
    _prepare_files(root, _list_inputs(stage, manifest, job, settings), [job])
    files: dict[str, list[LakeFile]] = {}
    info: dict[str, Any] = {}
    notes: list[str] = []
    for reader in _open_readers(stage, root, manifest, job, settings):
        built = stage.build(reader, settings)
        assert not isinstance(built, list)
        for result in list_results(built):
            name = "-".join(filter(None, [job.fingerprint, result.part]))
            for table, frame in result.tables.items():
                written = write_table(root, table, frame, reader.partition, name, where=reader.title)
                files.setdefault(table.name, []).extend(written)
            for folder, own in result.files.items():
                files.setdefault(folder, []).extend(own)
            info |= result.info
            notes += result.notes
    return make_commit(job, files, {**info, "notes": notes}, started)


def _prepare_files(root: Path, files: Iterable[LakeFile], jobs: Sequence[Job]) -> None:
    """Verify the files that jobs read, and receive them first where they are elsewhere.

    A job over the whole lake, which may be larger than this machine's disk, receives each file when it reads it.
    """
    needed = {file.path: file for file in files}.values()
    if all(job.tail for job in jobs):
        fetch_files(root, needed)
    verify_files(root, needed)


def narrow_manifest(manifest: Manifest, stage: Stage, jobs: Sequence[Job], settings: Settings) -> Manifest:
    """Return what jobs may read of a manifest: what was made of the whole lake, and of their recordings.

    It is small, and fit to be sent to a worker: looking at thousands of other commits would take longer than a small
    job. Of what they do not read, a file of each table stays, so that reading it is an error; a stage that comes after
    none reads all tables, and no other file: that of a report alone has thousands. What commits over the whole lake
    were built from, which names every recording, is left out.
    """
    if stage.scope == "lake":
        return manifest
    read = stage.list_inputs(settings)

    def keep(commit: Commit) -> Commit:
        commit = commit if commit.tail else replace(commit, built_from={})
        if commit.stage in read:
            return commit
        tables = {name: [file for file in files if file.rows is not None] for name, files in commit.files.items()}
        return replace(commit, files={name: files[:1] if read else files for name, files in tables.items() if files})

    stages = dict.fromkeys((INGEST, *(each.name for each in STAGES), *read))
    keys = (key for name in stages for key in (name, *(f"{name}/{job.tail}" for job in jobs)))
    commits = {key: keep(manifest.commits[key]) for key in keys if key in manifest.commits}
    return replace(manifest, commits=commits, sources={}, retired=(), ingested_from=())


def _list_inputs(stage: Stage, manifest: Manifest, job: Job, settings: Settings) -> Iterator[LakeFile]:
    """Yield the files that a job may read; a stage that comes after none reads all tables."""
    for commit in manifest.commits.values():
        if commit.tail in ("", job.tail or commit.tail):
            read = commit.stage in stage.list_inputs(settings)
            yield from (file for file in commit.all_files if read or (not stage.after and file.rows is not None))


def _open_readers(stage: Stage, root: Path, manifest: Manifest, job: Job, settings: Settings) -> Iterator[LakeReader]:
    lake = LakeReader(root, manifest, stage.list_inputs(settings), job)
    if stage.scope == "lake":
        yield lake
        return
    for subset in job.inputs["subsets"]:
        yield lake.open_subset(job.inputs["dataset"], subset)
