"""Flows without Prefect: the same functions called in this thread, for tests of what the flows do."""

import logging
import pkgutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from typing import Any
from unittest import mock


@dataclass(eq=False)
class DoneFuture:
    """The future of a task that has ended."""

    state: Any
    _final_state: bool = True

    def wait(self) -> None:
        """Return at once."""


def call_flow(flow: Any, *arguments: Any, **named: Any) -> Any:
    """Call a flow's function; raise what a failed state holds."""
    from prefect.client.schemas.objects import State

    result = flow.fn(*arguments, **named)
    return result.result() if isinstance(result, State) else result


def submit_task(task: Any, *arguments: Any, **named: Any) -> DoneFuture:
    """Call a task's function once and hold its result or error as Prefect's futures do."""
    from prefect.states import Completed, Failed

    try:
        return DoneFuture(Completed(data=task.fn(*arguments, **named)))
    except Exception as error:  # noqa: BLE001  a task's error is a result
        return DoneFuture(Failed(data=error))


REPLACED: dict[str, Any] = {
    "create_table_artifact": lambda **_artifact: None,
    "create_link_artifact": lambda **_artifact: None,
    "get_run_logger": lambda: logging.getLogger("plain_flows"),
    "use_server": lambda: nullcontext([]),
    "_embed_server": lambda: "http://nowhere/api",
}
"""Functions of the orchestration that need a server or a run, with what stands in for them."""


@contextmanager
def replace_prefect() -> Iterator[None]:
    """Let flows of this process run as plain functions, without server, threads and retries."""
    from prefect import Flow, Task

    from tracklake.pipeline import orchestration

    with ExitStack() as patches:
        patches.enter_context(mock.patch.object(Flow, "__call__", call_flow))
        patches.enter_context(mock.patch.object(Task, "submit", submit_task))
        for found in pkgutil.iter_modules(orchestration.__path__, f"{orchestration.__name__}."):
            if found.name == f"{orchestration.__name__}.dask_workers":
                continue  # it has none of these, and needs an extra
            module = import_module(found.name)
            for name, stand_in in REPLACED.items():
                if hasattr(module, name):
                    patches.enter_context(mock.patch.object(module, name, stand_in))
        yield
