"""Prefect's tasks, one per (stage, recording), records in and records out; and the work that submits them."""

import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict, replace
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture, as_completed
from prefect.logging import get_run_logger

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import (
    Commit,
    DamagedFileError,
    LakeLockedError,
    Manifest,
    Retention,
    Writer,
    find_damaged_files,
    list_ingested,
    open_for_writing,
)
from tracklake.pipeline.orchestration import batches
from tracklake.pipeline.orchestration.artifacts import name_run
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.orchestration.run_plan import (
    RunPlan,
    RunRequest,
    RunResult,
    explain_left_out,
    explain_not_rebuilt,
    explain_not_reconstructed,
    plan_ingest,
    remember_hashes,
    remember_places,
    remove_missing,
    remove_outdated,
)
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import RawFile, SourceError
from tracklake.pipeline.stages.planner import Planner, group_jobs
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.schemas import StructureError
from tracklake.schemas.errors import describe_error

LOCK_POLL_S = 1.0
"""Time between two looks at a lake that another process writes to, in seconds."""
Results = Iterable[tuple[str, Any]]
"""Titles of tasks with their results or errors."""


TASK: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "persist_result": False,
}
"""Options of every task: nothing is cached."""


@task(task_run_name="read {title}", **TASK)
def read_file(title: str, lake: str, dataset: str, file: dict[str, Any]) -> dict[str, Any]:
    """Read one file that holds several recordings into the staging folder."""
    del title
    return batches.read_file(lake, dataset, file)


@task(task_run_name="{stage} {title}", **TASK)
def build(stage: str, title: str, lake: str, jobs: list[dict[str, Any]], settings: dict[str, Any]) -> list[Commit]:
    """Do one stage's work on one recording, or some: read, transform, validate, write; returns the commits to make."""
    del title
    return batches.build_group(lake, stage, [Job(**job) for job in jobs], Settings(**settings))


def _await_results(futures: dict[PrefectFuture[Any], str]) -> Results:
    """Yield (title, result or error) of each future as it ends."""
    for future in as_completed(list(futures)):
        future.wait()
        yield futures[future], future.state.result(raise_on_failure=False)


def _record_error(title: str, error: BaseException, result: RunResult) -> None:
    """Sort an error: bad input is refused and the others go on; anything else is a failure."""
    if isinstance(error, SourceError | StructureError):
        result.refused.append(str(error))
    else:
        result.failed.append(f"{title}: {describe_error(error)}")


def _build_all(writer: Writer, stage: str, jobs: list[Job], request: RunRequest, result: RunResult) -> None:
    """Run a stage's jobs and commit each as it ends."""
    if not jobs:
        return
    show = reporter()
    show.begin(stage, len(jobs))
    settings = request.get_settings()
    if stage == INGEST:
        groups = [[job] for job in jobs]
    else:
        groups = group_jobs(STAGE_BY_NAME[stage], writer.manifest, jobs, settings.workers)
    titles = [", ".join(job.title for job in group) for group in groups]
    values = settings.model_dump(mode="json")
    futures = {
        build.submit(stage, title, request.lake, [asdict(job) for job in group], values): title
        for title, group in zip(titles, groups, strict=True)
    }
    for title, made in _await_results(futures):
        if isinstance(made, list):
            for commit in made:
                writer.commit(commit)
                result.notes += commit.info.get("notes", [])
            result.built[stage] = result.built.get(stage, 0) + len(made)
        else:
            _record_error(title, made, result)
            if isinstance(made, DamagedFileError):
                writer.mark_damaged({file.key for file in find_damaged_files(writer.root, writer.manifest)})
        for name in title.split(", "):
            show.advance(stage, name)


