"""Prefect flows: ingest, quality, and the whole run; one task per (stage, recording), records in and records out.

The only importer of Prefect. It runs tasks, retries them, shows runs and artifacts, and serves deployments. It caches
nothing: what is done already is decided by the lake's fingerprints (`pipeline.orchestration.run_plan`), so that an idle
rerun never comes here.
"""

import logging
import os
import socket
import threading
import time
from collections.abc import Iterable
from contextvars import ContextVar
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tracklake.schemas.errors import FileAccessError, MissingExtraError, TracklakeError, describe_error

# Prefect reads these on import. Its telemetry shares the embedded server's database and locks it.
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")

import httpx
from prefect import flow, task
from prefect.artifacts import create_link_artifact, create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.futures import PrefectFuture, as_completed
from prefect.logging.handlers import PrefectConsoleHandler
from prefect.settings import PREFECT_API_URL, PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import Commit, DamagedFileError, Writer, list_ingested, open_for_writing
from tracklake.pipeline.orchestration.artifacts import summarise_report
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.orchestration.run_plan import (
    ALL_STEPS,
    QUALITY_STEPS,
    RunPlan,
    RunRequest,
    RunResult,
    explain_left_out,
    explain_not_rebuilt,
    plan_ingest,
    remember_hashes,
    remember_places,
    remove_missing,
    survey_source,
)
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import RawFile, SourceError
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.schemas import StructureError

REPORT = "report"
"""Name of the stage whose figures a run shows as artifacts."""
OUR_FAULTS = (400, 422)
"""HTTP statuses with which Prefect's API answers a request that is wrong in itself."""
SERVER_START_S = 120.0
"""Longest wait for the embedded server, in seconds."""
FEW_THREADS: Any = ThreadPoolTaskRunner(max_workers=min(os.cpu_count() or 1, 4))
"""Task runner of served flows: as many recordings in memory at once as the settings' default."""

_PLAN: ContextVar[RunPlan | None] = ContextVar("plan", default=None)
"""What `execute` hands to its flow beside the parameters, which Prefect stores, limits in size and shows."""

Results = Iterable[tuple[str, Any]]
"""Titles of tasks with their results or errors."""


def _is_io_error(_task: object, _run: object, state: State[Any]) -> bool:
    """Retry what a busy disk or a network share may cause; nothing else becomes right by a retry."""
    return isinstance(state.result(raise_on_failure=False), OSError | FileAccessError)


TASK: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "persist_result": False,
    "retries": 2,
    "retry_delay_seconds": 1,
    "retry_condition_fn": _is_io_error,
}
"""Options of every task: nothing is cached, and input and output are tried three times."""


@task(task_run_name="read {title}", **TASK)
def read_file(title: str, lake: str, dataset: str, file: dict[str, Any]) -> dict[str, Any]:
    """Read one file that holds several recordings into the staging folder."""
    del title
    return ingest.read_file(Path(lake), dataset, RawFile.from_dict(file))


