"""Scores of models on the evaluation part: errors, likelihood, cells, with intervals over trajectories."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers, Singles
from tracklake.schemas.lane_forest import ALL, STRATA, ManeuverScore
from tracklake.schemas.protocols import V2V
from tracklake.schemas.published_results import CELL_ACCURACY, CELL_ACCURACY_S, CHOI_2021, PUBLISHED
from tracklake.training.evaluation.scores import find_nll
from tracklake.training.lane_changes.cells import OUTSIDE, Codes, number_cells
from tracklake.training.lane_changes.scores import SIZES, score_maneuvers
from tracklake.training.models.prediction import Density
from tracklake.training.onboard.maneuvers import AT, COLUMNS, ManeuverForest, find_cells, fit_forest
from tracklake.training.onboard.models import Forecaster, predict_places
from tracklake.training.onboard.samples import Parts, Samples

RESAMPLES = 1000
"""Number of times that trajectories are drawn, with replacement, for an interval."""
INTERVAL = (2.5, 97.5)
"""Percentiles of the resampled figures between which an interval lies."""


@dataclass(frozen=True)
class OnboardScore:
    """Figures of one model at one horizon, over all samples or one stratum, n samples of so many trajectories.

    `mae_m` is the mean distance from the true place, `cell` the share in the predicted one of nine cells, and
    `cell_with_forest` the same where the forest gives the column. `low` and `high` are 95 % intervals of `mae_m` and
    `cell`, by drawing trajectories. None: there is nothing to measure, or no forest.
    """

    model: str
    stratum: str
    seconds: float
    n: int
    trajectories: int
    mae_m: float | None = None
    mae_m_low: float | None = None
    mae_m_high: float | None = None
    rmse_m: float | None = None
    nll_nats: float | None = None
    cell: float | None = None
    cell_low: float | None = None
    cell_high: float | None = None
    cell_with_forest: float | None = None


def score_model(model: Forecaster, samples: Samples, forest: ManeuverForest | None = None) -> list[OnboardScore]:
    """Score a model at every scored tick, over all samples and each stratum."""
    place_m = predict_places(model.name, model.predict, samples)
    figures = measure_samples(model, samples, place_m)
    true, own = find_cells(samples, samples.place_m), find_cells(samples, place_m)
    figures["cell"] = _find_right(own, true)
    if forest is not None:
        columns = COLUMNS[forest.decide(samples)[:, 1:]]
        figures["cell_with_forest"] = _find_right(np.stack([columns, own[..., 1]], axis=-1), true)
    return list(_summarise(model.name, samples, figures))


def measure_samples(model: Forecaster, samples: Samples, place_m: Singles) -> dict[str, Floats]:
    """Measure distance, its square and NLL of places (B, F, 2) at the scored ticks, (B, T) each."""
    error = place_m[:, AT].astype(np.float64) - samples.place_m[:, AT]
    squared = (error**2).sum(axis=-1)
    mean = place_m[:, None, AT]
    sigma = np.broadcast_to(model.sigma_m[AT], mean.shape).astype(np.float32)
    weight, correlation = np.ones((len(mean), 1), np.float32), np.zeros(mean.shape[:-1], np.float32)
    nll = find_nll(Density(weight, mean, sigma, correlation), samples.place_m[:, AT])
    return {"mae_m": np.sqrt(squared), "rmse_m": squared, "nll_nats": nll}


def _find_right(own: Codes, true: Codes) -> Floats:
    """Find samples (B, T) in the predicted cell; a true place outside the nine is never right."""
    right: Floats = ((own == true) & (np.abs(true) < OUTSIDE)).all(axis=-1).astype(np.float64)
    return right


def _summarise(model: str, samples: Samples, figures: Mapping[str, Floats]) -> Iterator[OnboardScore]:
    trajectory = samples.trajectory
    for stratum, of in group_samples(samples).items():
        present = np.unique(trajectory[of], return_inverse=True)[1]
        bounds = {name: bootstrap_mean(figures[name][of], present) for name in ("mae_m", "cell")}
        for at, seconds in enumerate(V2V.scored_s):
            if not of.any():
                yield OnboardScore(model, stratum, seconds, 0, 0)
                continue
            means = {name: float(values[of, at].mean()) for name, values in figures.items()}
            means["rmse_m"] **= 0.5
            for name, (low, high) in bounds.items():
                means |= {f"{name}_low": float(low[at]), f"{name}_high": float(high[at])}
            yield OnboardScore(model, stratum, seconds, int(of.sum()), int(present.max()) + 1, **means)


def bootstrap_mean(values: Floats, trajectory: Integers) -> tuple[Floats, Floats]:
    """Estimate the 95 % interval of means over samples (B, T) by drawing trajectories (B,), numbered from 0: (T,) each.

    Source: Efron and Tibshirani 1993, An Introduction to the Bootstrap; clusters are drawn, as samples of a trajectory
    depend on each other.
    """
    if not len(values):
        return np.empty(0), np.empty(0)
    number = int(trajectory.max()) + 1
    sums = np.zeros((number, values.shape[1]))
    np.add.at(sums, trajectory, values)
    count = np.bincount(trajectory, minlength=number)
    drawn = np.random.default_rng(0).multinomial(number, np.full(number, 1 / number), size=RESAMPLES)
    means = (drawn @ sums) / (drawn @ count)[:, None]
    low, high = np.percentile(means, INTERVAL, axis=0)
    return low, high


def count_confusion(model: Forecaster, samples: Samples) -> Integers:
    """Count samples by scored tick, true and predicted cell, from 0 to 8 as in `cells`, 9 outside: (T, 10, 10)."""
    places = (samples.place_m, predict_places(model.name, model.predict, samples))
    codes = [number_cells(own[..., 0], own[..., 1]) for own in (find_cells(samples, place_m) for place_m in places)]
    true, own = (np.where(code < 0, 9, code.astype(np.int64)) for code in codes)
    counts: Integers = np.zeros((len(AT), 10, 10), dtype=np.int64)
    np.add.at(counts, (np.arange(len(AT)), true, own), 1)
    return counts


def score_forest(forest: ManeuverForest, samples: Samples) -> list[ManeuverScore]:
    """Score the maneuvers by majority, over all samples and each stratum."""
    decided = forest.decide(samples)[:, 0]
    return [score_maneuvers(name, decided[of], samples.maneuver[of]) for name, of in group_samples(samples).items()]


def group_samples(samples: Samples) -> dict[str, Flags]:
    """Find the samples of each stratum, (B,) each; those of ALL come first."""
    everything = {ALL: np.ones(len(samples), dtype=np.bool_)}
    return everything | {name: samples.stratum == number for number, name in enumerate(STRATA)}


@dataclass(frozen=True)
class OnboardLearningPoint:
    """Share of right maneuvers on both parts by a forest that was fitted on `drawn` examples, before augmentation."""

    drawn: int
    train_accuracy: float
    train_n: int
    eval_accuracy: float
    eval_n: int


def learn_curve(
    parts: Parts, seed: int, sizes: Sequence[int] = SIZES, *, maneuver_alone: bool = False
) -> list[OnboardLearningPoint]:
    """Fit forests on growing draws from the training part, and score each on both parts; see `fit_forest`."""
    points = []
    for size in sorted({min(size, len(parts.train)) for size in sizes}):
        forest = fit_forest(parts.train, seed, size, maneuver_alone=maneuver_alone)
        scored = [score_forest(forest, part)[0] for part in (parts.train, parts.eval)]
        (train, train_n), (eval_, eval_n) = ((own.accuracy or 0.0, own.n) for own in scored)
        points.append(OnboardLearningPoint(forest.examples, train, train_n, eval_, eval_n))
    return points


def list_published() -> list[OnboardScore]:
    """List the published errors and cell accuracies, which are of the authors' own recordings; n is not stated: 0."""
    errors = {
        line.model: dict(zip(line.seconds, line.figures["mae_m"], strict=True))
        for line in PUBLISHED
        if line.reference == CHOI_2021
    }
    rows = []
    for model, by_seconds in errors.items():
        shares = dict(zip(CELL_ACCURACY_S, CELL_ACCURACY.get(model, ()), strict=False))
        with_forest = dict(zip(CELL_ACCURACY_S, CELL_ACCURACY.get(f"{model} + forest", ()), strict=False))
        for seconds, mae_m in by_seconds.items():
            rows.append(
                OnboardScore(
                    model,
                    ALL,
                    seconds,
                    0,
                    0,
                    mae_m=mae_m,
                    cell=shares.get(seconds),
                    cell_with_forest=with_forest.get(seconds),
                )
            )
    return rows
