"""Dask workers, in processes of their own: they fail, die, are missing, or lack what they need."""

import contextlib
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from unittest import mock

import polars
import pytest
import toy_calls
from distributed import LocalCluster
from small_recordings import write_highd

from tracklake.pipeline.lake import connect, is_intact, load
from tracklake.pipeline.lake.working_copy import hold_copy, locate_origin
from tracklake.pipeline.orchestration import batches, dask_workers, flows, run_plan, tasks
from tracklake.pipeline.orchestration.batches import Call
from tracklake.pipeline.orchestration.dask_workers import DaskWorkers, WorkersError, open_workers
from tracklake.pipeline.settings import Settings

pytestmark = [
    pytest.mark.usefixtures("plain_flows", "prefect_server"),
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]

CLUSTER = """
import sys
from distributed import LocalCluster, Worker
import logging
logging.disable()
import asyncio

async def work(address):
    async with Worker(address, nthreads=1, dashboard=False) as worker:
        print(worker.address, flush=True)
        await worker.finished()

if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(work(sys.argv[1]))
    else:
        cluster = LocalCluster(
            n_workers=1, processes=False, protocol="tcp", threads_per_worker=1, dashboard_address=None
        )
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""
"""Program that is a scheduler with a worker, or a worker of the scheduler at an address."""


@pytest.fixture(scope="module")
def workers() -> Iterator[DaskWorkers]:
    """A cluster on this machine, as `runner = "dask"` starts it."""
    with open_workers(Settings(runner="dask", workers=2), ()) as opened:
        yield opened


@pytest.fixture
def start() -> Iterator[Callable[..., str]]:
    """Starts CLUSTER in a process and returns the address that it prints."""
    processes = []

    def start_process(*arguments: str, options: tuple[str, ...] = (), **environment: str) -> str:
        process = subprocess.Popen(
            [sys.executable, *options, "-c", CLUSTER, *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path[1:]), **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        processes.append(process)
        return process.stdout.readline().strip()

    yield start_process
    for process in processes:
        process.kill()
        process.communicate()


@pytest.fixture
def unlike(tmp_path) -> dict[str, Any]:
    """Environment and options of a worker without scipy and tracklake, and with another Polars."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    for item in Path(polars.__file__).parents[1].iterdir():
        if not item.name.startswith(("scipy", "tracklake", "polars-")):
            (folder / item.name).symlink_to(item)
    other = folder / "polars-0.1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: polars\nVersion: 0.1\n")
    return {"options": ("-S",), "PYTHONPATH": str(folder)}  # -S: nor does it see what is installed


def make_calls(function: Callable, *arguments: tuple) -> list[Call]:
    return [Call(function, each, (f"{number:02}",)) for number, each in enumerate(arguments)]


def ingest(root: Path, raw: Path, **settings: object) -> run_plan.RunResult:
    return flows.execute(run_plan.RunRequest(str(root), ("ingest",), str(raw), settings=settings))


def run_stages(root: Path, *stages: str, **settings: object) -> run_plan.RunResult:
    return flows.execute(run_plan.RunRequest(str(root), stages, settings=settings))


def read(root: Path | str) -> list:
    with connect(root) as lake:
        return [lake.sql(f"FROM {table} ORDER BY ALL").fetchall() for table in ("tracks", "vehicles", "subsets")]


def test_results_and_errors_come_back_by_recording(workers):
    outcomes = list(workers.run_calls("toy", make_calls(toy_calls.add, (1, 2), (-1, 2), (3, 4))))
    made = {call.titles[0]: result for call, result in outcomes}
    assert (made["00"], made["02"]) == (3, 7)
    assert isinstance(made["01"], ValueError)
    assert "-1 is negative" in str(made["01"])
    assert made["01"].__traceback__ is not None


def test_warnings_of_local_workers_reach_the_log_and_full_memory_pauses_none(workers):
    """A paused worker would take no more work until its memory falls, which nothing makes fall."""
    logged: SimpleQueue[logging.LogRecord] = SimpleQueue()
    handler = QueueHandler(logged)
    logging.getLogger("tracklake").addHandler(handler)
    try:
        ((_, pauses_at),) = workers.run_calls("toy", make_calls(toy_calls.warn, ("tried again",)))
        assert logged.get(timeout=10).getMessage() == "tried again"
    finally:
        logging.getLogger("tracklake").removeHandler(handler)
    assert pauses_at is False


