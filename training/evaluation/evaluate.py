"""Scores of a model or a trained run on one part of a split, and the samples and vehicles behind them."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Integers
from tracklake.schemas.columns import PARTS
from tracklake.schemas.comparisons import VEHICLE_ERRORS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.evaluations import EVALUATIONS, EVERYTHING
from tracklake.schemas.origin import DataOrigin, summarise_origins
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.split_recipes import TIME_BLOCKS
from tracklake.training.data.gathers import NEAREST, read_samples
from tracklake.training.data.observed import Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.guard import choose_moments, find_scene_samples, refuse_future
from tracklake.training.evaluation.scores import Tally, find_strata
from tracklake.training.models.fitting import Fit
from tracklake.training.models.prediction import NotFiniteError, Prediction
from tracklake.training.runs.forecasters import Forecaster

LATENCY_MOMENTS = 20
"""Number of moments that the median time is taken of."""


Observer = Callable[[slice, Prediction, Truth[Any]], None]
"""Function of the batches of an evaluation: which of the part's samples, their prediction, and their truth."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of a model on one part of a split, and the number of the part's samples and vehicles.

    `scores` are rows of `evaluation.scores.SCORES`. `nearest` is the largest number of vehicles around the ego in the
    model's input, None where it reads the grid; `latency` is empty where it was not measured. `data_origin` is of all
    subsets of the tensors. `vehicle_sums` has the columns of `schemas.comparisons.VEHICLE_ERRORS` but for the first
    three; `run` is the content of the run's config. `fit` says what was fitted before the evaluation.
    """

    model: str
    part: str
    split: str
    protocol: Protocol
    data_origin: DataOrigin
    samples: int
    vehicles: int
    scores: pl.DataFrame = field(repr=False, compare=False)
    nearest: int | None = None
    latency: Mapping[str, float] = field(default_factory=dict)
    vehicle_sums: pl.DataFrame = field(default_factory=pl.DataFrame, repr=False, compare=False)
    run: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    fit: Fit | None = None

    @property
    def horizons(self) -> pl.DataFrame:
        """Scores over all samples, each counting the same, by increasing seconds, without the keys they share."""
        own = self.scores.filter(dataset=EVERYTHING, group=EVERYTHING, average="samples")
        return own.drop("dataset", "group", "average")

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values for JSON; of the scores `horizons` alone."""
        names = ("model", "part", "split", "protocol", "data_origin", "samples", "vehicles")
        values = {name: getattr(self, name) for name in names}
        fit = {"fit": self.fit.to_dict()} if self.fit else {}
        return values | {"protocol": self.protocol.name, "horizons": self.horizons.to_dicts()} | fit

    def to_table(self) -> pl.DataFrame:
        """Convert to rows of `schemas.evaluations.EVALUATIONS`."""
        shared = {name: getattr(self, name) for name in ("split", "part", "model", "nearest", "data_origin")} | {
            "protocol": self.protocol.name,
            "protocol_digest": self.protocol.digest,
            "origin": "measured",
            "reference": "",
        }
        everything = pl.all_horizontal(pl.col("dataset", "group") == EVERYTHING)
        timed = {name: pl.when(everything).then(self.latency.get(name)) for name in ("latency_ms", "latency_samples")}
        rows = self.scores.with_columns(**{name: pl.lit(value) for name, value in shared.items()}, **timed)
        return EVALUATIONS.conform(rows.lazy()).sort(EVALUATIONS.key).collect()

    def to_vehicle_errors(self) -> pl.DataFrame:
        """Convert to rows of `schemas.comparisons.VEHICLE_ERRORS`."""
        drawn = self.run.get("training", {}).get("seed") if self.run.get("recipe") else None
        named = {"run": self.model, "model": self.run.get("model", self.model), "seed": drawn}
        rows = self.vehicle_sums.with_columns(pl.lit(value).alias(name) for name, value in named.items())
        return VEHICLE_ERRORS.conform(rows.lazy()).sort(VEHICLE_ERRORS.key).collect()


class EmptyPartError(TracklakeError):
    """The part to evaluate has no samples."""


