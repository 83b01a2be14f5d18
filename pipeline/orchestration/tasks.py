"""Prefect's tasks, one per stage and batch of recordings; the work that submits them, and commits what they made."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.futures import as_completed
from prefect.logging import get_run_logger

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import (
    DamagedFileError,
    LakeLockedError,
    Manifest,
    Retention,
    Writer,
    find_damaged_files,
    list_ingested,
    open_for_writing,
)
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.lake.session_end import WRITER
from tracklake.pipeline.orchestration.artifacts import name_run
from tracklake.pipeline.orchestration.batches import (
    Call,
    CallResult,
    Engine,
    Threads,
    divide_calls,
    locate_for_workers,
    make_group_call,
    name_batch,
    read_file,
)
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
from tracklake.pipeline.sources import RawFile, SourceError
from tracklake.pipeline.stages.planner import Planner, group_jobs
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.schemas import StructureError
from tracklake.schemas.errors import TracklakeError, describe_error
from tracklake.schemas.extras import require_extras

LOCK_POLL_S = 1.0
"""Time between two looks at a lake that another process writes to, in seconds."""


class BatchFailedError(TracklakeError):
    """The end of a batch in which some calls failed, or which broke off; it carries the outcomes that there are."""

    def __init__(self, outcomes: list[CallResult], broken: Exception | None) -> None:
        failures = [describe_error(made) for _, made in outcomes if isinstance(made, BaseException)]
        said = [str(broken)] if broken is not None else failures
        super().__init__(f"{len(failures)} of {len(outcomes)} failed: {said[0]}")
        self.outcomes = outcomes
        self.broken = broken


@task(task_run_name="{stage} {title}", cache_policy=NO_CACHE, persist_result=False)
def do_batch(stage: str, title: str, do: Callable[[], Iterator[CallResult]]) -> list[CallResult]:
    """Do one stage's work on a batch of recordings, and return its outcomes."""
    del title
    outcomes: list[CallResult] = []
    broken: Exception | None = None
    try:
        for call, made in do():
            outcomes.append((call, made))
            for name in call.titles:
                reporter().advance(stage, name)
    except Exception as error:  # noqa: BLE001  (of the workers as a whole, raised once all outcomes are committed)
        broken = error
    if broken is not None or any(isinstance(made, BaseException) for _, made in outcomes):
        raise BatchFailedError(outcomes, broken)
    return outcomes


def _do_calls(engine: Engine, stage: str, calls: Sequence[Call]) -> Iterator[list[CallResult]]:
    """Do a stage's calls and yield the outcomes of each batch as it ends.

    Raises:
        Exception: the workers broke off; what they had done was yielded before.
    """
    reporter().begin(stage, sum(len(call.titles) for call in calls))
    batches = divide_calls(engine, calls)
    futures = [do_batch.submit(stage, name_batch(batch), partial(engine.run_calls, stage, batch)) for batch in batches]
    broken = None
    for future in as_completed(futures):
        future.wait()
        made: list[CallResult] | BaseException = future.state.result(raise_on_failure=False)
        if isinstance(made, BatchFailedError):
            broken = broken or made.broken
            made = made.outcomes
        if isinstance(made, BaseException):
            raise made
        yield made
    if broken is not None:
        raise broken


def _record_error(title: str, error: BaseException, result: RunResult) -> None:
    """Sort an error: bad input is refused and the others go on; anything else is a failure."""
    if isinstance(error, SourceError | StructureError):
        result.refused.append(str(error))
    else:
        result.failed.append(f"{title}: {describe_error(error)}")


def _build_all(
    writer: Writer, stage: str, jobs: list[Job], request: RunRequest, result: RunResult, engine: Engine
) -> None:
    """Run a stage's jobs and commit each batch as it ends."""
    if not jobs:
        return
    settings = request.get_settings()
    groups = [[job] for job in jobs]
    if stage != INGEST:
        groups = group_jobs(STAGE_BY_NAME[stage], writer.manifest, jobs, engine.slots)
    lake = locate_for_workers(writer.root, settings)
    if find_address(lake) is not None and not jobs[0].tail:  # a job over the whole lake is done where it is committed
        lake, engine = request.lake, Threads(1)
    calls = [make_group_call(lake, writer.manifest, stage, group, settings) for group in groups]
    for outcomes in _do_calls(engine, stage, calls):
        made = [commit for _, commits in outcomes if isinstance(commits, list) for commit in commits]
        writer.commit(*made)
        result.notes += [note for commit in made for note in commit.info.get("notes", [])]
        if made:
            result.built[stage] = result.built.get(stage, 0) + len(made)
        errors = [(", ".join(call.titles), error) for call, error in outcomes if isinstance(error, BaseException)]
        for title, error in errors:
            _record_error(title, error, result)
        if any(isinstance(error, DamagedFileError) for _, error in errors):
            writer.mark_damaged({file.key for file in find_damaged_files(writer.root, writer.manifest)})


