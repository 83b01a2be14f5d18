"""Prefect flows: ingest, quality, and the whole run; one task per (stage, recording), records in and records out.

The only importer of Prefect. What a task does is a pure plan-and-build of `pipeline.stages`; what is done already was
decided before (`pipeline.orchestration.run_plan`), so an idle rerun never comes here.
"""

import logging
import os
import socket
import threading
import time
from collections.abc import Iterable
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
from prefect.cache_policies import NO_CACHE, CacheKeyFnPolicy
from prefect.client.schemas.objects import State
from prefect.futures import PrefectFuture, as_completed
from prefect.logging.handlers import PrefectConsoleHandler
from prefect.settings import PREFECT_API_URL, PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import Entry, LakeFile, Writer, is_intact, list_ingested, open_for_writing
from tracklake.pipeline.orchestration.artifacts import summarise_report
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.orchestration.run_plan import (
    ALL_STEPS,
    INGEST,
    QUALITY_STEPS,
    Order,
    Outcome,
    explain_left_out,
    explain_not_rebuilt,
    outstanding,
    plan_ingest,
    prune,
    remember_places,
    survey,
)
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import RawFile, SourceError
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import StructureError

REPORT = "report"
IN_PLACE = ("pages", REPORT)
"""Stages whose files are replaced under one name: what a cached record tells of them, others may have overwritten."""
OUR_FAULTS = (400, 422)
"""Answers of Prefect's API to a request that is wrong in itself."""

Results = Iterable[tuple[str, dict[str, Any] | BaseException]]


def _is_io_error(_task: object, _run: object, state: State[Any]) -> bool:
    """Retry what a busy disk or a network share may cause; nothing else becomes right by being tried again."""
    return isinstance(state.result(raise_on_failure=False), OSError | FileAccessError)


def _content_key(_context: object, parameters: dict[str, Any]) -> str:
    """The fingerprint covers the inputs' sha256, the settings and the code; the lake's id, where the files stand."""
    return f"tracklake-{parameters['lake_id']}-{parameters['job']['fingerprint']}"


SERVER_START_S = 120.0
FEW_THREADS: Any = ThreadPoolTaskRunner(max_workers=min(os.cpu_count() or 1, 4))
"""Of served flows: as many recordings in memory at once as the settings' default."""

RETRIES: dict[str, Any] = {"retries": 2, "retry_delay_seconds": 1, "retry_condition_fn": _is_io_error}


@task(task_run_name="read {title}", cache_policy=NO_CACHE, **RETRIES)
def read_file(title: str, lake: str, dataset: str, file: dict[str, Any]) -> dict[str, Any]:
    """Read one file that holds several recordings into the staging folder."""
    del title
    return ingest.read_file(Path(lake), dataset, RawFile.from_dict(file))


@task(
    task_run_name="{stage} {title}",
    cache_policy=CacheKeyFnPolicy(cache_key_fn=_content_key),
    persist_result=True,
    **RETRIES,
)
def build(
    stage: str, title: str, lake: str, lake_id: str, job: dict[str, Any], settings: dict[str, Any]
) -> dict[str, Any]:
    """One stage's work on one recording: read, transform, validate, write; returns the entry to commit."""
    del title, lake_id
    record = Job(**job)
    if stage == INGEST:
        return asdict(ingest.build(Path(lake), record))
    return asdict(STAGE_BY_NAME[stage].build(Path(lake), record, Settings(**settings)))


def _entry(record: dict[str, Any]) -> Entry:
    files = {table: [LakeFile(**file) for file in group] for table, group in record["files"].items()}
    return Entry(**{**record, "files": files})


def _settle(futures: dict[PrefectFuture[Any], str]) -> Results:
    """(title, record or what went wrong) of each future as it ends."""
    for future in as_completed(list(futures)):
        future.wait()
        yield futures[future], future.state.result(raise_on_failure=False)


def _blame(title: str, error: BaseException, outcome: Outcome) -> None:
    """Sort an error: bad input is refused and the others go on; anything else is a failure."""
    if isinstance(error, SourceError | StructureError):
        outcome.refused.append(str(error))
    else:
        outcome.failed.append(f"{title}: {describe_error(error)}")


def _build_all(writer: Writer, stage: str, jobs: list[Job], order: Order, outcome: Outcome) -> None:
    """Run a stage's jobs and commit each as it ends."""
    if not jobs:
        return
    show = reporter()
    show.begin(stage, len(jobs))

    settings = order.get_settings().model_dump(mode="json")

    def submit(job: Job, *, refresh: bool = False) -> PrefectFuture[Any]:
        chosen = build.with_options(refresh_cache=True) if refresh or stage in IN_PLACE else build
        return chosen.submit(stage, job.title, order.lake, writer.manifest.lake_id, asdict(job), settings)

    by_key = {job.key: job for job in jobs}
    for title, record in _settle({submit(job): job.title for job in jobs}):
        if isinstance(record, dict) and not is_intact(writer.root, _files(_entry(record))):
            # A cached record whose files were swept since: the work is done again.
            again = submit(by_key[record["key"]], refresh=True)
            again.wait()
            record = again.state.result(raise_on_failure=False)
        if isinstance(record, dict):
            entry = _entry(record)
            # A cached record tells where the raw files stood when it was made.
            writer.commit(replace(entry, built_from=by_key[entry.key].built_from))
            outcome.built[stage] = outcome.built.get(stage, 0) + 1
            outcome.notes += entry.info.get("notes", [])
        else:
            _blame(title, record, outcome)
        show.advance(stage, title)


