"""Functions that Dask workers run in tests: some die, as a worker does whose memory ran out."""

import logging
import os
import signal
import time
from pathlib import Path
from unittest import mock

import dask

from tracklake.pipeline.lake import files
from tracklake.pipeline.orchestration import batches, dask_workers


def die(*_anything: object) -> None:
    """End this process as the system does."""
    os.kill(os.getpid(), signal.SIGKILL)


def build_or_die(lake: str, stage: str, jobs: list, settings: object, part: object) -> list:
    """Build a group; 02 kills its worker while it writes, at the first try, and 03 at each."""
    (job,) = jobs
    deaths = Path(lake).parent / f"deaths-{job.title}"
    if job.title in ("02", "03") and not (job.title == "02" and deaths.exists()):
        with deaths.open("a") as file:
            file.write("died\n")
        with mock.patch.object(files, "sync", die):  # what was written has no name yet
            batches.build_group(lake, stage, jobs, settings, part)
    return batches.build_group(lake, stage, jobs, settings, part)


def build_until_03(lake: str, stage: str, jobs: list, settings: object, part: object) -> list:
    """Build a group; 03 ends this process, in which the scheduler is as well."""
    if jobs[0].title == "03":
        time.sleep(0.3)  # what was built before has been committed by then
        die()
    return batches.build_group(lake, stage, jobs, settings, part)


def add(first: int, second: int) -> int:
    """Return a sum; what is negative is refused."""
    if first < 0:
        raise ValueError(f"{first} is negative")
    return first + second


def warn(text: str) -> object:
    """Log a warning as tracklake does, and return at which share of its memory this worker pauses."""
    logging.getLogger("tracklake").warning(text)
    return dask.config.get("distributed.worker.memory.pause")


def run_old_release() -> None:
    """Be a worker that was started before tracklake was installed in this version."""
    dask_workers._list_releases = lambda: {"tracklake": "0.0.1"}


def wait(folder: Path, number: int) -> None:
    """Leave a file, and wait."""
    (folder / str(number)).touch()
    time.sleep(0.5)