def measure_errors(
    model: Forecaster,
    folder: TensorFolder,
    part: str,
    *,
    nearest: int = NEAREST,
    seconds: Sequence[float] | None = None,
    with_latency: bool = False,
    observe: Observer | None = None,
) -> Evaluation:
    """Predict every sample of a part and sum up the errors, after `refuse_future`.

    `nearest` is the largest number of vehicles around the ego in a scene; `seconds` None stands for the protocol's.
    `observe` is called with every batch.

    Raises:
        EmptyPartError: the part has no samples.
        FutureInputError: the model sees what comes after the moment at which it predicts.
        NotFiniteError: a prediction is not a finite number.
        TracklakeError: a prediction is not of the horizon's shape.
    """
    samples = require_samples(folder, part)
    refuse_future(model, folder, part, nearest=nearest)
    strata, protocol = find_strata(folder, samples), folder.protocol
    tally = Tally(strata, protocol.horizon_ticks)
    for chosen, prediction, truth in model.predict(folder, samples, nearest=nearest):
        tally.add(strata.of_sample[chosen], prediction, truth)
        if observe is not None:
            observe(chosen, prediction, truth)
    for what, sums in tally.sums.items():
        if not np.isfinite(sums).all():
            raise NotFiniteError(model.name, "densities" if what == "nll_nats" else "positions")
    subset = folder.run_subset[folder.runs_of(folder.sample_row[samples])]
    tally.drop_lateral(strata.of_sample[folder.lane_centred[subset]])
    at = seconds if seconds is not None else [tick / protocol.rate_hz for tick in protocol.scored_ticks]
    return Evaluation(
        model=model.name,
        part=part,
        split=folder.split,
        protocol=protocol,
        data_origin=summarise_origins(folder.origins.values()),
        samples=len(samples),
        vehicles=int(strata.vehicle[-1]) + 1,
        scores=tally.score(at, protocol.rate_hz),
        nearest=nearest if model.reads == "scene" else None,
        latency=measure_latency(model, folder, part, nearest) if with_latency else {},
        vehicle_sums=_list_vehicle_sums(folder, samples, tally, at),
        run=model.config,
        fit=model.fit,
    )


def require_samples(folder: TensorFolder, part: str, otherwise: str = "") -> Integers:
    """Return the numbers of a part's samples; raises EmptyPartError, with the counts and what to do, without any."""
    samples = folder.samples_of(part)
    if len(samples) == 0:
        counts = ", ".join(f"{own} {len(folder.samples_of(own))}" for own in PARTS)
        more = "add recordings" if part != "val" else "set validation_part = true (TRACKLAKE_VALIDATION_PART)"
        blocks = f'split = "{TIME_BLOCKS}" to divide each recording'
        more += f", or set {'a shorter `split_block_s`' if folder.split == TIME_BLOCKS else blocks}"
        kept = "" if folder.kept is None else f" of {', '.join(folder.origins)}"
        raise EmptyPartError(
            f"{folder.path}: the split `{folder.split}` has no samples{kept} in `{part}` (samples: {counts}); "
            f"{more}, and run `tracklake run` again{otherwise}"
        )
    return samples


def _list_vehicle_sums(folder: TensorFolder, samples: Integers, tally: Tally, seconds: Sequence[float]) -> pl.DataFrame:
    """List the sums of each vehicle of a part at some horizons that one of its samples reaches."""
    sums = tally.sum_vehicles(seconds, folder.protocol.rate_hz)
    first = np.unique(tally.strata.vehicle[tally.strata.of_sample], return_index=True)[1]
    run = folder.runs_of(folder.sample_row[samples[first]])
    subsets = pl.DataFrame(folder.index["subsets"]).select("dataset", "subset")[folder.run_subset[run]]
    vehicles = subsets.with_columns(pl.Series("vehicle_id", folder.run_vehicle_id[run]))
    known = {name: own for name, own in sums.items() if name in VEHICLE_ERRORS.columns}
    rows = (
        vehicles.with_columns(seconds=float(ahead), **{name: pl.Series(own[:, at]) for name, own in known.items()})
        for at, ahead in enumerate(seconds)
    )
    empty = VEHICLE_ERRORS.empty().drop("run", "model", "seed")
    return pl.concat([empty, *rows], how="diagonal_relaxed").fill_nan(None).filter(pl.col("n") > 0)


def measure_latency(model: Forecaster, folder: TensorFolder, part: str, nearest: int) -> dict[str, float]:
    """Measure the median time to predict all samples of a moment on one thread, in ms, and the median number of them.

    The moments are evenly spread over the part, which has samples; the time to read them is left out.
    """
    spent, counts = [], []
    torch = sys.modules.get("torch")  # None: not in use
    threads = torch.get_num_threads() if torch else 1
    try:
        if torch:
            torch.set_num_threads(1)
        for number, scene in enumerate(choose_moments(folder, part, LATENCY_MOMENTS)):
            samples = find_scene_samples(folder, scene)
            observed, _ = read_samples(folder, samples, model.reads, nearest=nearest)
            if number == 0:
                model.predictor.predict(observed)  # the first call prepares what later ones use
            start = time.perf_counter()
            model.predictor.predict(observed)
            spent.append(time.perf_counter() - start)
            counts.append(len(samples))
    finally:
        if torch:
            torch.set_num_threads(threads)
    return {"latency_ms": 1000.0 * float(np.median(spent)), "latency_samples": float(np.median(counts))}
