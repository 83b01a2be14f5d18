"""The work that a thread or a worker does, and how it is divided; with nothing of Prefect and Dask.

Records go in and come out, never frames: what is sent to a worker is a `Call` of `build_group` or `read_file`.
"""

import errno
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, Protocol, TypeVar

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import Commit, Manifest, load
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.lake.origin import Origin, find_origin
from tracklake.pipeline.lake.transfers import send_commits
from tracklake.pipeline.lake.working_copy import locate_origin, open_workspace
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import RawFile
from tracklake.pipeline.stages import planner
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.schemas.errors import FileAccessError

T = TypeVar("T")
CallResult = tuple["Call", Any]
"""A call, and its result or the exception that it raised."""

LASTING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EROFS, errno.EACCES, errno.EPERM)
"""Errors of the operating system that a second try does not cure: full disks, limits, missing rights."""
TRIES = 3
"""Times that input and output are tried."""
RETRY_DELAY_S = 1.0
"""Time between two tries, in seconds."""
MOST_BATCHES = 100
"""Batches of one stage, of which each is one task of Prefect's and one commit; with more calls than that, they grow."""
BATCHES_AT_ONCE = 3
"""Batches under way at once on Dask workers, which have work while the last calls of one of them end."""
LOG = logging.getLogger("tracklake")


@dataclass(frozen=True)
class Call:
    """A call of a function for one recording, or for some that are built together: fit to be sent to a worker.

    Args:
        titles: names of the recordings, or files, in progress bars and messages.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    titles: tuple[str, ...]

    def run(self) -> Any:  # noqa: ANN401  (records of several kinds)
        """Do the work, and return its records."""
        return self.function(*self.arguments)


class Engine(Protocol):
    """Whatever does calls: threads of this process, or Dask workers.

    Args:
        slots: calls that are done at once.
        batch_calls: fewest calls in a batch, so that none of the slots is idle.
    """

    slots: int
    batch_calls: int

    def run_calls(self, stage: str, calls: Sequence[Call]) -> Iterator[CallResult]:
        """Yield the outcome of each call as it ends."""


class Threads:
    """Does the calls of a batch one after the other, in the thread that asks for them."""

    def __init__(self, workers: int) -> None:
        self.slots = workers
        self.batch_calls = 1
        self._stopped = threading.Event()

    def run_calls(self, stage: str, calls: Sequence[Call]) -> Iterator[CallResult]:
        """Yield the outcome of each call as it ends."""
        del stage
        for call in calls:
            if self._stopped.is_set():
                return
            try:
                made = call.run()
            except Exception as error:  # noqa: BLE001  (an outcome, which the flow sorts)
                made = error
            yield call, made

    def stop(self) -> None:
        """Begin no further call: the flow was interrupted."""
        self._stopped.set()


def divide_calls(engine: Engine, calls: Sequence[Call]) -> list[Sequence[Call]]:
    """Divide a stage's calls into batches: of one, where threads do at most a hundred of them."""
    size = max(engine.batch_calls, ceil(len(calls) / MOST_BATCHES))
    return [calls[start : start + size] for start in range(0, len(calls), size)]


def name_batch(calls: Sequence[Call]) -> str:
    """Return the name of a batch: `04`, or `01 to 20 (20)`."""
    titles = [title for call in calls for title in call.titles]
    return ", ".join(titles) if len(calls) < 2 else f"{titles[0]} to {titles[-1]} ({len(titles)})"


