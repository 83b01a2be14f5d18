"""Prefect flows: ingest, quality, and the whole run; one task per stage and batch of recordings.

Prefect runs tasks, and shows runs and artifacts. It caches nothing: what is done already is decided by the lake's
fingerprints (`pipeline.orchestration.run_plan`), so that an idle command never comes here.
"""

import logging
import os
from contextvars import ContextVar
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from prefect import flow
from prefect.artifacts import create_link_artifact
from prefect.client.schemas.objects import State
from prefect.logging import get_run_logger
from prefect.logging.handlers import PrefectConsoleHandler
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings
from prefect.states import Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner
from pydantic import Field
from typing_extensions import TypedDict

from tracklake.pipeline.lake import load
from tracklake.pipeline.orchestration.artifacts import attach, name_run, publish, summarise_report, tabulate_messages
from tracklake.pipeline.orchestration.batches import BATCHES_AT_ONCE
from tracklake.pipeline.orchestration.run_plan import (
    ALL_STEPS,
    QUALITY_STEPS,
    RunPlan,
    RunRequest,
    RunResult,
    conclude_idle,
    plan_run,
    survey_source,
)
from tracklake.pipeline.orchestration.server import use_server
from tracklake.pipeline.orchestration.tasks import do_work
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.stages.planner import Planner
from tracklake.pipeline.stages.stage import INGEST
from tracklake.schemas.columns import Dataset
from tracklake.schemas.errors import TracklakeError

REPORT = "report"
"""Name of the stage whose figures a run shows as artifacts."""
COMPLETED_WITH_REFUSALS = "CompletedWithRefusals"
"""Name of the final state of a run that did everything but for refused files."""
MAX_MESSAGES = 3
"""Most messages in a final state; the run's log and artifacts hold all."""
FEW_THREADS: Any = ThreadPoolTaskRunner(max_workers=min(os.cpu_count() or 1, 4))
"""Task runner of served flows: as many recordings in memory at once as the settings' default."""

if TYPE_CHECKING:
    SettingsChanges = dict[str, Any]
else:
    # Prefect shows a form with every setting, of which only those that are filled in are sent.
    SettingsChanges = TypedDict(
        "SettingsChanges",
        {
            name: Annotated[field.annotation, Field(description=field.description)]
            for name, field in Settings.model_fields.items()
            if name != "lake"
        },
        total=False,
    )

LockTimeout = Annotated[float, Field(ge=0)]

_PLAN: ContextVar[RunPlan | None] = ContextVar("plan", default=None)
"""What `execute` hands to its flow beside the parameters, which Prefect stores, limits in size and shows."""


class FlowFailedError(TracklakeError):
    """The end of a flow in which work failed, or nothing of the source could be used; it carries the result."""

    def __init__(self, message: str, result: RunResult) -> None:
        super().__init__(message)
        self.result = result


def _plan_here(request: RunRequest) -> RunPlan:
    """Plan a request that no command has planned: that of a deployment."""
    if INGEST not in request.steps:
        load(request.root)
        return plan_run(request, None)
    discovery = survey_source(request)
    if not discovery.units:
        raise SourceError("\n".join(discovery.refusals))
    return plan_run(request, discovery)


def _run_request(request: RunRequest, lock_timeout_s: float = 0.0) -> State[Any]:
    """Carry out a request and return the flow's final state, with the result as its data.

    A result with failures is Failed, and so is one without anything usable; refusals alone have a state of their own.
    """
    try:
        request = replace(request, lake=str(request.root.absolute()))  # workers may stand in other folders
        plan = _PLAN.get() or _plan_here(request)
        settings = request.get_settings()
        if plan.is_idle:
            name_run(request, [])
            result, manifest = conclude_idle(request, plan), load(request.root)
        else:
            result, manifest = do_work(request, plan, lock_timeout_s)
    except TracklakeError as error:
        get_run_logger().error("%s", error)
        return Failed(message=_shorten(str(error).splitlines()), data=error)
    if REPORT in request.steps and not Planner(request.root, manifest, settings).find_outstanding(REPORT)[0]:
        tables, link = summarise_report(request.root)
        result.notes += publish(tables) or attach(partial(create_link_artifact, **link))
    messages = tabulate_messages(request.root, manifest.lake_id, result)
    for row in messages.rows:
        get_run_logger().log(logging.getLevelName(row["level"]), "%s: %s", row["kind"], row["message"])
    if messages.rows:
        result.notes += publish([messages])
    return _conclude(result, usable=bool(manifest.of_stage(INGEST)), settings=settings)


def _conclude(result: RunResult, *, usable: bool, settings: Settings) -> State[Any]:
    """Return the final state of a run whose work has ended."""
    refusals = f"{len(result.refused)} refused: {_shorten(result.refused)}"
    if result.failed or (result.refused and (settings.refusals_fail or not usable)):
        message = _shorten(result.failed) if result.failed else refusals
        return Failed(message=message, data=FlowFailedError(message, result))
    if result.refused:
        return Completed(name=COMPLETED_WITH_REFUSALS, message=refusals, data=asdict(result))
    built = ", ".join(f"{stage} {count}" for stage, count in result.built.items())
    return Completed(message=built or "nothing to do: the lake is up to date", data=asdict(result))


