"""Scores of a model or a trained run on one part of a split, and the samples and vehicles behind them."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Integers
from tracklake.schemas.comparisons import VEHICLE_ERRORS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.evaluations import EVALUATIONS, EVERYTHING
from tracklake.schemas.origin import DataOrigin, summarise_origins
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.split_recipes import TIME_BLOCKS
from tracklake.training.data.observed import Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.guard import choose_moments, find_scene_samples, refuse_future
from tracklake.training.evaluation.scores import Score, Tally, find_strata
from tracklake.training.models import Predictor, Reads
from tracklake.training.models.fitting import Fit
from tracklake.training.models.inputs import NEAREST, read_samples, truth_of_ego
from tracklake.training.models.prediction import NotFiniteError, Prediction
from tracklake.training.runs.forecasters import open_forecaster

BATCH_SIZE = 256
"""Number of samples predicted at once; the errors do not depend on it. With 2,048, the largest network's values leave
the cache, and it takes nearly twice as long."""

LATENCY_MOMENTS = 20
"""Number of moments that the median time is taken of."""


Observer = Callable[[slice, Prediction, Truth[Any]], None]
"""Function of the batches of an evaluation: which of the part's samples, their prediction, and their truth."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of a model on one part of a split, and the number of the part's samples and vehicles.

    `nearest` is the largest number of vehicles around the ego in the model's input, None where it reads the grid;
    `latency` is empty where it was not measured. `data_origin` is of all subsets of the tensors. `vehicle_sums` has the
    columns of `schemas.comparisons.VEHICLE_ERRORS` but for the first three; `run` is the content of the run's config.
    `fit` says what was fitted before the evaluation.
    """

    model: str
    part: str
    split: str
    protocol: Protocol
    data_origin: DataOrigin
    samples: int
    vehicles: int
    scores: tuple[Score, ...]
    nearest: int | None = None
    latency: Mapping[str, float] = field(default_factory=dict)
    vehicle_sums: pl.DataFrame = field(default_factory=pl.DataFrame, repr=False, compare=False)
    run: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)
    fit: Fit | None = None

    @property
    def horizons(self) -> tuple[Score, ...]:
        """Scores over all samples, each counting the same, by increasing seconds."""
        key = (EVERYTHING, EVERYTHING, "samples")
        return tuple(own for own in self.scores if (own.dataset, own.group, own.average) == key)

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values for JSON; of the scores `horizons` alone, without the keys they share."""
        names = ("model", "part", "split", "protocol", "data_origin", "samples", "vehicles")
        values = {name: getattr(self, name) for name in names}
        shared = {"dataset", "group", "average"}
        rows = [{name: value for name, value in asdict(own).items() if name not in shared} for own in self.horizons]
        fit = {"fit": self.fit.to_dict()} if self.fit else {}
        return values | {"protocol": self.protocol.name, "horizons": rows} | fit

    def to_table(self) -> pl.DataFrame:
        """Convert to rows of `schemas.evaluations.EVALUATIONS`."""
        shared = {name: getattr(self, name) for name in ("split", "part", "model", "nearest", "data_origin")} | {
            "protocol": self.protocol.name,
            "protocol_digest": self.protocol.digest,
            "origin": "measured",
            "reference": "",
        }
        rows = [
            shared | asdict(own) | (dict(self.latency) if own.dataset == own.group == EVERYTHING else {})
            for own in self.scores
        ]
        return pl.DataFrame(rows, schema=EVALUATIONS.dtypes).sort(EVALUATIONS.key)

    def to_vehicle_errors(self) -> pl.DataFrame:
        """Convert to rows of `schemas.comparisons.VEHICLE_ERRORS`."""
        drawn = self.run.get("training", {}).get("seed") if self.run.get("recipe") else None
        named = {"run": self.model, "model": self.run.get("model", self.model), "seed": drawn}
        rows = self.vehicle_sums.with_columns(pl.lit(value).alias(name) for name, value in named.items())
        return VEHICLE_ERRORS.conform(rows.lazy()).sort(VEHICLE_ERRORS.key).collect()


class EmptyPartError(TracklakeError):
    """The part to evaluate has no samples."""


def evaluate(
    name: str,
    tensors: str | Path | TensorFolder,
    models: str | Path,
    part: str = "eval",
    *,
    nearest: int = NEAREST,
    with_latency: bool = False,
    every_tick: bool = False,
    observe: Observer | None = None,
) -> Evaluation:
    """Evaluate a trained run, or a model that is no network.

    `name` is a run's folder in `models`, or a model that is no network; `tensors` their folder, or the folder opened
    (and narrowed, see `TensorFolder.narrow`). `nearest` is the largest number of vehicles around the ego in a scene.
    Scores are of the protocol's seconds, or of every tick of the horizon. `observe` is called with every batch.

    Raises:
        TensorError: the tensors are missing or damaged.
        TracklakeError: see `open_forecaster` and `measure_errors`.
    """
    folder = tensors if isinstance(tensors, TensorFolder) else TensorFolder.open(tensors)
    own = open_forecaster(name, folder, Path(models), frozenset({part}))
    ticks = range(1, folder.protocol.horizon_ticks + 1)
    seconds = [tick / folder.protocol.rate_hz for tick in ticks] if every_tick else None
    found = measure_errors(
        own.predictor, folder, part, name=name, reads=own.reads, nearest=nearest, seconds=seconds, observe=observe
    )
    found = replace(found, run=own.config, fit=own.fit)
    if with_latency:
        latency = measure_latency(own.predictor, folder, part, reads=own.reads, nearest=nearest)
        found = replace(found, latency=latency)
    return found


