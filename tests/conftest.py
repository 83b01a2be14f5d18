"""What several test packages share: Prefect kept to itself, a generated sample, and a lake made of it."""

import os

from lake_sources import EXCERPTS, SAME_BITS, SAMPLE

os.environ |= SAME_BITS  # before anything imports NumPy

from tracklake.pipeline.cli.memory import collect_seldom, keep_freed_memory

collect_seldom()
keep_freed_memory()  # as each command does, before anything imports Polars

import gc
import http.client
import json
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import chdir, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from unittest import mock

import duckdb
import pytest
import vl_convert
from cloud_stores import cloud as cloud
from hypothesis import HealthCheck, settings
from object_stores import bucket as bucket
from object_stores import object_store_server as object_store_server
from object_stores import role as role
from plain_flows import replace_prefect
from simulated import simulate_once

SERVER_START_S = 120.0

# Two workers on two cores: more threads than one would only spin and wait for each other. Commands inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Polars alike, in the workers only: on small tables a second thread costs a seventh more. Commands use all cores.
os.environ.setdefault("POLARS_MAX_THREADS", "1")

# How fast an example is depends on what else the machine does; what is claimed about speed stands in benchmarks/.
settings.register_profile("tracklake", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("tracklake")


QUICK_SHARE, LEAST_EXAMPLES = 0.25, 6
"""Share of the examples that a property test asks for which are drawn without --thorough, and the fewest drawn."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="every test, with all examples of property tests")


def reduce_examples(test: Callable[..., object]) -> None:
    """Let a property test draw fewer examples than it asks for."""
    asked = getattr(test, "_hypothesis_internal_use_settings", settings.default)
    fewer = max(round(QUICK_SHARE * asked.max_examples), min(asked.max_examples, LEAST_EXAMPLES))
    test._hypothesis_internal_use_settings = settings(asked, max_examples=fewer)


@dataclass(frozen=True)
class Finished:
    """A command that ended."""

    code: int
    out: str
    err: str


FLOW_COMMANDS = ("run", "ingest", "validate", "repair", "samples", "split", "tensors", "report", "serve")
"""Commands that may need Prefect's API."""


@dataclass(frozen=True)
class Command:
    """Runs `tracklake` as a user does: a process of its own, in a folder of its own.

    Prefect's API is served by one process for all of them, as where PREFECT_API_URL is set; it starts with the first
    that may need it. `alone` is the command of somebody who has set up nothing: each serves itself, which costs it some
    seconds more.
    """

    folder: Path
    environment: dict[str, str]
    find_server: Callable[[], "Server"] | None = None

    def here(self, *arguments: str | Path, stdin: str = "", **extra: str) -> Finished:
        """The same in this process, which spares imports: where neither the process nor Prefect is what is tested.

        What runs flows needs the fixture `plain_flows`, too, or `prefect_here` where Prefect is what is tested.
        """
        from typer.testing import CliRunner

        from tracklake.pipeline.cli.app import app

        with chdir(self.folder), mock.patch.dict(os.environ, {**self.environment, **extra}, clear=True):
            done = CliRunner().invoke(app, [str(each) for each in arguments], input=stdin, catch_exceptions=False)
        return Finished(done.exit_code, done.stdout, done.stderr)

    @property
    def alone(self) -> "Command":
        return replace(self, find_server=None)

    def _make_environment(self, name: str | Path, extra: dict[str, str]) -> dict[str, str]:
        served = self.find_server is not None and name in FLOW_COMMANDS
        address = {"PREFECT_API_URL": self.find_server().address} if served else {}
        return {**self.environment, **address, **extra}

    def __call__(self, *arguments: str | Path, stdin: str = "", **extra: str) -> Finished:
        done = subprocess.run(
            [sys.executable, "-m", "tracklake.pipeline.cli.app", *map(str, arguments)],
            cwd=self.folder,
            env=self._make_environment(arguments[0], extra),
            input=stdin,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        return Finished(done.returncode, done.stdout, done.stderr)

    def start(self, *arguments: str | Path, **extra: str) -> "subprocess.Popen[str]":
        """Start it and do not wait."""
        return subprocess.Popen(
            [sys.executable, "-m", "tracklake.pipeline.cli.app", *map(str, arguments)],
            cwd=self.folder,
            env=self._make_environment(arguments[0], extra),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )


@pytest.fixture(scope="session")
def clean_environment() -> dict[str, str]:
    """The environment without this user's settings of Prefect and of tracklake."""
    others = ("TRACKLAKE_", "PREFECT_", "POLARS_MAX_THREADS")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(others)}
    return {**kept, "COLUMNS": "200", "PYTHONWARNINGS": "default"}


def is_served(port: int) -> bool:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("GET", "/api/health")
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


@dataclass(frozen=True)
class Server:
    """A Prefect server: where it is, for PREFECT_API_URL, and an empty database as it makes one, in seconds."""

    address: str
    empty_database: Path


@pytest.fixture(scope="session")
def prefect_server(clean_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    home = tmp_path_factory.mktemp("server")
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    arguments = ("server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui", "--analytics-off")
    # Of its services what records tasks, and nothing that looks for work again and again.
    services = {"PREFECT__SERVER_EPHEMERAL": "1"}
    services |= {f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in ("TRIGGERS", "EVENT_PERSISTER")}
    with (home / "log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "prefect", *arguments],
            env={**clean_environment, **services, "PREFECT_HOME": str(home), "DO_NOT_TRACK": "1"},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    try:
        limit = time.monotonic() + SERVER_START_S
        while not is_served(port):
            assert server.poll() is None, (home / "log").read_text()
            assert time.monotonic() < limit, (home / "log").read_text()
            time.sleep(0.1)
        with closing(sqlite3.connect(home / "prefect.db")) as made, closing(sqlite3.connect(home / "empty.db")) as copy:
            made.backup(copy)
        yield Server(f"http://127.0.0.1:{port}/api", home / "empty.db")
    finally:
        server.terminate()
        server.wait(timeout=30)


@pytest.fixture(scope="session")
def prefect_address(prefect_server: Server) -> str:
    """Where a Prefect server is, for PREFECT_API_URL."""
    return prefect_server.address


@pytest.fixture
def prefect_home(prefect_server: Server, tmp_path: Path) -> Path:
    """A folder for PREFECT_HOME in which a server need not make its database first."""
    home = tmp_path / "prefect"
    home.mkdir()
    shutil.copy(prefect_server.empty_database, home / "prefect.db")
    return home


@pytest.fixture(scope="session")
def command(
    request: pytest.FixtureRequest, clean_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory
) -> Command:
    environment = {**clean_environment, "PREFECT_HOME": str(tmp_path_factory.mktemp("prefect"))}
    find_server = partial(request.getfixturevalue, "prefect_server")
    return Command(tmp_path_factory.mktemp("elsewhere"), environment, find_server)


@contextmanager
def use_server(address: str, results: Path) -> Iterator[None]:
    """Let this process's flows use that server."""
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_LOGGING_TO_API_ENABLED,
        PREFECT_RESULTS_LOCAL_STORAGE_PATH,
        temporary_settings,
    )

    here = {
        PREFECT_API_URL: address,
        PREFECT_RESULTS_LOCAL_STORAGE_PATH: results,
        PREFECT_LOGGING_TO_API_ENABLED: False,  # or it would log to a server that has ended
    }
    with temporary_settings(here):
        yield


@pytest.fixture(scope="module")
def prefect_here(prefect_address: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The same server for this process: for flows, and for what `command.here` does that needs them."""
    with use_server(prefect_address, tmp_path_factory.mktemp("results")):
        yield


@pytest.fixture(scope="module")
def plain_flows() -> Iterator[None]:
    """Flows of this process run without Prefect: for tests of what they do, in less than half the time."""
    with replace_prefect():
        yield


@pytest.fixture(scope="session", autouse=True)
def convert_once() -> Iterator[Callable[[dict], str]]:
    """Convert every chart of this process once: many lakes and tests have the same, at half a second each."""
    convert, converted = vl_convert.vegalite_to_svg, {}

    def look_up(spec: dict) -> str:
        key = json.dumps(spec, default=str)
        if key not in converted:
            converted[key] = convert(spec)
        return converted[key]

    with mock.patch("vl_convert.vegalite_to_svg", look_up):
        yield convert


@pytest.fixture
def convert_again(convert_once: Callable[[dict], str]) -> Iterator[None]:
    """Convert every chart as often as it is drawn: for tests that compare what is drawn twice."""
    with mock.patch("vl_convert.vegalite_to_svg", convert_once):
        yield


@pytest.fixture(scope="module")
def empty_charts() -> Iterator[None]:
    """Charts of this process show nothing: for tests of something else, which would spend half their time on them."""
    with mock.patch("vl_convert.vegalite_to_svg", return_value="<svg ></svg>"):
        yield


@pytest.fixture(scope="session")
def sample(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default sample, shortened, with its truth.parquet."""
    folder = tmp_path_factory.mktemp("generated") / "sample"
    with simulate_once():
        done = command.here("sample", "--out", folder, *SAMPLE, "--quiet")
    assert done.code == 0, done.err
    return folder


@dataclass(frozen=True)
class Lake:
    """A lake the whole pipeline made, and what the command said. Tests read it and do not change it."""

    root: Path
    said: dict


@pytest.fixture(scope="session")
def make_lake(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Lake]:
    """Make a lake of raw files by `tracklake run` in this process."""

    def make(source: Path) -> Lake:
        root = tmp_path_factory.mktemp("lakes") / "lake"
        with replace_prefect():
            done = command.here("run", source, "--lake", root, "--json")
        assert done.code == 0, done.err
        return Lake(root, json.loads(done.out))

    return make


@pytest.fixture(scope="session")
def lake(make_lake: Callable[..., Lake], sample: Path) -> Lake:
    return make_lake(sample)


@pytest.fixture(scope="session")
def excerpts_lake(make_lake: Callable[..., Lake]) -> Lake:
    """A lake of the real NGSIM excerpts, where they are at hand."""
    if not EXCERPTS.is_dir():
        pytest.skip(f"the NGSIM excerpts are not at {EXCERPTS}")
    return make_lake(EXCERPTS)


def choose_group(item: pytest.Item) -> str:
    """What uses the lakes shared by all, or Prefect's server, stays on one worker, and so does each file.

    Each of the lakes, the server and the fixtures of a module is then made once.
    """
    used = set(getattr(item, "fixturenames", ()))
    if used & {"prefect_server", "sample", "lake"}:
        return "lake"
    for shared, group in (("excerpts_lake", "excerpts"), ("object_store_server", "bucket")):
        if shared in used:
            return group
    return item.nodeid.partition("::")[0]


@pytest.hookimpl(tryfirst=True)  # before xdist reads the markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--thorough"):
        for test in {item.obj for item in items if getattr(getattr(item, "obj", None), "is_hypothesis_test", False)}:
            reduce_examples(test)
        left_out = [item for item in items if item.get_closest_marker("thorough")]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]
    for item in items:
        item.add_marker(pytest.mark.xdist_group(choose_group(item)))
    # A server costs a tenth of a processor while it waits: the files that need it come last.
    served = {item.path for item in items if "prefect_server" in getattr(item, "fixturenames", ())}
    items.sort(key=lambda item: item.path in served)


@pytest.fixture(scope="session", autouse=True)
def one_duckdb_thread() -> Iterator[None]:
    """Give each connection of the tests' process one thread, as Polars has: on small tables a second only costs."""
    connect = duckdb.connect

    def connect_with_one(*arguments: object, config: dict | None = None, **named: object) -> duckdb.DuckDBPyConnection:
        return connect(*arguments, config={"threads": 1, **(config or {})}, **named)

    with mock.patch.object(duckdb, "connect", connect_with_one):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Import all tests without garbage collections, which would find nothing and look through all modules each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Keep what was imported out of garbage collections: each that looks through all of it takes half a second."""
    gc.collect()
    gc.freeze()
