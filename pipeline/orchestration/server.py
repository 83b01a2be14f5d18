"""The Prefect server that records a run: the one that PREFECT_API_URL names, or one inside this process."""

import logging
import re
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from contextvars import copy_context
from pathlib import Path
from typing import Any

import httpx
from prefect.client.orchestration import get_client
from prefect.settings import (
    PREFECT_API_DATABASE_CONNECTION_URL,
    PREFECT_API_URL,
    get_current_settings,
    temporary_settings,
)

from tracklake.pipeline.orchestration.prefect_home import find_home_fault, make_temporary_folder
from tracklake.schemas.errors import TracklakeError

SERVER_START_S = 120.0
"""Longest wait for the embedded server, in seconds."""
EXCEPTION_LINE = re.compile(r"^[\w.]+(?:Error|Exception): .*$", re.MULTILINE)
"""Line of a traceback that names the error."""
LOCK_WAIT_S = 5.0
"""Longest wait for another process that locks Prefect's database, in seconds."""
MAX_CHECKED_BYTES = 64 << 20
"""Largest database whose pages are checked before it is used, in bytes."""


class PrefectError(TracklakeError):
    """Prefect's server cannot be used; the message says why and what to do."""


@contextmanager
def use_server() -> Iterator[list[str]]:
    """Record the flows of a block on a server; yields notes about what stands in for Prefect's own state.

    Raises:
        PrefectError: no server can be reached or started, or it broke off during the block.
    """
    address = PREFECT_API_URL.value()
    if address:  # an empty one is none
        require_server()
        notes: list[str] = []
    else:
        address, notes = _start_embedded()
    with temporary_settings({PREFECT_API_URL: address}):
        try:
            yield notes
        except httpx.HTTPError as error:
            if isinstance(error, httpx.HTTPStatusError) and not error.response.is_server_error:
                raise
            raise PrefectError(
                f"Prefect's server at {address} broke off ({_take_first_line(error)}). Run the same command again: "
                "what was committed to the lake is kept."
            ) from error


def require_server() -> None:
    """Refuse a PREFECT_API_URL that is not set, or behind which no Prefect server answers.

    Raises:
        PrefectError: it is not set, or what answers there is no Prefect server of a fitting version.
    """
    address = PREFECT_API_URL.value()
    if not address:
        raise PrefectError(
            "PREFECT_API_URL is not set: no server would record the runs. Start one, for instance\n"
            "  prefect server start\n  export PREFECT_API_URL=http://127.0.0.1:4200/api"
        )
    try:
        with get_client(sync_client=True) as client:
            client.raise_for_api_version_mismatch()
    except (RuntimeError, ValueError, httpx.HTTPError, httpx.InvalidURL) as error:
        reason = _take_first_line(error.__cause__ or error)
        raise PrefectError(
            f"PREFECT_API_URL: no Prefect server answers at {address} ({reason}). Start one (`prefect server start`), "
            "correct the address, or unset PREFECT_API_URL to run without."
        ) from error


def _start_embedded() -> tuple[str, list[str]]:
    """Start a server, on a temporary database where Prefect's own cannot be used; returns its address, and notes."""
    fault = find_home_fault()
    if fault is not None:
        return _embed_server(), [_explain_temporary(fault)]
    database = _locate_database()
    reason = None if database is None else _find_fault(database)
    if reason is None:
        try:
            return _embed_server(), []
        except PrefectError as error:
            if database is None:
                raise
            reason = str(error)
    file = make_temporary_folder() / "prefect.db"
    with temporary_settings({PREFECT_API_DATABASE_CONNECTION_URL: f"sqlite+aiosqlite:///{file}"}):
        return _embed_server(), [_explain_temporary(f"{database}: {reason}")]


def _explain_temporary(reason: str) -> str:
    return (
        f"Prefect's own state cannot be used ({reason}); this run is recorded in a temporary one, "
        f"{make_temporary_folder()}, which is deleted with it. `prefect server database reset` makes Prefect's "
        "database again; PREFECT_HOME names another folder"
    )


def _locate_database() -> Path | None:
    """Return the SQLite file in Prefect's home; None where another database is configured."""
    file: Path = get_current_settings().home / "prefect.db"
    return file if PREFECT_API_DATABASE_CONNECTION_URL.value().endswith(f"///{file}") else None


def _find_fault(database: Path) -> str | None:
    """Return why a SQLite database cannot be written to; None where it can, or is yet to be made."""
    if not database.exists():
        return None
    try:
        with closing(sqlite3.connect(database, timeout=LOCK_WAIT_S, isolation_level=None)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            if database.stat().st_size <= MAX_CHECKED_BYTES:
                (result,) = connection.execute("PRAGMA quick_check(1)").fetchone()
                if result != "ok":
                    return f"damaged: {result}"
            connection.execute("ROLLBACK")
    except sqlite3.Error as error:
        return str(error)
    return None


def _embed_server() -> str:
    """Serve Prefect's API from a thread of this process and return its address.

    The server that Prefect would start by itself is a process of its own, which outlives one that is killed. This one
    ends with us, whatever happens, and spares a second interpreter's start. It is never stopped before: Prefect sends
    its last logs and events to it while the interpreter exits.
    """
    import uvicorn
    from prefect.server.api.server import create_app

    failures: list[str] = []
    app: Any = create_app(ephemeral=True)

    async def record_failure(scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401  (ASGI's own dicts)
        async def watch(message: Any) -> None:  # noqa: ANN401  (a dict of ASGI)
            if message["type"].endswith(".failed"):
                failures.append(message.get("message", ""))
            await send(message)

        await app(scope, receive, watch)

    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
    listener = socket.socket()
    try:
        listener.bind(("127.0.0.1", 0))
        server = uvicorn.Server(uvicorn.Config(record_failure, log_config=None, lifespan="on"))
        run_in_context, sockets = copy_context().run, {"sockets": [listener]}
        thread = threading.Thread(
            target=run_in_context, args=(server.run,), kwargs=sockets, name="prefect-server", daemon=True
        )
        thread.start()
        limit = time.monotonic() + SERVER_START_S
        while not server.started:
            if not thread.is_alive() or time.monotonic() > limit:
                last = EXCEPTION_LINE.findall("".join(failures))[-1:] or ["it gave no reason"]
                raise PrefectError(
                    f"Prefect's embedded server did not start ({last[0]}). Look at PREFECT_HOME and its disk, or set "
                    "PREFECT_API_URL to a running server."
                )
            time.sleep(0.01)
    except BaseException:
        with suppress(NameError):
            server.should_exit = True
        listener.close()
        raise
    return f"http://127.0.0.1:{listener.getsockname()[1]}/api"


def _take_first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0] or type(error).__name__
