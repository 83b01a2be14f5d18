"""Dask workers: a cluster on this machine, or an existing one, that does the calls of a flow run."""

import asyncio
import logging
import os
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from queue import Empty, SimpleQueue
from typing import Any

import dask
from distributed import Client, LocalCluster, Security, rpc
from distributed.scheduler import KilledWorker
from distributed.system import MEMORY_LIMIT

from tracklake.pipeline.lake.checksums import forget_checksums
from tracklake.pipeline.orchestration.batches import Call, CallResult
from tracklake.pipeline.settings import Settings
from tracklake.schemas.errors import TracklakeError

CONNECT_S = 10.0
"""Longest wait for a scheduler, in seconds."""
WORKERS_WAIT_S = 60.0
"""Longest time without any worker, in seconds: at first, and while there is work."""
ANSWER_S = 120.0
"""Longest wait for an answer of the scheduler, or of workers that may have to import packages first, in seconds."""
POLL_S = 1.0
"""Time between two looks at the workers while work goes on, in seconds."""
LOCAL_DEATHS = 1
"""Deaths of workers of a cluster on this machine after which a call is suspected; it is then tried again alone."""
PACKAGES = (
    *("tracklake", "polars", "pyarrow", "duckdb", "numpy", "pandera", "pydantic", "dask", "distributed"),
    *("scipy", "scikit-learn", "altair", "vl-convert-python", "pyproj", "rosbags"),
)
"""Packages that results depend on; those installed here must be installed in the same versions on each worker."""
SETUP = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); import tracklake.pipeline.orchestration.batches"
"""What a worker of a cluster on this machine does first: Ctrl-C is for the command, which ends its workers."""


class WorkersError(TracklakeError):
    """Dask workers cannot do the work, or cannot go on with it; the message says why and what to do."""


class KilledWorkerError(TracklakeError):
    """Workers died of one call; the message names its recording."""


