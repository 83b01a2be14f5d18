"""The work that a thread or a worker does, with nothing of Prefect and Dask: records in, records out."""

import errno
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import Commit
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources import RawFile
from tracklake.pipeline.stages.planner import build_jobs
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.schemas.errors import FileAccessError

T = TypeVar("T")

LASTING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EROFS, errno.EACCES, errno.EPERM)
"""Errors of the operating system that a second try does not cure: full disks, limits, missing rights."""
TRIES = 3
"""Times that input and output are tried."""
RETRY_DELAY_S = 1.0
"""Time between two tries, in seconds."""
LOG = logging.getLogger("tracklake")


def build_group(lake: str, stage: str, jobs: Sequence[Job], settings: Settings) -> list[Commit]:
    """Do one stage's work on a group of recordings: read, transform, validate, write; returns the commits to make.

    Nothing that it writes is live before a commit. Raises what the stage's build function raises.
    """
    root = Path(lake)
    if stage == INGEST:
        return try_again(lambda: [ingest.build(root, job) for job in jobs])
    return try_again(lambda: build_jobs(STAGE_BY_NAME[stage], root, jobs, settings))


def read_file(lake: str, dataset: str, file: dict[str, Any]) -> dict[str, Any]:
    """Read one file that holds several recordings into the staging folder; returns what `ingest.read_file` does."""
    return try_again(lambda: ingest.read_file(Path(lake), dataset, RawFile.from_dict(file)))


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