def test_workers_that_cannot_be_started_are_an_error_that_names_the_guard_of_scripts(monkeypatch):
    monkeypatch.setattr(dask_workers, "LocalCluster", mock.Mock(side_effect=RuntimeError("Nanny failed to start.")))
    with pytest.raises(WorkersError, match="A script must call"):
        open_workers(Settings(runner="dask"), ()).__enter__()


def test_a_worker_that_hangs_or_runs_an_old_release_is_an_error(workers, monkeypatch):
    monkeypatch.setattr(dask_workers, "ANSWER_S", 0.5)
    with pytest.raises(WorkersError, match=r"did not answer within 0\.5 s: it hangs"):
        workers._call_client(workers._client.run, time.sleep, 1.0)
    monkeypatch.undo()
    names = workers._client.nthreads().keys()
    assert workers.refuse_unfit(names) == set(names)
    workers._client.run(toy_calls.run_old_release)
    with pytest.raises(WorkersError, match=r"still runs tracklake 0\.0\.1, and must be started again"):
        workers.refuse_unfit(names)


@pytest.fixture
def raw(tmp_path) -> Path:
    """Four small recordings."""
    for number in ("01", "02", "03", "04"):
        write_highd(tmp_path / "raw", number)
    return tmp_path / "raw"


def test_a_job_is_done_again_where_its_worker_was_killed_and_one_that_kills_all_is_named(
    workers, raw, tmp_path, monkeypatch
):
    """02 kills its first worker while it writes, 03 each worker."""
    monkeypatch.setattr(batches, "build_group", toy_calls.build_or_die)
    monkeypatch.setattr(tasks, "_open_engine", lambda _request: contextlib.nullcontext(workers))
    root = tmp_path / "lake"
    result = ingest(root, raw)
    assert result.built == {"ingest": 3}
    (failure,) = result.failed
    assert failure.startswith("03: each Dask worker that worked on it died, at last 2 times ")
    assert "memory" in failure
    tries = len((tmp_path / "deaths-03").read_text().splitlines())
    assert 2 < tries <= 4  # it may have been suspected of the death that 02 caused
    # The killed ones left nothing, and what is there is whole.
    manifest = load(root)
    assert sorted(commit.tail for commit in manifest.of_stage("ingest")) == ["highd/01", "highd/02", "highd/04"]
    assert all(is_intact(root, commit.all_files) for commit in manifest.commits.values())
    assert [path for path in root.rglob("*") if ".tmp" in path.name or path.name == ".staging"] == []
    monkeypatch.undo()
    assert ingest(root, raw).built == {"ingest": 1}
    # And it is the lake that threads make.
    ingest(tmp_path / "threads", raw)
    assert read(root) == read(tmp_path / "threads")


@pytest.mark.thorough
def test_what_is_queued_is_cancelled_and_a_worker_that_joins_later_is_looked_at(start, unlike, tmp_path):
    address = start()
    calls = make_calls(toy_calls.wait, *((tmp_path, number) for number in range(8)))
    failed = []

    def do(workers: DaskWorkers) -> None:
        with pytest.raises(WorkersError) as refused:
            list(workers.run_calls("toy", calls))
        failed.append(str(refused.value))

    settings = Settings(runner="dask", dask_address=address)
    with open_workers(settings, [tmp_path]) as workers:
        thread = threading.Thread(target=do, args=(workers,))
        thread.start()
        while not (tmp_path / "1").exists():
            time.sleep(0.01)
    thread.join(timeout=10)
    assert len(failed) == 1
    begun = len(list(tmp_path.glob("[0-9]")))
    time.sleep(1.0)
    assert len(list(tmp_path.glob("[0-9]"))) == begun < 8
    with open_workers(settings, [tmp_path]) as workers:
        assert [made for _, made in workers.run_calls("toy", make_calls(toy_calls.add, (1, 2)))] == [3]
        other = start(address, **unlike)
        do(workers)
    assert f"{other}: tracklake is missing, polars 0.1 instead of {polars.__version__}, scipy is missing" in failed[1]
    assert f'pip install "tracklake=={version("tracklake")}" "polars=={polars.__version__}"' in failed[1]
    with pytest.raises(WorkersError, match="tracklake is missing"), open_workers(settings, [tmp_path]):
        raise AssertionError


