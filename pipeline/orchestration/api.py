"""The pipeline as a Python function."""

import warnings
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import LakeError, load, refuse_foreign, refuse_if_busy
from tracklake.pipeline.lake.transfers import fetch_files
from tracklake.pipeline.lake.working_copy import hold_copy, list_report, locate_origin
from tracklake.pipeline.orchestration.prefect_home import import_flows
from tracklake.pipeline.orchestration.run_plan import (
    ALL_STEPS,
    RunRequest,
    RunResult,
    conclude_idle,
    plan_run,
    survey_source,
)
from tracklake.pipeline.settings import Settings, find_unknown_variables
from tracklake.pipeline.sources import SourceError


def run(
    source: str | Path,
    *,
    lake: str | Path = "lake",
    dataset: str | None = None,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
    **settings: Any,  # noqa: ANN401  (settings are of several types)
) -> RunResult:
    """Run the whole pipeline, from raw files to report and tensors, as `tracklake run SOURCE` does.

    Args:
        source: a raw file, or a folder of them.
        lake: folder of the lake, which is created if missing, or its address on an object store.
        dataset: read the source as this dataset only (ngsim, highd, custom or v2v); None: detect it.
        replace: whether files of the source may replace other files of the same recording.
        prune: whether to remove recordings whose files once stood in the source and are missing now.
        rebuild: whether to make the lake again from the raw files.
        settings: settings by name, see docs/settings.md; they override tracklake.toml and the environment.

    Returns:
        What was built, refused, skipped and removed, and notes.

    Raises:
        SourceError: nothing in the source can be used.
        LakeError: the lake is damaged, of another version, or another process writes to it; or a stage failed.
        SettingError: a setting is unknown or out of its bounds.
    """
    chosen = Settings(lake=Path(lake), **settings)
    for message in find_unknown_variables():
        warnings.warn(message, stacklevel=2)
    origin = locate_origin(lake, chosen.cache, chosen.cache_gb)
    if origin is None:
        result = _run_in_folder(chosen, source, dataset, replace, prune, rebuild)
    else:
        with hold_copy(origin, is_rebuild=rebuild) as folder:
            in_copy = chosen.model_copy(update={"lake": folder})
            result = _run_in_folder(in_copy, source, dataset, replace, prune, rebuild)
            fetch_files(folder, list_report(load(folder)))
    if result.failed:
        raise LakeError("\n".join(result.failed))
    return result


def _run_in_folder(
    settings: Settings, source: str | Path, dataset: str | None, replace: bool, prune: bool, rebuild: bool
) -> RunResult:
    """Run the whole pipeline on a lake in a folder."""
    plain = settings.model_dump(mode="json", exclude_unset=True)
    place, where = str(settings.lake.absolute()), str(Path(source).absolute())
    request = RunRequest(place, ALL_STEPS, where, dataset, plain, replace, prune, rebuild)
    request.check()
    refuse_foreign(request.root, rebuild=rebuild)
    discovery = survey_source(request)
    if not discovery.units:
        raise SourceError("\n".join(discovery.refusals) or f"{source}: no raw files")
    plan = plan_run(request, discovery)
    if plan.is_idle:
        return conclude_idle(request, plan)
    refuse_if_busy(request.root, rebuild=rebuild)
    result: RunResult = import_flows().execute(request, plan)
    return result