def measure_errors(
    predictor: Predictor,
    folder: TensorFolder,
    part: str,
    *,
    name: str,
    reads: Reads = "grid",
    nearest: int = NEAREST,
    seconds: Sequence[float] | None = None,
    observe: Observer | None = None,
) -> Evaluation:
    """Predict every sample of a part and sum up the errors, after `refuse_future`.

    `nearest` is the largest number of vehicles around the ego in a scene; `seconds` None stands for the protocol's.

    Raises:
        EmptyPartError: the part has no samples.
        FutureInputError: the model sees what comes after the moment at which it predicts.
        NotFiniteError: a prediction is not a finite number.
        TracklakeError: a prediction is not of the horizon's shape.
    """
    samples = folder.samples_of(part)
    if len(samples) == 0:
        counts = ", ".join(f"{own} {len(folder.samples_of(own))}" for own in ("train", "val", "eval"))
        more = "add recordings" if part != "val" else "set validation_part = true (TRACKLAKE_VALIDATION_PART)"
        if folder.split != TIME_BLOCKS:
            more += f', or set split = "{TIME_BLOCKS}" to divide each recording'
        kept = "" if folder.kept is None else f" of {', '.join(folder.origins)}"
        raise EmptyPartError(
            f"{folder.path}: the split `{folder.split}` has no samples{kept} in `{part}` (samples: {counts}); "
            f"{more}, and run `tracklake run` again"
        )
    refuse_future(predictor, folder, part, name=name, reads=reads, nearest=nearest)
    strata, protocol = find_strata(folder, samples), folder.protocol
    tally = Tally(strata, protocol.horizon_ticks)
    for start in range(0, len(samples), BATCH_SIZE):
        chosen = slice(start, start + BATCH_SIZE)
        observed, truth = read_samples(folder, samples[chosen], reads, nearest=nearest)
        prediction, own_truth = predictor.predict(observed), truth_of_ego(truth)
        tally.add(strata.of_sample[chosen], prediction, own_truth)
        if observe is not None:
            observe(chosen, prediction, own_truth)
    for what, sums in tally.sums.items():
        if not np.isfinite(sums).all():
            raise NotFiniteError(name, "densities" if what == "nll" else "positions")
    subset = folder.run_subset[folder.runs_of(folder.sample_row[samples])]
    tally.drop_lateral(strata.of_sample[folder.lane_centred[subset]])
    at = seconds if seconds is not None else [tick / protocol.rate_hz for tick in protocol.scored_ticks]
    return Evaluation(
        model=name,
        part=part,
        split=folder.split,
        protocol=protocol,
        data_origin=summarise_origins(folder.origins.values()),
        samples=len(samples),
        vehicles=int(strata.vehicle[-1]) + 1,
        scores=tally.score(at, protocol.rate_hz),
        nearest=nearest if reads == "scene" else None,
        vehicle_sums=_list_vehicle_sums(folder, samples, tally, at),
    )


def _list_vehicle_sums(folder: TensorFolder, samples: Integers, tally: Tally, seconds: Sequence[float]) -> pl.DataFrame:
    """List the sums of each vehicle of a part at some horizons that one of its samples reaches."""
    sums = tally.sum_vehicles(seconds, folder.protocol.rate_hz)
    first = np.unique(tally.strata.vehicle[tally.strata.of_sample], return_index=True)[1]
    run = folder.runs_of(folder.sample_row[samples[first]])
    subsets = pl.DataFrame(folder.index["subsets"]).select("dataset", "subset")[folder.run_subset[run]]
    columns = {
        "squared_longitudinal_m2": "longitudinal2",
        "squared_lateral_m2": "lateral2",
        "distance_m": "distance",
        "nll_nats": "nll",
    }
    vehicles = subsets.with_columns(pl.Series("vehicle_id", folder.run_vehicle_id[run]))
    return (
        pl.concat(
            vehicles.with_columns(
                pl.lit(float(ahead)).alias("seconds"),
                pl.Series("n", sums["n"][:, at], dtype=pl.Int64, strict=False),
                *(
                    pl.Series(column, sums[name][:, at])
                    if name in sums
                    else pl.lit(None, dtype=pl.Float64).alias(column)
                    for column, name in columns.items()
                ),
            )
            for at, ahead in enumerate(seconds)
        )
        .fill_nan(None)
        .filter(pl.col("n") > 0)
    )


def measure_latency(
    predictor: Predictor, folder: TensorFolder, part: str, *, reads: Reads = "grid", nearest: int = NEAREST
) -> dict[str, float]:
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
            observed, _ = read_samples(folder, samples, reads, nearest=nearest)
            if number == 0:
                predictor.predict(observed)  # the first call prepares what later ones use
            start = time.perf_counter()
            predictor.predict(observed)
            spent.append(time.perf_counter() - start)
            counts.append(len(samples))
    finally:
        if torch:
            torch.set_num_threads(threads)
    return {"latency_ms": 1000.0 * float(np.median(spent)), "latency_samples": float(np.median(counts))}