class DaskWorkers:
    """Does the calls of a batch on all workers of a cluster.

    Args:
        client: client of the cluster.
        address: address of an existing scheduler; None: the cluster is one of ours on this machine.
        places: files and folders that each worker must see.
    """

    def __init__(self, client: Client, address: str | None, places: Collection[Path]) -> None:
        self._client = client
        self._address = address
        self._places = places
        self._admitted: set[str] = set()
        self._guard = threading.Lock()
        self._is_closed = False
        self._missing_since: float | None = None
        self._count_slots(client.nthreads().values())

    def run_calls(self, stage: str, calls: Sequence[Call]) -> Iterator[CallResult]:
        """Yield the outcome of each call as it ends.

        A call that was under way on a worker when it died is done again on another, and at last alone: what shares a
        worker with a call that kills it is suspected as well.

        Raises:
            WorkersError: the scheduler is lost, no worker is left, or a worker cannot do the work.
        """
        suspects = []
        for call, made in self._map(stage, calls):
            if isinstance(made, KilledWorker):
                suspects.append(call)
            else:
                yield call, made
        for call in suspects:
            for _, made in self._map(stage, [call], priority=1):  # or it would wait behind one that kills its worker
                if isinstance(made, KilledWorker):
                    yield call, _explain_deaths(made.allowed_failures + 1)
                else:
                    yield call, made

    def _map(self, stage: str, calls: Sequence[Call], priority: int = 0) -> Iterator[CallResult]:
        """Send calls to the workers, and yield their outcomes as they end."""
        self.check_workers()
        batch = uuid.uuid4().hex
        keys = [f"{stage}-{batch}-{number}" for number in range(len(calls))]
        pending = dict(zip(keys, calls, strict=True))
        ended: SimpleQueue[Any] = SimpleQueue()
        futures = self._client.map(Call.run, calls, key=keys, pure=False, priority=priority)
        try:
            for future in futures:
                future.add_done_callback(ended.put)
            while pending:
                try:
                    future = ended.get(timeout=POLL_S)
                except Empty:
                    self.check_workers()
                    continue
                made = self._fetch(future)
                self.check_workers()  # so that nothing is committed that a worker made which should have made nothing
                yield pending.pop(future.key), made
        finally:
            if pending:
                with suppress(Exception), self._hold_client():  # one that is closed has cancelled them
                    self._client.cancel(futures, force=True)

    def _fetch(self, future: Any) -> Any:  # noqa: ANN401  (untyped in distributed; a record, or an exception)
        """Return the result of a call that has ended, or the exception that it raised."""
        while future.status not in ("error", "cancelled"):
            try:
                return future.result(timeout=POLL_S)
            except TimeoutError:  # its worker has died since; another does it again
                self.check_workers()
            except Exception:  # so does this one, and failed
                if future.status not in ("error", "cancelled"):
                    raise
        if future.status == "cancelled":
            raise self._explain_loss()
        with self._hold_client():
            return future.exception(ANSWER_S).with_traceback(future.traceback(ANSWER_S))

    def check_workers(self) -> None:
        """Refuse to go on without workers, or with one that has joined and cannot do the work.

        Raises:
            WorkersError: as above, or the scheduler is lost.
        """
        with self._hold_client():
            threads = self._call_client(self._client.nthreads)
            workers = threads.keys()
            if workers:
                self._missing_since = None
                self._count_slots(threads.values())
            elif self._missing_since is None:
                self._missing_since = time.monotonic()
            elif time.monotonic() - self._missing_since > WORKERS_WAIT_S:
                raise WorkersError(
                    f"{self._name()}: no worker was left for {WORKERS_WAIT_S:g} s. What was committed to the lake is "
                    "kept: start workers, and run the same command again."
                )
            if self._address is not None and workers - self._admitted:
                self._admitted |= self.refuse_unfit(workers - self._admitted)

    def close(self) -> None:
        """End batches that go on in other threads: a client that is closed while it is asked never answers."""
        with self._guard:
            self._is_closed = True

    @contextmanager
    def _hold_client(self) -> Iterator[None]:
        """Keep the client open, for the length of a block."""
        with self._guard:
            if self._is_closed or self._client.status != "running":
                raise self._explain_loss()
            yield

    def _count_slots(self, threads: Collection[int]) -> None:
        """Let the next batches be as large as the cluster is now, which may grow."""
        self.slots = max(sum(threads), 1)
        self.batch_calls = 2 * self.slots

    def _call_client(self, question: Callable[..., Any], *arguments: Any, **options: Any) -> Any:  # noqa: ANN401  (untyped in distributed)
        """Return what a method of the client answers.

        Raises:
            WorkersError: the scheduler is lost, or it or a worker does not answer.
        """
        try:
            return question(*arguments, callback_timeout=ANSWER_S, **options)
        except TimeoutError:
            raise WorkersError(
                f"{self._name()}: the scheduler or a worker did not answer within {ANSWER_S:g} s: it hangs, or the "
                "disk that holds its packages, the lake or the raw files does. What was committed to the lake is kept: "
                "end what hangs, and run the same command again."
            ) from None
        except (OSError, CancelledError, RuntimeError):
            raise self._explain_loss() from None

    def refuse_unfit(self, workers: Collection[str], *, is_first: bool = False) -> set[str]:
        """Compare the packages of workers with those here, and find out whether they see the lake's folder.

        Returns those that are fit; one that did not answer, as it is about to go, is neither fit nor refused.

        Raises:
            WorkersError: a worker lacks something, or has another version.
        """
        here = {"Python": python_version(), **_list_releases()}
        run, options = partial(self._call_client, self._client.run), {"workers": list(workers), "on_error": "return"}
        fit = set()
        faults: dict[str, list[str]] = {}
        for name, own in here.items():
            found = run(python_version, **options) if name == "Python" else run(version, name, **options)
            if is_first and name != "Python":
                found["the scheduler"] = self._ask_scheduler(name)
            for place, answer in found.items():
                if isinstance(answer, PackageNotFoundError):
                    faults.setdefault(place, []).append(f"{name} is missing")
                elif isinstance(answer, str) and _shorten(name, answer) != _shorten(name, own):
                    faults.setdefault(place, []).append(f"{name} {answer} instead of {own}")
        if not faults:  # now that they should: tracklake may be listed and not be found, or replaced since
            for place, answer in run(begin_session, **options).items():
                if isinstance(answer, dict):
                    fit.add(place)
                    old = [f"{name} {own}" for name, own in answer.items() if own != here.get(name, own)]
                    if old:
                        faults[place] = [f"still runs {', '.join(old)}, and must be started again"]
                elif not isinstance(answer, OSError):
                    faults[place] = [f"tracklake cannot be imported: {answer}"]
        for path in () if is_first else self._places:
            for place, answer in run(os.path.exists, str(path), **options).items():
                if answer is False:
                    faults.setdefault(place, []).append(f"{path} is not seen")
        if faults:
            listed = "\n".join(f"  {place}: {', '.join(found)}" for place, found in sorted(faults.items()))
            same = " ".join(f'"{name}=={own}"' for name, own in here.items() if name != "Python")
            raise WorkersError(
                f"{self._name()}: it is not used, as some of its workers are not like this machine:\n{listed}\n"
                "Each needs the same packages, in the same versions, and the disks that hold the lake and the raw "
                f"files at the same paths: pip install {same}"
            )
        return fit

    def _ask_scheduler(self, package: str) -> str | PackageNotFoundError:
        try:
            return str(self._call_client(self._client.run_on_scheduler, version, package))
        except PackageNotFoundError as missing:
            return missing

    def _explain_loss(self) -> WorkersError:
        return WorkersError(
            f"{self._name()}: the connection to the scheduler was lost. What was committed to the lake is kept: start "
            "the scheduler and its workers again, and run the same command again."
        )

    def _name(self) -> str:
        return "the Dask cluster on this machine" if self._address is None else f"Dask at {self._address}"


