"""Training of a model, and the run that it writes."""

import time
from pathlib import Path
from typing import Any

from tracklake.training.data.observed import FutureInputError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import measure_errors, require_samples
from tracklake.training.loop import DivergedError, Progress, fit_network
from tracklake.training.models import Model, find_model, require_torch
from tracklake.training.models.fitting import fit_model
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.runs.checkpoint import CHECKPOINT_FILE, COLUMNS, claim_folder, read_checkpoint
from tracklake.training.runs.config import TrainConfig, make_plan
from tracklake.training.runs.forecasters import Forecaster
from tracklake.training.runs.run_folder import describe_run, refuse_other_run, refuse_replacement, save_run

__all__ = ["DivergedError", "TrainConfig", "TrainingInterruptedError", "train"]


class TrainingInterruptedError(KeyboardInterrupt):
    """Ctrl-C stopped a training that has a checkpoint to resume from."""


def train(
    model: str,
    tensors: str | Path,
    out: str | Path,
    config: TrainConfig | None = None,
    progress: Progress | None = None,
    *,
    resume: bool | None = None,
    without_evaluation: bool = False,
) -> dict[str, Any]:
    """Train a model on the training part, evaluate it on the evaluation part, write the run and return its metrics.

    The evaluation part is read once, after the last step, and decides nothing; `evaluation` is null where it is empty.

    Args:
        model: name in the registry, or a user's own by `module:Class`; one that is no network is fitted and scored.
        tensors: the tensor folder.
        out: the run's folder, replaced after the training; until then its checkpoint and logs are hidden beside it.
        config: settings; None = the model's recipe or, when resuming, the settings of the checkpoint.
        progress: called after every step.
        resume: True: resume from the checkpoint; False: start over, and replace any run; None: start, unless there is
            a checkpoint, or a run of another model or other settings.
        without_evaluation: whether to train also where the evaluation part has no samples.

    Raises:
        UnfinishedError: `resume` does not fit the checkpoint, or another process is training the run.
        TrainingInterruptedError: Ctrl-C; the message names the checkpoint.
        TracklakeError: the training is not possible, diverged, or saw the future; the message says why.
    """
    entry, folder, out = find_model(model), TensorFolder.open(tensors), Path(out)
    if not entry.learns:
        return _write_baseline(entry, folder, out, config or TrainConfig(), resume=resume)
    require_torch(model)
    with claim_folder(out, resume=resume) as unfinished:
        checkpoint = unfinished / CHECKPOINT_FILE
        stored, started_with = read_checkpoint(checkpoint) if resume else (None, TrainConfig())
        plan = make_plan(entry, folder, config or started_with)
        if not without_evaluation:
            require_samples(plan.folder, "eval", ", or give `--no-evaluation`")
        settings = vars(plan.config) | {"parameters": dict(plan.config.parameters)}
        run = describe_run(model, plan.parameters, settings, plan.folder, plan.recipe)
        if resume is None:
            refuse_replacement(out, run)
        if stored:
            refuse_other_run(checkpoint, stored["run"], run)
        else:
            checkpoint.unlink(missing_ok=True)
        try:
            network, metrics = fit_network(plan, run, unfinished, stored, progress)
            metrics["evaluation"] = _evaluate(Forecaster(out.name, network, entry.reads), plan.folder)
            save_run(out, run, metrics, network.cpu(), [unfinished / log for log in COLUMNS])
            checkpoint.unlink()
        except (DivergedError, NotFiniteError, FutureInputError):
            checkpoint.unlink(missing_ok=True)  # resumed, it would end the same, or it has learned from the future
            raise
        except KeyboardInterrupt:
            if not checkpoint.is_file():
                raise
            raise TrainingInterruptedError(f"interrupted; the checkpoint is {checkpoint}") from None
    return metrics


def _write_baseline(
    entry: Model, folder: TensorFolder, out: Path, config: TrainConfig, *, resume: bool | None
) -> dict[str, Any]:
    """Fit a model that is no network, evaluate it, write it as a run, and return its metrics."""
    folder = folder.narrow(config.dataset, config.recording)
    started, parameters = time.monotonic(), dict(config.parameters)
    metrics: dict[str, Any] = {"model": entry.name, "seconds": 0.0, "steps": 0}
    settings: dict[str, Any] = {}
    if entry.fitted:
        settings = {"dataset": config.dataset, "recording": config.recording, "parameters": parameters}
        if resume is None:
            refuse_replacement(out, describe_run(entry.name, parameters, settings, folder))
        fit = fit_model(entry, folder, folder.samples_of("train"), parameters)
        parameters, metrics["fit"] = dict(fit.parameters), fit.to_dict()
        metrics["seconds"] = round(time.monotonic() - started, 3)
    predictor = entry.build(folder.protocol, **parameters)
    metrics["evaluation"] = _evaluate(Forecaster(out.name, predictor, entry.reads), folder)
    save_run(out, describe_run(entry.name, parameters, settings, folder), metrics, None)
    return metrics


def _evaluate(model: Forecaster, folder: TensorFolder) -> dict[str, Any] | None:
    """Return the scores on the evaluation part; None where the split has no such part."""
    if len(folder.samples_of("eval")) == 0:
        return None
    return measure_errors(model, folder, "eval").to_dict()