def test_the_client_is_not_closed_while_it_is_asked(start, tmp_path):
    ended = []

    def do(workers: DaskWorkers) -> None:
        with pytest.raises(WorkersError, match="connection to the scheduler was lost"):
            list(workers.run_calls("toy", make_calls(toy_calls.wait, *((tmp_path, number) for number in range(8)))))
        ended.append(workers)

    with open_workers(Settings(runner="dask", dask_address=start()), [tmp_path]) as workers:
        ask, is_asked = workers._client.nthreads, threading.Event()

        def ask_slowly(**options: Any) -> Any:
            is_asked.set()
            time.sleep(0.5)
            return ask(**options)

        workers._client.nthreads = ask_slowly
        thread = threading.Thread(target=do, args=(workers,))
        thread.start()
        is_asked.wait()
    thread.join(timeout=20)
    assert ended == [workers]


def test_a_worker_sees_the_lake(start, tmp_path):
    with (
        open_workers(Settings(runner="dask", dask_address=start()), [tmp_path / "nowhere"]) as workers,
        pytest.raises(WorkersError, match="nowhere is not seen"),
    ):
        list(workers.run_calls("toy", make_calls(toy_calls.add, (1, 2))))


@pytest.mark.thorough
def test_workers_elsewhere_need_the_address_of_a_lake_on_an_object_store_and_the_raw_files(
    start, raw, bucket, tmp_path
):
    """The worker has a cache of its own; no table passes through this process."""
    pytest.importorskip("obstore", reason="the extra [object-store] pins one DuckDB, so lowest versions lack it")
    own = locate_origin(bucket, tmp_path / "own", 1.0)
    settings = {"runner": "dask", "dask_address": start(XDG_CACHE_HOME=str(tmp_path / "elsewhere"))}
    with hold_copy(own) as root:
        assert ingest(root, raw, **settings).built == {"ingest": 4}
        assert run_stages(root, "validate", **settings).built == {"validate": 4}
        (elsewhere,) = (tmp_path / "elsewhere").glob("tracklake/*")
        assert [len(list(cache.rglob("tracks/**/*.parquet"))) for cache in (own.cache, elsewhere)] == [0, 8]
        made = run_stages(root, "repair", "samples", "split", **settings)
        assert (made.built["split"], made.failed) == (1, []), "a job over the whole lake is done here"
    ingest(tmp_path / "lake", raw)
    run_stages(tmp_path / "lake", "validate", "repair", "samples", "split")
    assert read(bucket) == read(tmp_path / "lake")


def test_what_was_committed_stays_where_the_scheduler_is_lost(start, raw, tmp_path, monkeypatch):
    monkeypatch.setattr(batches, "build_group", toy_calls.build_until_03)
    root, address = tmp_path / "lake", start()
    with pytest.raises(WorkersError, match=f"Dask at {address}: the connection to the scheduler was lost"):
        ingest(root, raw, runner="dask", dask_address=address)
    assert [commit.tail for commit in load(root).of_stage("ingest")] == ["highd/01", "highd/02"]
    monkeypatch.undo()
    assert ingest(root, raw).built == {"ingest": 2}


def test_an_address_must_be_that_of_a_scheduler_with_workers(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_workers, "CONNECT_S", 0.5)
    monkeypatch.setattr(dask_workers, "WORKERS_WAIT_S", 0.5)

    def refuse(address: str) -> str:
        with pytest.raises(WorkersError) as refused, open_workers(Settings(dask_address=address), [tmp_path]):
            raise AssertionError
        return str(refused.value)

    with socket.create_server(("127.0.0.1", 0)) as mute:  # it takes connections, and never answers
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        assert refuse(address).startswith(f"dask_address = {address}: no Dask scheduler answered within 0.5 s")
    assert "no Dask scheduler answered within 0.5 s" in refuse(address)
    assert "unknown address scheme" in refuse("htp://host:8786")
    assert "check your TLS configuration" in refuse("tls://127.0.0.1:8786")
    with LocalCluster(n_workers=0, processes=False, protocol="tcp", dashboard_address=None) as cluster:
        said = refuse(cluster.scheduler_address)
    assert "the scheduler has no workers, and none joined within 0.5 s" in said
