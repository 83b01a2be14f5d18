"""Score: the error of the simplest model on the evaluation part, the first number for others to stand beside."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load
from tracklake.pipeline.lake.files import MODELS, TENSORS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import tensors
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, upstream
from tracklake.pipeline.stages.tensors import tensor_folder

VERSION = 2
BASELINE = "constant-velocity"


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job where there are tensors."""
    made = upstream(tensors.plan, root, manifest, settings)
    if not made or manifest.commits[TENSORS].info["path"] is None:
        return []
    made_of = {**made, "model": BASELINE}
    return [make_job("score", version_of_stage=VERSION, made_of=made_of, inputs={})]


def build(root: Path, job: Job, settings: Settings) -> Commit:
    """Evaluate the baseline and write it as a run like any other."""
    from tracklake.training.train import train

    out = root / MODELS / BASELINE
    metrics = train(BASELINE, tensor_folder(root, load(root), settings), out)
    files = [
        LakeFile(file.relative_to(root).as_posix(), None, file.stat().st_size)
        for file in sorted(out.iterdir())
        if file.is_file()
    ]
    unscored = [] if metrics["evaluation"] else ["no score: the split's evaluation part has no samples"]
    return make_commit(job, {MODELS: files}, {"notes": unscored})


def finished_runs(root: Path) -> list[Path]:
    """metrics.json of every run in the lake, sorted by name; what a killed training left is hidden and none."""
    return sorted(path for path in (root / MODELS).glob("*/metrics.json") if not path.parent.name.startswith("."))


def collect_scores(root: Path, manifest: Manifest, pass_by: Callable[[str], None]) -> list[dict[str, Any]]:
    """What the runs in the lake scored, of those that were made from the tensors that are live now.

    Args:
        root: the lake.
        manifest: its live files.
        pass_by: told of each run that is damaged or of another version: which, and why.

    Returns:
        {model, part, rows: [{seconds, rmse_m, n}]}, sorted by model.
    """
    from tracklake.training.runs.run_folder import StaleRunError, read_config

    if TENSORS not in manifest.commits or manifest.commits[TENSORS].info["path"] is None:
        return []
    index = json.loads((root / manifest.commits[TENSORS].info["path"] / "index.json").read_text(encoding="utf-8"))
    scores = []
    for path in finished_runs(root):
        try:
            config, scored = read_config(path.parent), _read_score(path)
        except (StaleRunError, FileNotFoundError) as stale:
            pass_by(f"skipped a run: {stale}")
            continue
        if scored is not None and (config["protocol"], config["blocks"]) == (index["protocol"], index["blocks"]):
            scores.append({"model": path.parent.name, **scored})
    return scores


def _read_score(path: Path) -> dict[str, Any] | None:
    """Part and rows of a run's metrics.json; None where the part had no samples.

    Raises:
        StaleRunError: the file is damaged.
    """
    from tracklake.training.runs.run_folder import AGAIN, StaleRunError

    try:
        evaluation = json.loads(path.read_text(encoding="utf-8"))["evaluation"]
        if evaluation is None:
            return None
        rows = [{name: horizon[name] for name in ("seconds", "rmse_m", "n")} for horizon in evaluation["horizons"]]
        return {"part": evaluation["part"], "rows": rows}
    except (ValueError, KeyError, TypeError) as broken:
        raise StaleRunError(f"{path}: expected what a training scored, got {broken!r}; {AGAIN}") from None