def _ingest(writer: Writer, request: RunRequest, prepared: RunPlan, result: RunResult) -> None:
    """Read what must be read to know its recordings, then make each recording that is not in the lake."""
    discovery, plan = prepared.discovery, prepared.ingest
    assert discovery is not None
    result.refused += discovery.refusals
    result.skipped += discovery.skipped
    unknown = ingest.find_unread_files(discovery, writer.manifest)
    _read_all(writer, {file.sha256: (source.name, file) for source, file in unknown}, request, result)
    if plan is None or plan.manifest != writer.manifest:  # there was no lake, or it has changed since
        plan = plan_ingest(request, discovery, writer.manifest)
    result.refused += plan.conflicts
    name_run(request, [job.title for job in plan.jobs])
    remember_places(writer, request, plan)
    remember_hashes(writer.root, discovery)
    remove_missing(writer, request, plan, result)
    needed = {
        file.sha256: (job.inputs["dataset"], file)
        for job in plan.jobs
        for file in ingest.list_spilled(job)
        if not ingest.locate_spill(writer.root, file).exists()
    }
    _read_all(writer, needed, request, result)
    _build_all(writer, INGEST, plan.jobs, request, result)


def _read_all(writer: Writer, files: dict[str, tuple[str, RawFile]], request: RunRequest, result: RunResult) -> None:
    if not files:
        return
    show = reporter()
    show.begin("read", len(files))
    futures = {
        read_file.submit(file.name, request.lake, dataset, file.to_dict()): sha256
        for sha256, (dataset, file) in files.items()
    }
    contents = {}
    for sha256, record in _await_results(futures):
        if isinstance(record, dict):
            contents[sha256] = record
        else:
            _record_error(files[sha256][1].name, record, result)
        show.advance("read", files[sha256][1].name)
    writer.remember_sources(contents)


def do_work(request: RunRequest, plan: RunPlan, lock_timeout_s: float) -> tuple[RunResult, Manifest]:
    """Run every requested stage whose outputs are missing or stale; once again if files turn out to be damaged.

    Returns what was done, and the lake as it is then.
    """
    result = RunResult()
    manifest = _work_once(request, plan, result, lock_timeout_s)
    if (
        result.failed
        and INGEST in request.steps
        and any(not commit.fingerprint for commit in manifest.commits.values())
    ):
        note = f"made again, as files of the lake were damaged: {result.failed[0]}"
        result = RunResult(built=result.built, notes=[note])
        manifest = _work_once(replace(request, rebuild=False), plan, result, lock_timeout_s)
    return result, manifest


def _work_once(request: RunRequest, plan: RunPlan, result: RunResult, lock_timeout_s: float) -> Manifest:
    before = list_ingested(request.root) if request.rebuild else set()
    if request.rebuild and (plan.discovery is None or not plan.discovery.units):
        raise SourceError(f"{request.source}: nothing in it can be used, so the lake was not rebuilt.")
    settings = request.get_settings()
    with ExitStack() as stack:
        writer = _await_writer(stack, request, lock_timeout_s)
        if INGEST in request.steps:
            _ingest(writer, request, plan, result)
        else:
            name_run(request, [commit.tail.rpartition("/")[2] for commit in writer.manifest.of_stage(INGEST)])
        remove_outdated(writer, request, settings)
        for stage in request.list_stages():
            if result.failed and stage.after:
                continue  # it builds on what failed; the report, which comes after no stage, shows what there is
            if INGEST in request.steps and not writer.manifest.of_stage(INGEST):
                continue  # everything was refused
            jobs, stale = Planner(writer.root, writer.manifest, settings).find_outstanding(stage.name)
            writer.remove(stale)
            _build_all(writer, stage.name, jobs, request, result)
        if set(request.steps) & {"reconstruct", "repair", "traffic", "samples", "split", "tensors"}:
            result.notes += explain_left_out(writer.manifest)
        result.notes += explain_not_reconstructed(request)
        result.notes += explain_not_rebuilt(before, writer.manifest)
        return writer.manifest


def _await_writer(stack: ExitStack, request: RunRequest, timeout_s: float) -> Writer:
    """Open the lake for writing, as soon as no other process writes to it."""
    settings = request.get_settings()
    retention = Retention(settings.kept_generations, settings.kept_hours)
    limit = time.monotonic() + timeout_s
    is_reported = False
    while True:
        try:
            return stack.enter_context(open_for_writing(request.root, rebuild=request.rebuild, retention=retention))
        except LakeLockedError as busy:
            if time.monotonic() >= limit:
                raise
            if not is_reported:
                get_run_logger().info("%s This run waits up to %g s for it.", busy, timeout_s)
                is_reported = True
            time.sleep(LOCK_POLL_S)
