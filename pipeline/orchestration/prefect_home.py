"""The folder in which Prefect keeps its own state, looked at before Prefect is imported."""

import os
import tempfile
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

from tracklake.schemas.errors import MORE_FILES, TracklakeError
from tracklake.schemas.extras import require_extras

TRIAL_BYTES = 1 << 20
"""Bytes that a disk must still take for Prefect to record a run on it."""
FEWEST_FILES, MANY_FILES = 128, 4096
"""Open files without which a run is not begun, and to which the limit is raised where the system allows it."""


def import_flows() -> ModuleType:
    """Import the flows, and with them Prefect, which takes seconds: only where there is work to do.

    Prefect reads its variables, and makes its home, when it is imported.

    Raises:
        MissingExtraError: Prefect is not installed.
        TracklakeError: this process may open too few files at once; the embedded server would wait for ever.
    """
    require_extras("the pipeline", "flows")
    _provide_descriptors()
    os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")  # it locks the embedded server's database
    os.environ.setdefault("DO_NOT_TRACK", "1")
    if find_home_fault() is not None:
        os.environ["PREFECT_HOME"] = str(make_temporary_folder())
    return import_module("tracklake.pipeline.orchestration.flows")


def _provide_descriptors() -> None:
    """Raise the limit of open files as far as this process may; Windows has no such limit."""
    try:
        import resource
    except ImportError:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MANY_FILES if hard == resource.RLIM_INFINITY else min(hard, MANY_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    if wanted < FEWEST_FILES:
        raise TracklakeError(
            f"this process may open {wanted} files at once; expected {FEWEST_FILES} or more. {MORE_FILES}"
        )


@cache
def find_home_fault() -> str | None:
    """Return why nothing can be written to Prefect's home; None where it can."""
    try:
        home = Path(os.environ.get("PREFECT_HOME") or "~/.prefect").expanduser()
        home.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=home) as trial:
            trial.write(bytes(TRIAL_BYTES))
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder is known
        return f"PREFECT_HOME: {error}"
    return None


def make_temporary_folder() -> Path:
    """Return the folder that stands in for Prefect's own until this process ends."""
    return Path(_make_temporary().name)


@cache
def _make_temporary() -> "tempfile.TemporaryDirectory[str]":
    try:
        return tempfile.TemporaryDirectory(prefix="tracklake-prefect-", ignore_cleanup_errors=True)
    except OSError as error:
        raise TracklakeError(
            f"no temporary folder can be made for Prefect ({error.strerror or error}). Free space, or set TMPDIR to a "
            "folder that can be written to."
        ) from error
