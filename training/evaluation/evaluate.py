"""Scores of a model or a trained run on one part of a split, and the samples and vehicles behind them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.evaluations import EVALUATIONS, EVERYTHING
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.guard import refuse_future
from tracklake.training.evaluation.latency import Latency, measure_latency
from tracklake.training.evaluation.scores import Score, Tally, find_strata
from tracklake.training.models import Predictor, Reads
from tracklake.training.models.inputs import NEAREST, read_samples, truth_of_ego
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.runs.forecasters import open_forecaster

BATCH_SIZE = 256
"""Number of samples predicted at once; the errors do not depend on it. With 2,048, the largest network's values leave
the cache, and it takes nearly twice as long."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of a model on one part of a split.

    Args:
        model: name of the run or model.
        part: train, val or eval.
        split: name of the split.
        protocol: protocol of the tensors.
        samples: number of samples in the part.
        vehicles: number of their vehicles.
        scores: scores by dataset, group, average and horizon.
        nearest: largest number of vehicles around the ego in the model's input; None where it reads the grid.
        latency: None where it was not measured.
    """

    model: str
    part: str
    split: str
    protocol: Protocol
    samples: int
    vehicles: int
    scores: tuple[Score, ...]
    nearest: int | None = None
    latency: Latency | None = None

    @property
    def horizons(self) -> tuple[Score, ...]:
        """Scores over all samples, each counting the same, by increasing seconds."""
        return tuple(
            own for own in self.scores if (own.dataset, own.group, own.average) == (EVERYTHING, EVERYTHING, "samples")
        )

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values for JSON; of the scores `horizons` alone, without the keys they share."""
        shared = ("dataset", "group", "average")
        rows = [{name: value for name, value in asdict(own).items() if name not in shared} for own in self.horizons]
        return {
            "model": self.model,
            "part": self.part,
            "split": self.split,
            "protocol": self.protocol.name,
            "samples": self.samples,
            "vehicles": self.vehicles,
            "horizons": rows,
        }

    def to_table(self) -> pl.DataFrame:
        """Convert to rows of `schemas.evaluations.EVALUATIONS`."""
        shared = {
            "protocol": self.protocol.name,
            "protocol_digest": self.protocol.digest,
            "split": self.split,
            "part": self.part,
            "origin": "measured",
            "model": self.model,
            "reference": "",
            "nearest": self.nearest,
        }
        latency = asdict(self.latency) if self.latency is not None else {}
        rows = [
            shared | asdict(own) | (latency if own.dataset == own.group == EVERYTHING else {}) for own in self.scores
        ]
        return EVALUATIONS.empty() if not rows else pl.DataFrame(rows, schema=EVALUATIONS.dtypes).sort(EVALUATIONS.key)


class EmptyPartError(TracklakeError):
    """The part to evaluate has no samples."""


def evaluate(
    name: str,
    tensors: Path,
    models: Path,
    part: str = "eval",
    *,
    nearest: int = NEAREST,
    with_latency: bool = False,
    every_tick: bool = False,
) -> Evaluation:
    """Evaluate a trained run, or a model that needs no training.

    Args:
        name: a run's folder in `models`, or the name of a model that does not learn.
        tensors: the tensor folder.
        models: the folder of the runs.
        part: train, val or eval.
        nearest: largest number of vehicles around the ego in the input of models of scenes.
        with_latency: whether to measure how long a prediction takes.
        every_tick: whether to score every tick of the horizon, not the protocol's seconds alone.

    Raises:
        TensorError: the tensors are missing or damaged.
        EmptyPartError: the part has no samples.
        StaleRunError: the run was trained for another protocol, or on subsets that are in this part now; or it is
            unfinished or damaged.
        UnknownRunError: neither a run nor a model of that name, or a model that learns and has no run.
        FutureInputError: the model sees what comes after the moment at which it predicts.
        MissingExtraError: torch is needed and missing.
    """
    folder = TensorFolder.open(tensors)
    own = open_forecaster(name, folder, models, frozenset({part}))
    ticks, rate_hz = range(1, folder.protocol.horizon_ticks + 1), folder.protocol.rate_hz
    seconds = [tick / rate_hz for tick in ticks] if every_tick else None
    evaluation = measure_errors(
        own.predictor, folder, part, name=name, reads=own.reads, nearest=nearest, seconds=seconds
    )
    if not with_latency:
        return evaluation
    return replace(evaluation, latency=measure_latency(own.predictor, folder, part, reads=own.reads, nearest=nearest))


def measure_errors(
    predictor: Predictor,
    folder: TensorFolder,
    part: str,
    *,
    name: str,
    reads: Reads = "grid",
    nearest: int = NEAREST,
    seconds: Sequence[float] | None = None,
) -> Evaluation:
    """Predict every sample of a part and sum up the errors, after `training.evaluation.guard.refuse_future`.

    Args:
        predictor: model to score.
        folder: tensors of the samples.
        part: train, val or eval.
        name: name of the model.
        reads: input of the model.
        nearest: largest number of vehicles around the ego in a scene.
        seconds: horizons to score, s; None for the protocol's.

    Raises:
        EmptyPartError: the part has no samples.
        FutureInputError: the model sees what comes after the moment at which it predicts.
        NotFiniteError: a prediction is not a finite number.
        TracklakeError: a prediction is not of the horizon's shape.
    """
    samples = folder.samples_of(part)
    if len(samples) == 0:
        counts = ", ".join(f"{own} {len(folder.samples_of(own))}" for own in ("train", "val", "eval"))
        raise EmptyPartError(
            f"{folder.path}: the split `{folder.split}` has no samples in `{part}` (samples: {counts}); with a single "
            "subset everything trains, and nothing is left to evaluate on: add recordings and run `tracklake split`"
        )
    refuse_future(predictor, folder, part, name=name, reads=reads, nearest=nearest)
    strata, protocol = find_strata(folder, samples), folder.protocol
    tally = Tally(strata, protocol.horizon_ticks)
    for start in range(0, len(samples), BATCH_SIZE):
        chosen = slice(start, start + BATCH_SIZE)
        observed, truth = read_samples(folder, samples[chosen], reads, nearest=nearest)
        tally.add(strata.of_sample[chosen], predictor.predict(observed), truth_of_ego(truth))
    for what, sums in tally.sums.items():
        if not np.isfinite(sums).all():
            raise NotFiniteError(name, "densities" if what == "nll" else "positions")
    at = seconds if seconds is not None else [tick / protocol.rate_hz for tick in protocol.scored_ticks]
    return Evaluation(
        model=name,
        part=part,
        split=folder.split,
        protocol=protocol,
        samples=len(samples),
        vehicles=int(strata.vehicle[-1]) + 1,
        scores=tally.score(at, protocol.rate_hz),
        nearest=nearest if reads == "scene" else None,
    )