def _ingest(writer: Writer, request: RunRequest, prepared: RunPlan, result: RunResult, engine: Engine) -> None:
    """Read what must be read to know its recordings, then make each recording that is not in the lake."""
    discovery, plan = prepared.discovery, prepared.ingest
    assert discovery is not None
    result.refused += discovery.refusals
    result.skipped += discovery.skipped
    unknown = ingest.find_unread_files(discovery, writer.manifest)
    _read_all(writer, {file.sha256: (source.name, file) for source, file in unknown}, request, result, engine)
    if plan is None or plan.manifest != writer.manifest:  # there was no lake, or it has changed since
        plan = plan_ingest(request, discovery, writer.manifest)
    result.refused += plan.conflicts
    name_run(request, [job.title for job in plan.jobs])
    remember_places(writer, request, plan)
    remember_hashes(writer.root, discovery)
    remove_missing(writer, request, plan, result)
    is_elsewhere = find_address(locate_for_workers(writer.root, request.get_settings())) is not None
    needed = {
        file.sha256: (job.inputs["dataset"], file)
        for job in (() if is_elsewhere else plan.jobs)  # workers elsewhere read what they lack
        for file in ingest.list_spilled(job)
        if not ingest.locate_spill(writer.root, file).exists()
    }
    _read_all(writer, needed, request, result, engine)
    _build_all(writer, INGEST, plan.jobs, request, result, engine)


def _read_all(
    writer: Writer, files: dict[str, tuple[str, RawFile]], request: RunRequest, result: RunResult, engine: Engine
) -> None:
    if not files:
        return
    lake = locate_for_workers(writer.root, request.get_settings())
    calls = [Call(read_file, (lake, dataset, file.to_dict()), (file.name,)) for dataset, file in files.values()]
    for outcomes in _do_calls(engine, "read", calls):
        contents = {}
        for call, made in outcomes:
            if isinstance(made, BaseException):
                _record_error(call.titles[0], made, result)
            else:
                contents[call.arguments[2]["sha256"]] = made
        writer.remember_sources(contents)


@contextmanager
def _open_engine(request: RunRequest) -> Iterator[Engine]:
    """Open what does the work: threads (Polars and DuckDB release the interpreter), or Dask workers."""
    settings = request.get_settings()
    if settings.runner == "threads":
        threads = Threads(settings.workers)
        try:
            yield threads
        finally:
            threads.stop()
        return
    require_extras('the setting runner = "dask"', "distributed")
    from tracklake.pipeline.orchestration.dask_workers import open_workers

    is_elsewhere = find_address(locate_for_workers(request.root, settings)) is not None
    places = [*([] if is_elsewhere else [request.root / WRITER]), *([request.origin] if request.source else [])]
    with open_workers(settings, places) as workers:
        yield workers


def do_work(request: RunRequest, plan: RunPlan, lock_timeout_s: float) -> tuple[RunResult, Manifest]:
    """Run every requested stage whose outputs are missing or stale; once again if files turn out to be damaged.

    Returns what was done, and the lake as it is then.
    """
    with _open_engine(request) as engine:
        return _work_until_sound(request, plan, lock_timeout_s, engine)


def _work_until_sound(
    request: RunRequest, plan: RunPlan, lock_timeout_s: float, engine: Engine
) -> tuple[RunResult, Manifest]:
    result = RunResult()
    manifest = _work_once(request, plan, result, lock_timeout_s, engine)
    if (
        result.failed
        and INGEST in request.steps
        and any(not commit.fingerprint for commit in manifest.commits.values())
    ):
        note = f"made again, as files of the lake were damaged: {result.failed[0]}"
        result = RunResult(built=result.built, notes=[note])
        manifest = _work_once(replace(request, rebuild=False), plan, result, lock_timeout_s, engine)
    return result, manifest


def _work_once(
    request: RunRequest, plan: RunPlan, result: RunResult, lock_timeout_s: float, engine: Engine
) -> Manifest:
    before = list_ingested(request.root) if request.rebuild else set()
    if request.rebuild and (plan.discovery is None or not plan.discovery.units):
        raise SourceError(f"{request.source}: nothing in it can be used, so the lake was not rebuilt.")
    settings = request.get_settings()
    with ExitStack() as stack:
        writer = _await_writer(stack, request, lock_timeout_s)
        if INGEST in request.steps:
            _ingest(writer, request, plan, result, engine)
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
            _build_all(writer, stage.name, jobs, request, result, engine)
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