def build_group(
    lake: str, stage: str, jobs: Sequence[Job], settings: Settings, readable: Manifest | None = None
) -> list[Commit]:
    """Do one stage's work on a group of recordings: read, transform, validate, write; returns the commits to make.

    Nothing that it writes is live before a commit. Of a lake on an object store, files that it reads are received, and
    those that it makes are sent, before it returns; the lake's copy on this machine need not be there. Raises what the
    stage's build function raises.

    Args:
        lake: folder of the lake, or of the copy of one on an object store; or an address, for workers elsewhere.
        stage: name of the stage.
        jobs: recordings, or one job over the whole lake, which is done in a folder.
        settings: settings of the run.
        readable: what jobs on recordings read of the manifest (`narrow_for_jobs`); None for a lake in a folder.
    """
    origin = find_own_origin(lake)
    if not any(job.tail for job in jobs):
        return send_commits(Path(lake), _build(Path(lake), stage, jobs, settings, None))
    readable = readable or narrow_for_jobs(load(Path(lake)), stage, jobs, settings)
    if origin is None:
        return _build(Path(lake), stage, jobs, settings, readable)
    with open_workspace(origin, readable) as root:
        return send_commits(root, _build(root, stage, jobs, settings, readable))


def _build(root: Path, stage: str, jobs: Sequence[Job], settings: Settings, readable: Manifest | None) -> list[Commit]:
    if stage == INGEST:
        return try_again(lambda: [ingest.build(root, job, settings.slice_entries, readable) for job in jobs])
    return try_again(lambda: planner.build_jobs(STAGE_BY_NAME[stage], root, jobs, settings, readable))


def narrow_for_jobs(manifest: Manifest, stage: str, jobs: Sequence[Job], settings: Settings) -> Manifest:
    """Return the part of a manifest that jobs on recordings read; it is small, and fit to be sent to a worker."""
    if stage != INGEST:
        return planner.narrow_manifest(manifest, STAGE_BY_NAME[stage], jobs, settings)
    files = {file.sha256 for job in jobs for file in ingest.list_files(job)}
    known = {sha256: manifest.sources[sha256] for sha256 in files & manifest.sources.keys()}
    return replace(manifest, commits={}, sources=known, retired=(), ingested_from=())


def locate_for_workers(root: Path, settings: Settings) -> str:
    """Return a lake as workers find it: its folder, or for those of an existing cluster the address that it has."""
    origin = find_origin(root)
    is_elsewhere = settings.runner == "dask" and settings.dask_address is not None
    return origin.address if origin is not None and is_elsewhere else str(root)


def make_group_call(lake: str, manifest: Manifest, stage: str, jobs: Sequence[Job], settings: Settings) -> Call:
    """Return the call that builds a group of jobs of the lake that `locate_for_workers` returns.

    It carries what the jobs read of the manifest: reading thousands of commits takes longer than a small job.
    """
    readable = narrow_for_jobs(manifest, stage, jobs, settings) if any(job.tail for job in jobs) else None
    if find_address(lake) is not None:
        settings = settings.model_copy(update={"lake": Path(lake), "cache": None})  # no folder of this machine
    return Call(build_group, (lake, stage, jobs, settings, readable), tuple(job.title for job in jobs))


def find_own_origin(lake: str) -> Origin | None:
    """Return what this machine holds of a lake on an object store; None: it is a whole lake in a folder.

    Settings of this machine say where: the coordinator's name a folder of the coordinator, which it need not have.
    """
    if find_address(lake) is None:
        return find_origin(Path(lake))
    own = Settings()
    return locate_origin(lake, own.cache, own.cache_gb)


def read_file(lake: str, dataset: str, file: dict[str, Any]) -> dict[str, Any]:
    """Read one file that holds several recordings into the staging folder; returns what `ingest.read_file` does."""
    origin = find_own_origin(lake)
    root = Path(lake) if origin is None else origin.copy
    if origin is not None:
        origin.mark(root)
    return try_again(lambda: ingest.read_file(root, dataset, RawFile.from_dict(file)))


def try_again(work: Callable[[], T]) -> T:
    """Do work up to three times, if it fails by what a busy disk or a network share may cause, and by nothing else."""
    for tries in range(1, TRIES):
        try:
            return work()
        except (OSError, FileAccessError) as error:
            cause = error.__cause__ if isinstance(error, FileAccessError) else error
            if not isinstance(cause, OSError) or cause.errno in LASTING:
                raise
            LOG.warning("tried again, as try %d of %d failed: %s", tries, TRIES, error)
            time.sleep(RETRY_DELAY_S)
    return work()