def _files(entry: Entry) -> list[LakeFile]:
    return [file for group in entry.files.values() for file in group]


def _ingest(writer: Writer, order: Order, outcome: Outcome) -> None:
    """Read what must be read to know its recordings, then make each recording that is not in the lake."""
    discovery = survey(order)
    outcome.refused += discovery.refusals
    outcome.passed_by += discovery.passed_by
    unknown = ingest.files_to_read(discovery, writer.manifest)
    _read_all(writer, {file.sha256: (source.name, file) for source, file in unknown}, order, outcome)
    plan = plan_ingest(order, discovery, writer.manifest)
    outcome.refused += plan.conflicts
    remember_places(writer, order, plan)
    prune(writer, order, plan, outcome)
    needed = {
        file.sha256: (job.inputs["dataset"], file)
        for job in plan.jobs
        if ingest.needs_spill(job)
        for file in ingest.files_of(job)
        if not ingest.spill_folder(writer.root, file).exists()
    }
    _read_all(writer, needed, order, outcome)
    _build_all(writer, INGEST, plan.jobs, order, outcome)


def _read_all(writer: Writer, files: dict[str, tuple[str, RawFile]], order: Order, outcome: Outcome) -> None:
    if not files:
        return
    show = reporter()
    show.begin("read", len(files))
    futures = {
        read_file.submit(file.name, order.lake, dataset, file.to_dict()): sha256
        for sha256, (dataset, file) in files.items()
    }
    contents = {}
    for sha256, record in _settle(futures):
        if isinstance(record, dict):
            contents[sha256] = record
        else:
            _blame(files[sha256][1].name, record, outcome)
        show.advance("read", files[sha256][1].name)
    writer.remember_sources(contents)


def _work(order: Order) -> dict[str, Any]:
    outcome = Outcome()
    before = list_ingested(order.root) if order.rebuild else set()
    if order.rebuild and not survey(order).units:
        raise SourceError(f"{order.source}: nothing in it can be used, so the lake was not begun anew.")
    with open_for_writing(order.root, rebuild=order.rebuild) as writer:
        if INGEST in order.steps:
            _ingest(writer, order, outcome)
        for stage in order.stages():
            if outcome.failed and stage.name not in IN_PLACE:
                continue  # what comes later builds on what failed; the report shows what there is
            if INGEST in order.steps and not writer.manifest.of_stage(INGEST):
                continue  # everything was refused
            jobs, stale = outstanding(stage, writer.root, writer.manifest, order.get_settings())
            writer.remove(stale)
            _build_all(writer, stage.name, jobs, order, outcome)
        if set(order.steps) & {"repair", "samples", "split", "tensors"}:
            outcome.notes += explain_left_out(writer.manifest)
        outcome.notes += explain_not_rebuilt(before, writer.manifest)
        made = writer.manifest
    if REPORT in order.steps and not outstanding(STAGE_BY_NAME[REPORT], order.root, made, order.get_settings())[0]:
        outcome.notes += _publish(order.root)
    return asdict(outcome)


def _publish(root: Path) -> list[str]:
    """Attach the report's tables and its address to the flow run; returns a note where Prefect's API is not up to it.

    The lake is whole without them, so that a server that is busy, gone or forbids it fails no run. One that
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
    """The whole pipeline: raw files to tables, findings, repair, samples, split, tensors, first score and report."""
    return _work(Order(lake, ALL_STEPS, source, dataset, settings or {}, replace, prune, rebuild))


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
    """Raw files to tracks, vehicles and subsets."""
    return _work(Order(lake, (INGEST,), source, dataset, settings or {}, replace, prune, rebuild))


@flow(name="tracklake-quality", validate_parameters=False, task_runner=FEW_THREADS)
def quality(lake: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """Findings, late starts and the report over what is in the lake."""
    return _work(Order(lake, QUALITY_STEPS, settings=settings or {}))


@flow(name="tracklake-stage", flow_run_name="tracklake-{stage}", validate_parameters=False, task_runner=FEW_THREADS)
def run_stage(stage: str, lake: str, settings: dict[str, Any] | None = None) -> dict[str, Any]:
    """One stage over what is in the lake, or several (`repair+assess`)."""
    return _work(Order(lake, tuple(stage.split("+")), settings=settings or {}))


def execute(order: Order) -> Outcome:
    """Run an order as the flow that fits it, on threads, with nothing of Prefect's on the terminal."""
    parameters: dict[str, Any] = {"lake": order.lake, "settings": order.settings}
    chosen: Any = run_stage
    if INGEST in order.steps:
        chosen = run if tuple(order.steps) == ALL_STEPS else ingest_files
        parameters |= {"source": order.source, "dataset": order.dataset}
        parameters |= {"replace": order.replace, "prune": order.prune, "rebuild": order.rebuild}
    else:
        parameters["stage"] = "+".join(order.steps)
    changed: dict[Any, Any] = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}  # costs a second, and nobody listens for it
    if PREFECT_API_URL.value() is None:
        changed[PREFECT_API_URL] = _embed_server()
    with temporary_settings(changed):
        _mute_console()  # after all that sets logging up
        return Outcome(**chosen.with_options(task_runner=_choose_runner(order.get_settings()))(**parameters))


def _choose_runner(settings: Settings) -> TaskRunner[Any]:
    """Threads (Polars and DuckDB release the interpreter), or Dask workers, which need the lake on a shared disk."""
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
    """Take Prefect's lines off the terminal; its server still gets them, and the user gets ours."""
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
