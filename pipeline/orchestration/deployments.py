"""The flows as Prefect deployments: started by hand, by cron, or at an interval to watch a folder."""

import asyncio
from datetime import timedelta
from pathlib import Path
from typing import Any

from prefect import aserve
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy
from prefect.client.schemas.schedules import CronSchedule
from pydantic import ValidationError

from tracklake.pipeline.orchestration.flows import ingest_files, quality, run
from tracklake.pipeline.orchestration.server import require_server
from tracklake.schemas.errors import UsageError

FLOWS: dict[str, Any] = {"run": run, "ingest": ingest_files, "quality": quality}
"""Served flows by the name of their deployment."""
ONE_AT_A_TIME = ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.ENQUEUE)
"""Limit of each deployment: a run that is due while another goes on waits for it."""


def serve_deployments(lake: Path, source: Path | None, cron: str | None, interval_s: float | None) -> None:
    """Serve the flows as deployments until interrupted; runs are started from Prefect's UI, CLI or a schedule.

    Lake and source are defaults of the runs; by cron, or at an interval in seconds, the whole pipeline runs.

    Raises:
        UsageError: the cron expression cannot be read.
        PrefectError: no Prefect server answers at PREFECT_API_URL.
    """
    schedule: dict[str, Any] = {}
    if cron is not None:
        try:
            schedule = {"cron": CronSchedule(cron=cron).cron}
        except ValidationError as error:
            raise UsageError(f"--cron: expected five fields such as '0 3 * * *'; got {cron!r}") from error
    elif interval_s is not None:
        schedule = {"interval": timedelta(seconds=interval_s)}
    require_server()
    defaults = {"lake": str(lake.absolute()), **({} if source is None else {"source": str(source.absolute())})}
    deployments = []
    for name, flow in FLOWS.items():
        known = flow.parameters.properties
        deployments.append(
            flow.to_deployment(
                name,
                description=flow.description.partition("\n")[0],
                parameters={key: value for key, value in defaults.items() if key in known},
                concurrency_limit=ONE_AT_A_TIME,
                **(schedule if name == "run" else {}),
            )
        )
    asyncio.run(aserve(*deployments))
