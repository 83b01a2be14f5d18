"""The errors of a model or a trained run, at 1, 2, ... s, with the number of samples behind each."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from schemas.protocols import Protocol
from training.models import MODELS, Predictor, find_model
from training.runs import load_run, refuse_leak
from training.tensors import Batch, TensorFolder

BATCH_SIZE = 4096
"""Samples predicted at once; the errors do not depend on it."""


@dataclass(frozen=True)
class Horizon:
    """Errors so many seconds ahead, over the samples whose position is known then; null where there is none.

    Args:
        seconds: ahead of the sample.
        n: samples whose position is known then.
        rmse_m: square root of the mean squared distance between predicted and true position.
        rmse_longitudinal_m: the same of the distance along the direction of travel only.
        rmse_lateral_m: the same of the distance across it only.
        mae_m: mean distance.
    """

    seconds: int
    n: int
    rmse_m: float | None
    rmse_longitudinal_m: float | None
    rmse_lateral_m: float | None
    mae_m: float | None


@dataclass(frozen=True)
class Evaluation:
    """How a model does on one part of a split. Every sample counts the same.

    Args:
        model: the run's or model's name.
        part: train, val or eval.
        split: the split's name.
        protocol: its name.
        samples: in the part.
        horizons: by increasing seconds.
    """

    model: str
    part: str
    split: str
    protocol: str
    samples: int
    horizons: tuple[Horizon, ...]

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return asdict(self) | {"horizons": [asdict(horizon) for horizon in self.horizons]}


class EmptyPartError(ValueError):
    """The part asked for has no samples."""


def evaluate(name: str, tensors: Path, models: Path, part: str = "eval") -> Evaluation:
    """Evaluate a trained run, or a model that needs no training.

    Args:
        name: a run's folder in `models`, or the name of a model that does not learn.
        tensors: the tensor folder.
        models: the folder of the runs.
        part: train, val or eval.

    Raises:
        TensorError: the tensors are absent or broken.
        EmptyPartError: the part has no samples.
        ValueError: neither a run nor a model of that name; or the run was trained for another protocol, or on subsets
            that stand in this part now.
        FileNotFoundError: a model that learns, and no run of that name.
        ImportError: torch is needed and missing.
    """
    folder = TensorFolder.open(tensors)
    if name in MODELS and not MODELS[name].learns:  # as it is, whether or not it was written as a run before
        return measure_errors(MODELS[name].build(folder.protocol), folder, part, name=name)
    if (models / name / "config.json").is_file():
        run = load_run(models / name, folder.protocol)
        if part != "train" and find_model(run.config["model"]).learns:
            refuse_leak(run.config, folder, part)
        return measure_errors(run.predictor, folder, part, name=name)
    find_model(name)
    raise FileNotFoundError(f"{models / name}: no trained run; run `tracklake train {name}` first")


def measure_errors(predictor: Predictor, folder: TensorFolder, part: str, *, name: str) -> Evaluation:
    """Predict every sample of a part and sum up the errors.

    Raises:
        EmptyPartError: the part has no samples.
        ValueError: a prediction is not a finite number.
    """
    samples = folder.samples_of(part)
    if len(samples) == 0:
        counts = ", ".join(f"{own} {len(folder.samples_of(own))}" for own in ("train", "val", "eval"))
        raise EmptyPartError(
            f"{folder.path}: the split `{folder.split}` has no samples in `{part}` (samples: {counts}); with a single "
            "subset everything trains, and nothing honest can be evaluated: add recordings and run `tracklake split`"
        )
    batches = folder.batches(part, BATCH_SIZE)
    horizons = _at_seconds(sum_up((predictor.predict(batch), batch) for batch in batches), folder.protocol)
    if any(horizon.n and horizon.rmse_m is None for horizon in horizons):
        raise ValueError(
            f"`{name}` predicts positions that are not finite numbers; train it again with a lower learning rate"
        )
    return Evaluation(
        model=name,
        part=part,
        split=folder.split,
        protocol=folder.protocol.name,
        samples=len(samples),
        horizons=horizons,
    )


@dataclass(frozen=True)
class ErrorSums:
    """Sums over samples, by tick of the future: all (F,)."""

    n: npt.NDArray[np.int64]
    longitudinal2: npt.NDArray[np.float64]
    lateral2: npt.NDArray[np.float64]
    distance: npt.NDArray[np.float64]


def sum_up(predictions: Iterable[tuple[npt.NDArray[np.float32], Batch]]) -> ErrorSums:
    """Sum the errors of predictions (B, F, 2) in m over batches; masked positions count nowhere."""
    n, longitudinal2, lateral2, distance = 0, 0.0, 0.0, 0.0
    for predicted, batch in predictions:
        known = batch.future_mask
        error = np.where(known[..., None], predicted.astype(np.float64) - batch.future, 0.0)
        squares = error**2
        n = n + known.sum(axis=0)
        longitudinal2 = longitudinal2 + squares[..., 0].sum(axis=0)
        lateral2 = lateral2 + squares[..., 1].sum(axis=0)
        distance = distance + np.sqrt(squares.sum(axis=-1)).sum(axis=0)
    return ErrorSums(*(np.asarray(total) for total in (n, longitudinal2, lateral2, distance)))


def _at_seconds(sums: ErrorSums, protocol: Protocol) -> tuple[Horizon, ...]:
    """Errors at whole seconds; a horizon without samples has none."""

    def root(square: np.float64, n: int) -> float | None:
        return float(np.sqrt(square / n)) if n and np.isfinite(square) else None

    rows = []
    for seconds in range(1, int(protocol.horizon_s) + 1):
        tick = seconds * protocol.rate_hz - 1
        n = int(sums.n[tick])
        rows.append(
            Horizon(
                seconds=seconds,
                n=n,
                rmse_m=root(sums.longitudinal2[tick] + sums.lateral2[tick], n),
                rmse_longitudinal_m=root(sums.longitudinal2[tick], n),
                rmse_lateral_m=root(sums.lateral2[tick], n),
                mae_m=float(sums.distance[tick] / n) if n and np.isfinite(sums.distance[tick]) else None,
            )
        )
    return tuple(rows)