@task(task_run_name="{stage} {title}", **TASK)
def build(stage: str, title: str, lake: str, job: dict[str, Any], settings: dict[str, Any]) -> Commit:
    """Do one stage's work on one recording: read, transform, validate, write; returns the commit to make."""
    del title
    if stage == INGEST:
        return ingest.build(Path(lake), Job(**job))
    return build_job(STAGE_BY_NAME[stage], Path(lake), Job(**job), Settings(**settings))


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
    settings = request.get_settings().model_dump(mode="json")
    futures = {build.submit(stage, job.title, request.lake, asdict(job), settings): job.title for job in jobs}
    for title, made in _await_results(futures):
        if isinstance(made, Commit):
            writer.commit(made)
            result.built[stage] = result.built.get(stage, 0) + 1
            result.notes += made.info.get("notes", [])
        else:
            _record_error(title, made, result)
            if isinstance(made, DamagedFileError):
                writer.mark_damaged()
        show.advance(stage, title)


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
    remember_places(writer, request, plan)
    remember_hashes(writer.root, discovery)
    remove_missing(writer, request, plan, result)
    needed = {
        file.sha256: (job.inputs["dataset"], file)
        for job in plan.jobs
        if ingest.needs_spill(job)
        for file in ingest.list_files(job)
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


def _work(request: RunRequest, *, again: bool = False) -> dict[str, Any]:
    """Run every requested stage whose outputs are missing or stale; once again if files turn out to be damaged."""
    result = RunResult()
    plan = _PLAN.get() or RunPlan(survey_source(request) if INGEST in request.steps else None)
    before = list_ingested(request.root) if request.rebuild else set()
    if request.rebuild and (plan.discovery is None or not plan.discovery.units):
        raise SourceError(f"{request.source}: nothing in it can be used, so the lake was not rebuilt.")
    settings = request.get_settings()
    with open_for_writing(request.root, rebuild=request.rebuild) as writer:
        if INGEST in request.steps:
            _ingest(writer, request, plan, result)
        for stage in request.list_stages():
            if result.failed and stage.after:
                continue  # it builds on what failed; the report, which comes after no stage, shows what there is
            if INGEST in request.steps and not writer.manifest.of_stage(INGEST):
                continue  # everything was refused
            jobs, stale = Planner(writer.root, writer.manifest, settings).find_outstanding(stage.name)
            writer.remove(stale)
            _build_all(writer, stage.name, jobs, request, result)
        if set(request.steps) & {"repair", "samples", "split", "tensors"}:
            result.notes += explain_left_out(writer.manifest)
        result.notes += explain_not_rebuilt(before, writer.manifest)
        made = writer.manifest
    if (
        result.failed
        and INGEST in request.steps
        and not again
        and any(not commit.fingerprint for commit in made.commits.values())
    ):
        repeated = _work(replace(request, rebuild=False), again=True)
        built = {stage: result.built.get(stage, 0) + count for stage, count in repeated["built"].items()}
        notes = [f"made again, as files of the lake were damaged: {result.failed[0]}", *repeated["notes"]]
        return {**repeated, "built": {**result.built, **built}, "notes": notes}
    if REPORT in request.steps and not Planner(request.root, made, settings).find_outstanding(REPORT)[0]:
        result.notes += _publish(request.root)
    return asdict(result)


def _publish(root: Path) -> list[str]:
    """Attach the report's tables and its address to the flow run; returns a note where Prefect's API fails.

    The lake is whole without them, so that a server that is busy, missing or forbids it fails no run. One that
    understands the request and calls it wrong has found a fault of ours, which is raised.
    """
    tables, link = summarise_report(root)
    try:
        for table in tables:
            create_table_artifact(table=table.rows, key=table.key, description=table.description)
        create_link_artifact(link=link.address, link_text=link.text, key=link.key, description=link.description)
    except (httpx.TransportError, httpx.HTTPStatusError) as failed:
        if isinstance(failed, httpx.HTTPStatusError) and failed.response.status_code in OUR_FAULTS:
            raise
        reason = str(failed).splitlines()[0] if str(failed) else type(failed).__name__
        return [f"Prefect did not take the report's tables as artifacts ({reason}); the lake and its report are whole"]
    return []


@flow(name="tracklake-run", validate_parameters=False, task_runner=FEW_THREADS)
def run(
    lake: str,
    source: str,
    dataset: str | None = None,
    settings: dict[str, Any] | None = None,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
) -> dict[str, Any]:
    """Run the whole pipeline: raw files to tables, findings, repair, samples, split, tensors, score and report."""
    return _work(RunRequest(lake, ALL_STEPS, source, dataset, settings or {}, replace, prune, rebuild))


@flow(name="tracklake-ingest", validate_parameters=False, task_runner=FEW_THREADS)
def ingest_files(
    lake: str,
    source: str,
    dataset: str | None = None,
    settings: dict[str, Any] | None = None,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
) -> dict[str, Any]:
    """Ingest raw files: to tracks, vehicles and subsets."""
    return _work(RunRequest(lake, (INGEST,), source, dataset, settings or {}, replace, prune, rebuild))


@flow(name="tracklake-quality", validate_parameters=False, task_runner=FEW_THREADS)
def quality(lake: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Make findings, late starts and the report of what is in the lake."""
    return _work(RunRequest(lake, QUALITY_STEPS, settings=settings or {}))


@flow(name="tracklake-stage", flow_run_name="tracklake-{stage}", validate_parameters=False, task_runner=FEW_THREADS)
def run_stage(stage: str, lake: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run one stage over what is in the lake, or several (`repair+assess`)."""
    return _work(RunRequest(lake, tuple(stage.split("+")), settings=settings or {}))


def execute(request: RunRequest, plan: RunPlan | None = None) -> RunResult:
    """Run a request as the flow that fits it, with none of Prefect's lines on the terminal.

    Args:
        request: what the user asked for.
        plan: what was found out for it already; None: the flow finds it out.
    """
    parameters: dict[str, Any] = {"lake": request.lake, "settings": request.settings}
    chosen: Any = run_stage
    if INGEST in request.steps:
        chosen = run if tuple(request.steps) == ALL_STEPS else ingest_files
        parameters |= {"source": request.source, "dataset": request.dataset}
        parameters |= {"replace": request.replace, "prune": request.prune, "rebuild": request.rebuild}
    else:
        parameters["stage"] = "+".join(request.steps)
    changed: dict[Any, Any] = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}  # costs a second, and nothing uses it
    if PREFECT_API_URL.value() is None:
        changed[PREFECT_API_URL] = _embed_server()
    with temporary_settings(changed):
        _mute_console()  # after all that sets logging up
        token = _PLAN.set(plan)
        try:
            return RunResult(**chosen.with_options(task_runner=_choose_runner(request.get_settings()))(**parameters))
        finally:
            _PLAN.reset(token)


def _choose_runner(settings: Settings) -> TaskRunner[Any]:
    """Return threads (Polars and DuckDB release the interpreter) or Dask workers (which need a shared disk)."""
    if settings.runner == "threads":
        return ThreadPoolTaskRunner(max_workers=settings.workers)
    try:
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError:
        raise MissingExtraError(
            'the setting runner = "dask" needs Dask: `pip install "tracklake[distributed]"`'
        ) from None
    if settings.dask_address is not None:
        return DaskTaskRunner(address=settings.dask_address)
    cluster = {"n_workers": settings.workers, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    return DaskTaskRunner(cluster_kwargs=cluster)


def _embed_server() -> str:
    """Serve Prefect's API from a thread of this process and return its address.

    The server that Prefect would start by itself is a process of its own, which outlives one that is killed. This one
    ends with us, whatever happens, and spares a second interpreter's start. It is never stopped before: Prefect sends
    its last logs and events to it while the interpreter exits.
    """
    import uvicorn
    from prefect.server.api.server import create_app

    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(create_app(ephemeral=True), log_config=None, lifespan="on"))
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, name="prefect-server", daemon=True)
    thread.start()
    limit = time.monotonic() + SERVER_START_S
    while not server.started:
        if not thread.is_alive() or time.monotonic() > limit:
            raise TracklakeError(
                "Prefect's embedded server did not start. Look at PREFECT_HOME (its database may be of another "
                "version: `prefect server database reset`), or set PREFECT_API_URL to a running server."
            )
        time.sleep(0.01)
    return f"http://127.0.0.1:{listener.getsockname()[1]}/api"


def _mute_console() -> None:
    """Keep Prefect's lines off the terminal; its server still gets them, and the user gets ours."""
    for name in (None, "prefect", *logging.root.manager.loggerDict):
        logger = logging.getLogger(name)
        for handler in list(logger.handlers):
            if isinstance(handler, PrefectConsoleHandler):
                logger.removeHandler(handler)


def serve_deployments() -> None:
    """Serve the flows as deployments until interrupted; runs are started from Prefect's UI, CLI or schedules."""
    from prefect import serve

    flows: dict[str, Any] = {"run": run, "ingest": ingest_files, "quality": quality}
    serve(*(served.to_deployment(name, description=served.__doc__) for name, served in flows.items()))