def _shorten(messages: list[str]) -> str:
    rest = len(messages) - MAX_MESSAGES
    return "\n".join([*messages[:MAX_MESSAGES], *([f"and {rest} more, see the log"] if rest > 0 else [])])


SERVED: dict[str, Any] = {"validate_parameters": False, "task_runner": FEW_THREADS}
"""Options of every flow; Prefect's server checks the parameters of deployments itself."""


@flow(name="tracklake-run", flow_run_name="run {source}", **SERVED)
def run(
    lake: str,
    source: str,
    dataset: Dataset | None = None,
    settings: SettingsChanges | None = None,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
    lock_timeout_s: LockTimeout = 3600.0,
) -> State[Any]:
    """Run the whole pipeline: raw files to tables, findings, repair, samples, split, tensors, score and report.

    Args:
        lake: folder of the lake; it is created if missing.
        source: raw file, or folder with any mix of raw files.
        dataset: read the source's files as this dataset's only; empty: detect it.
        settings: settings that differ from tracklake.toml and the environment of `tracklake serve`.
        replace: let files of the source replace a recording's earlier files that the source lacks.
        prune: remove recordings whose files were in the source and are missing now.
        rebuild: make the whole lake again, also one of another schema version.
        lock_timeout_s: longest wait for another process that writes to the lake, in seconds.
    """
    request = RunRequest(lake, ALL_STEPS, source, dataset, settings or {}, replace, prune, rebuild)
    return _run_request(request, lock_timeout_s)


@flow(name="tracklake-ingest", flow_run_name="ingest {source}", **SERVED)
def ingest_files(
    lake: str,
    source: str,
    dataset: Dataset | None = None,
    settings: SettingsChanges | None = None,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
    lock_timeout_s: LockTimeout = 3600.0,
) -> State[Any]:
    """Ingest raw files: to tracks, vehicles and subsets.

    Args:
        lake: folder of the lake; it is created if missing.
        source: raw file, or folder with any mix of raw files.
        dataset: read the source's files as this dataset's only; empty: detect it.
        settings: settings that differ from tracklake.toml and the environment of `tracklake serve`.
        replace: let files of the source replace a recording's earlier files that the source lacks.
        prune: remove recordings whose files were in the source and are missing now.
        rebuild: make the whole lake again, also one of another schema version.
        lock_timeout_s: longest wait for another process that writes to the lake, in seconds.
    """
    request = RunRequest(lake, (INGEST,), source, dataset, settings or {}, replace, prune, rebuild)
    return _run_request(request, lock_timeout_s)


@flow(name="tracklake-quality", flow_run_name="quality {lake}", **SERVED)
def quality(lake: str, settings: SettingsChanges | None = None, lock_timeout_s: LockTimeout = 3600.0) -> State[Any]:
    """Make findings, late starts and the report of what is in the lake.

    Args:
        lake: folder of the lake.
        settings: settings that differ from tracklake.toml and the environment of `tracklake serve`.
        lock_timeout_s: longest wait for another process that writes to the lake, in seconds.
    """
    return _run_request(RunRequest(lake, QUALITY_STEPS, settings=settings or {}), lock_timeout_s)


@flow(name="tracklake-stage", flow_run_name="{stage} {lake}", **SERVED)
def run_stage(stage: str, lake: str, settings: SettingsChanges | None = None) -> State[Any]:
    """Run one stage over what is in the lake, or several (`repair+assess`)."""
    return _run_request(RunRequest(lake, tuple(stage.split("+")), settings=settings or {}))


def execute(request: RunRequest, plan: RunPlan | None = None) -> RunResult:
    """Run a request as the flow that fits it, with none of Prefect's lines on the terminal; it plans where needed."""
    parameters: dict[str, Any] = {"lake": request.lake, "settings": request.settings}
    chosen: Any = run_stage
    if INGEST in request.steps:
        chosen = run if tuple(request.steps) == ALL_STEPS else ingest_files
        parameters |= {"source": request.source, "dataset": request.dataset}
        parameters |= {"replace": request.replace, "prune": request.prune, "rebuild": request.rebuild}
        parameters["lock_timeout_s"] = 0.0
    else:
        parameters["stage"] = "+".join(request.steps)
    heartbeat = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}  # costs a second, and nothing uses it
    settings = request.get_settings()
    threads = settings.workers if settings.runner == "threads" else BATCHES_AT_ONCE
    with use_server() as notes, temporary_settings(heartbeat):
        _mute_console()  # after all that sets logging up
        token = _PLAN.set(plan)
        try:
            made = chosen.with_options(task_runner=ThreadPoolTaskRunner(max_workers=threads))(**parameters)
            result = RunResult(**made)
        except FlowFailedError as failed:
            result = failed.result
        finally:
            _PLAN.reset(token)
    result.notes += notes
    return result


def _mute_console() -> None:
    """Keep Prefect's lines off the terminal; its server still gets them, and the user gets ours."""
    for name in (None, "prefect", *logging.root.manager.loggerDict):
        logger = logging.getLogger(name)
        for handler in list(logger.handlers):
            if isinstance(handler, PrefectConsoleHandler):
                logger.removeHandler(handler)
    # Nor what it logs of a server that breaks off, which is one message of ours.
    logging.root.addHandler(logging.NullHandler())
    logging.raiseExceptions = False