@contextmanager
def open_workers(settings: Settings, places: Collection[Path]) -> Iterator[DaskWorkers]:
    """Connect to the cluster that the settings name, or start one on this machine, for the length of a block.

    At its end what is still to be done is cancelled.

    Raises:
        WorkersError: no scheduler answers, it has no workers, or they are not like this machine.
    """
    _mute()
    address = settings.dask_address
    with ExitStack() as stack:
        if address is None:
            client = stack.enter_context(Client(_start_cluster(stack, settings.workers), set_as_default=False))
        else:
            client = stack.enter_context(_connect(address))
        try:
            client.wait_for_workers(1, timeout=WORKERS_WAIT_S)
        except TimeoutError:
            if address is None:
                raise WorkersError(f"no Dask worker started on this machine within {WORKERS_WAIT_S:g} s.") from None
            raise WorkersError(
                f"Dask at {address}: the scheduler has no workers, and none joined within {WORKERS_WAIT_S:g} s. Start "
                f"some: dask worker {address}"
            ) from None
        workers = DaskWorkers(client, address, places)
        if address is None:
            client.forward_logging("tracklake")  # those of an existing cluster have logs of their own
        else:
            workers.refuse_unfit(client.nthreads().keys(), is_first=True)
        try:
            yield workers
        finally:
            workers.close()


def _connect(address: str) -> Any:  # noqa: ANN401  (untyped in distributed)
    """Return a client of a scheduler, after it has answered: `Client` waits for ever for what is none."""
    with ThreadPoolExecutor(max_workers=1) as thread:  # a notebook has a loop of its own in the main one
        asked = thread.submit(lambda: asyncio.run(asyncio.wait_for(_identify(address), CONNECT_S)))
        try:
            kind = asked.result()
        except Exception as failed:  # noqa: BLE001  (each kind of address fails in its own way, such as TLS without keys)
            kind = str(failed) or "no answer"
    if kind != "Scheduler":
        raise WorkersError(
            f"dask_address = {address}: no Dask scheduler answered within {CONNECT_S:g} s ({kind}). Start one (dask "
            "scheduler), or correct the address, such as tcp://host:8786."
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other versions, which are refused
        return Client(address, timeout=CONNECT_S, set_as_default=False)


async def _identify(address: str) -> str:
    """Return what answers at an address: Scheduler, Worker or Nanny."""
    async with rpc(address, connection_args=Security().get_connection_args("client")) as server:
        return str((await server.identity())["type"])


def _start_cluster(stack: ExitStack, workers: int) -> Any:  # noqa: ANN401  (untyped in distributed)
    """Start a scheduler in this process and workers in processes of one thread, which share the memory."""
    options: dict[str, Any] = {"memory_limit": MEMORY_LIMIT // workers, "preload": [SETUP]}
    # A paused worker takes no more work until its memory falls, which it need not do while nothing is going on.
    try:
        with dask.config.set({"distributed.worker.memory.pause": False}):
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                scheduler_kwargs={"allowed_failures": LOCAL_DEATHS},
                **options,
            )
    except RuntimeError as failed:
        raise WorkersError(
            f"Dask's workers could not be started on this machine: {failed} A script must call tracklake.run under "
            '`if __name__ == "__main__":`, as each worker imports the script; else the lines above say why.'
        ) from failed
    return stack.enter_context(cluster)


def _mute() -> None:
    """Keep Dask's lines off the terminal, where each death of a worker fills a page; the user gets ours."""
    for name in ("distributed", "distributed.client", "tornado", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _explain_deaths(tries: int) -> KilledWorkerError:
    return KilledWorkerError(
        f"each Dask worker that worked on it died, at last {tries} times while it had nothing else to do, probably "
        "because its memory ran out. Give workers more memory (fewer at once, with --workers, or larger machines), and "
        "run the same command again."
    )


def begin_session() -> dict[str, str]:
    """Return the releases that a worker runs, and let it forget which files an earlier session has compared."""
    forget_checksums()
    return _list_releases()


@cache
def _list_releases() -> dict[str, str]:
    """Return the releases of PACKAGES as they were first asked for: later ones on the disk are not what runs."""
    return {name: found for name in PACKAGES if (found := _find_version(name))}


def _find_version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _shorten(name: str, release: str) -> str:
    """Return a version, of Python without the last number."""
    return release.rpartition(".")[0] if name == "Python" else release
