"""Score: the error of the simplest model on the evaluation part, the baseline for all others."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import LakeFile, Manifest
from tracklake.pipeline.lake.files import MODELS, TENSORS
from tracklake.pipeline.lake.transfers import fetch_files
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import Stage, StageResult
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.documents import read_json
from tracklake.schemas.run_config import AGAIN, StaleRunError, read_config
from tracklake.schemas.tensor_index import read_index
from tracklake.schemas.tensors import INDEX_FILE

BASELINE = "constant-velocity"
"""Name of the model that is scored, and of its run."""
HORIZON = ("seconds", "rmse_m", "rmse_longitudinal_m", "n")
"""Figures of a run's metrics at one horizon that the report shows."""


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Evaluate the baseline and write it as a run like any other."""
    from tracklake.training.train import train

    out = reader.root / MODELS / BASELINE
    metrics = train(BASELINE, tensor_folder(reader.root, reader.manifest, settings), out)
    files = [
        LakeFile(file.relative_to(reader.root).as_posix(), None, file.stat().st_size)
        for file in sorted(out.iterdir())
        if file.is_file()
    ]
    notes = [] if metrics["evaluation"] else ["no score: the split's evaluation part has no samples"]
    return StageResult(files={MODELS: files}, notes=notes)


STAGE = Stage(
    name="score",
    meaning="Score the constant-velocity baseline.",
    scope="lake",
    after=(TENSORS,),
    settings=(lambda _settings: {"model": BASELINE},),
    version=2,
    build=build,
)


def list_finished_runs(root: Path) -> list[Path]:
    """Return metrics.json of every run in the lake, sorted by name; an unfinished run is hidden and left out."""
    return sorted(path for path in (root / MODELS).glob("*/metrics.json") if not path.parent.name.startswith("."))


def collect_scores(root: Path, manifest: Manifest, skip: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the scores of runs made from the live tensors, by model: {model, part, rows: [{seconds, rmse_m, n, ...}]}.

    `skip` is called with a message for each run that is damaged or of another version.
    """
    commit = manifest.commits.get(TENSORS)
    if commit is None or commit.info["path"] is None:
        return []
    fetch_files(root, (file for file in commit.all_files if file.path.endswith(f"/{INDEX_FILE}")))
    index = read_index(root / commit.info["path"])
    scores = []
    for path in list_finished_runs(root):
        try:
            config, scored = read_config(path.parent), _read_score(path)
        except (StaleRunError, FileNotFoundError) as stale:
            skip(f"skipped a run: {stale}")
            continue
        if scored is not None and (config["protocol"], config["blocks"]) == (index["protocol"], index["blocks"]):
            scores.append({"model": _name_run(path.parent.name, config), **scored})
    return scores


def _name_run(name: str, config: dict[str, Any]) -> str:
    """Add to a run's name what it was trained and scored on alone, as its errors are of other samples."""
    alone = [str(own) for key in ("dataset", "recording") if (own := config.get("training", {}).get(key))]
    return f"{name} ({' '.join(alone)} alone)" if alone else name


def _read_score(path: Path) -> dict[str, Any] | None:
    """Return part and rows of a run's metrics.json; None where the part had no samples."""
    try:
        evaluation = read_json(path)["evaluation"]
        if evaluation is None:
            return None
        rows = [{name: horizon[name] for name in HORIZON} for horizon in evaluation["horizons"]]
        return {"part": evaluation["part"], "rows": rows}
    except (ValueError, KeyError, TypeError) as broken:
        raise StaleRunError(f"{path}: expected what a training scored, got {broken!r}; {AGAIN}") from None
