"""Errors and NLL summed over batches, and the figures made of the sums: by vehicle, maneuver and finding, and overall.

Samples are summed by stratum: those of one vehicle with the same maneuvers and equally severe findings. Every group is
a union of strata, so that one pass over the samples serves all of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Flags, Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.comparisons import COMPARED_FIGURES
from tracklake.schemas.errors import UsageError
from tracklake.schemas.evaluations import AVERAGES, EVALUATIONS, EVERYTHING, FIGURES, FINDING_GROUPS
from tracklake.training.data.observed import Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.prediction import Density, Prediction

SCORES = {
    name: EVALUATIONS.dtypes[name] for name in ("dataset", "group", "average", "seconds", "n", "vehicles", *FIGURES)
}
"""Columns of scores, as `schemas.evaluations` defines them; figures are null where there is nothing to measure."""


@dataclass(frozen=True)
class Strata:
    """Strata of a part, (P,) each but for `of_sample` (S_part,), the stratum of each of its samples in their order.

    Vehicles never fall; maneuvers are true ones, by LATERAL_MANEUVERS and LONGITUDINAL_MANEUVERS; `dataset` is the
    position in `datasets`, sorted; `findings` counts the severities of FINDING_GROUPS that the worst finding reaches.
    """

    of_sample: Integers
    vehicle: Integers
    dataset: Integers
    lateral: Integers
    longitudinal: Integers
    findings: Integers
    datasets: tuple[str, ...]

    def __len__(self) -> int:
        """Return the number of different strata."""
        return len(self.vehicle)

    def list_groups(self) -> Iterator[tuple[str, str, Flags]]:
        """List datasets and groups, with the strata (P,) in both."""
        groups = {EVERYTHING: np.ones(len(self), dtype=np.bool_)}
        for kind, code, names in (
            ("lateral", self.lateral, LATERAL_MANEUVERS),
            ("longitudinal", self.longitudinal, LONGITUDINAL_MANEUVERS),
        ):
            groups |= {f"{kind}={name}": code == number for number, name in enumerate(names)}
        for below, (found, others) in enumerate(FINDING_GROUPS.values()):
            groups |= {found: self.findings > below, others: self.findings <= below}
        for number, dataset in enumerate((EVERYTHING, *self.datasets), start=-1):
            within = groups[EVERYTHING] if number < 0 else self.dataset == number
            for group, members in groups.items():
                yield dataset, group, members & within


def find_strata(folder: TensorFolder, samples: Integers) -> Strata:
    """Group samples (S_part,) by vehicle, maneuvers and findings; a vehicle in several runs counts once."""
    subset, vehicle = find_vehicles(folder, samples)
    findings = np.sum([folder.mark_flagged(samples, severity) for severity in FINDING_GROUPS], axis=0)
    keys = (vehicle, folder.sample_lateral[samples], folder.sample_longitudinal[samples], findings)
    counts = (1 + len(samples), len(LATERAL_MANEUVERS), len(LONGITUDINAL_MANEUVERS), 1 + len(FINDING_GROUPS))
    _, first, of_sample = np.unique(np.ravel_multi_index(keys, counts), return_index=True, return_inverse=True)
    names = np.array([str(named["dataset"]) for named in folder.index["subsets"]])
    datasets, dataset = np.unique(names[subset[first]], return_inverse=True)
    vehicle, lateral, longitudinal, findings = (key[first].astype(np.int64) for key in keys)
    return Strata(of_sample, vehicle, dataset, lateral, longitudinal, findings, tuple(datasets.tolist()))


def find_vehicles(folder: TensorFolder, samples: Integers) -> tuple[Integers, Integers]:
    """Find the subset of each sample and its vehicle, counted from 0: (S_part,) each."""
    run = folder.runs_of(folder.sample_row[samples])
    subset = folder.run_subset[run].astype(np.int64)
    return subset, np.unique((subset << 32) | folder.run_vehicle_id[run], return_inverse=True)[1]


def find_nll(density: Density, future: Singles) -> Floats:
    """Compute -ln p of true places (B, F, 2), m, in nats, p in 1/m2: (B, F); not finite where a sigma is 0.

    A mixture's density is the weighted sum of its alternatives' densities, summed in logarithms, so that a place far
    out gives a large number and not infinity.

    Source: the density of the bivariate normal distribution; Bishop 1994, Mixture density networks, for the mixture.
    """
    sigma = density.sigma_m.astype(np.float64)
    correlation = density.correlation.astype(np.float64)
    with np.errstate(all="ignore"):  # no density gives NaN or infinity, which the scores refuse
        away = (future[:, None].astype(np.float64) - density.mean_m) / sigma
        along, across = away[..., 0], away[..., 1]
        rest = (1.0 - correlation) * (1.0 + correlation)
        squared = (along**2 - 2.0 * correlation * along * across + across**2) / rest
        log_normal = -0.5 * squared - np.log(2.0 * np.pi * sigma[..., 0] * sigma[..., 1]) - 0.5 * np.log(rest)
        weighted = log_normal + np.log(density.weight.astype(np.float64))[:, :, None]
        highest = weighted.max(axis=1)
        nll: Floats = -highest - np.log(np.exp(weighted - highest[:, None]).sum(axis=1))
    return nll


def measure_samples(prediction: Prediction, truth: Truth[Any]) -> dict[str, Floats]:
    """Compute the summands of each sample and tick, (B, F) each; 0 where the position is not known."""
    known = truth.future_mask
    error = np.where(known[..., None], prediction.position_m.astype(np.float64) - truth.future, 0.0)
    squares = error**2
    distance = np.sqrt(squares.sum(axis=-1))
    ticks = np.arange(1, distance.shape[1] + 1)
    sums = {
        "n": known.astype(np.float64),
        "squared_longitudinal_m2": squares[..., 0],
        "squared_lateral_m2": squares[..., 1],
        "longitudinal": np.abs(error[..., 0]),
        "lateral": np.abs(error[..., 1]),
        "distance_m": distance,
        "average_distance": np.where(known, distance.cumsum(axis=1) / ticks, 0.0),
    }
    if prediction.density is not None:
        sums["nll_nats"] = np.where(known, find_nll(prediction.density, truth.future), 0.0)
    for name in ("lateral", "longitudinal"):
        probability = getattr(prediction, name)
        if probability is not None:
            right = probability.argmax(axis=1) == getattr(truth, name)
            sums[f"{name}_right"] = known * right[:, None].astype(np.float64)
    return sums


class Tally:
    """Sums of `measure_samples` by stratum and tick, (P, F) each."""

    def __init__(self, strata: Strata, ticks: int) -> None:
        self.strata, self._shape = strata, (len(strata), ticks)
        self.sums: dict[str, Floats] = {}

    def add(self, stratum: Integers, prediction: Prediction, truth: Truth[Any]) -> None:
        """Add B samples, each to its stratum (B,)."""
        if len(stratum) == 0:
            return
        order = np.argsort(stratum, kind="stable")
        present, first = np.unique(stratum[order], return_index=True)
        for name, values in measure_samples(prediction, truth).items():
            total = self.sums.setdefault(name, np.zeros(self._shape))
            total[present] += np.add.reduceat(values[order], first, axis=0)

    def drop_lateral(self, stratum: Integers) -> None:
        """Make the sums that depend on lateral positions NaN in some strata: those have lane centres in their place."""
        for name in LATERAL_SUMS & self.sums.keys():
            self.sums[name][stratum] = np.nan

    def score(self, seconds: Sequence[float], rate_hz: int) -> pl.DataFrame:
        """Compute the figures of every dataset, group and average at some horizons: rows of SCORES.

        Raises:
            UsageError: the horizon has no tick at these seconds.
        """
        at = self._find_ticks(seconds, rate_hz)
        sums = {name: total[:, at - 1] for name, total in self.sums.items()}
        tables = [pl.DataFrame(schema=SCORES)]
        for dataset, group, members in self.strata.list_groups():
            if group == EVERYTHING:
                sums |= self._count_majority(members, sums["n"])
            tables += _score_group(dataset, group, members, sums, self.strata.vehicle, seconds)
        return pl.concat(tables, how="diagonal_relaxed").fill_nan(None).cast(pl.Schema(SCORES))

    def sum_vehicles(self, seconds: Sequence[float], rate_hz: int) -> dict[str, Floats]:
        """Sum up the samples of each vehicle at some horizons, (V, T) each; errors are those of `score`."""
        at = self._find_ticks(seconds, rate_hz)
        starts = np.unique(self.strata.vehicle, return_index=True)[1]
        return {name: np.add.reduceat(total[:, at - 1], starts, axis=0) for name, total in self.sums.items()}

    def _find_ticks(self, seconds: Sequence[float], rate_hz: int) -> Integers:
        """Find the ticks (T,) of some horizons, 1 at least; UsageError where there is none."""
        horizon = self._shape[1]
        at: Integers = np.round(np.multiply(seconds, rate_hz)).astype(np.int64)
        for own, tick in zip(seconds, at, strict=True):
            if abs(tick - own * rate_hz) > 1e-6 or not 1 <= tick <= horizon:
                raise UsageError(
                    f"no tick lies {own:g} s ahead: expected multiples of {1 / rate_hz:g} s up to {horizon / rate_hz:g}"
                )
        return at

    def _count_majority(self, members: Flags, n: Floats) -> dict[str, Floats]:
        """Count samples whose maneuver is a dataset's most frequent one: (P, T); of equally frequent ones the first."""
        samples = np.bincount(self.strata.of_sample, minlength=len(self.strata)) * members
        codes = {"lateral": self.strata.lateral, "longitudinal": self.strata.longitudinal}
        most = {name: np.bincount(code, weights=samples).argmax() for name, code in codes.items()}
        return {f"majority_{name}": n * (code == most[name])[:, None] for name, code in codes.items()}


SUMMANDS = {
    **COMPARED_FIGURES,
    "mae_longitudinal_m": ("longitudinal",),
    "mae_lateral_m": ("lateral",),
    "ade_m": ("average_distance",),
    "fde_m": ("distance_m",),
    "lateral_accuracy": ("lateral_right",),
    "longitudinal_accuracy": ("longitudinal_right",),
    "majority_lateral_share": ("majority_lateral",),
    "majority_longitudinal_share": ("majority_longitudinal",),
}
"""Figures and the summands behind each; those named rmse are roots of means, the others means."""
LATERAL_SUMS = frozenset({"squared_lateral_m2", "lateral", "distance_m", "average_distance", "nll_nats"})
"""Summands that depend on lateral positions."""


def _score_group(
    dataset: str, group: str, members: Flags, sums: dict[str, Floats], vehicle: Integers, seconds: Sequence[float]
) -> Iterator[pl.DataFrame]:
    """Compute the rows of one group, by average and horizon; NaN where there is nothing to measure."""
    starts = np.unique(vehicle[members], return_index=True)[1]
    by_vehicle = {
        name: np.add.reduceat(total[members], starts, axis=0) if len(starts) else total[members]
        for name, total in sums.items()
    }
    n = by_vehicle["n"]
    counts = {"n": n.sum(axis=0), "vehicles": (n > 0).sum(axis=0)}
    for average in AVERAGES:
        means = {name: _average(total, n, average) for name, total in by_vehicle.items()}
        known = {name: owns for name, owns in SUMMANDS.items() if all(own in means for own in owns)}
        figures = {name: np.sum([means[own] for own in owns], axis=0) for name, owns in known.items()}
        figures |= {name: np.sqrt(values) for name, values in figures.items() if name.startswith("rmse")}
        yield pl.DataFrame(
            {"dataset": dataset, "group": group, "average": average, "seconds": seconds, **counts, **figures}
        )


def _average(total: Floats, n: Floats, average: str) -> Floats:
    """Average sums (V, T) over n (V, T) samples of each vehicle: (T,); NaN where there are none."""
    if average == "vehicles":
        total, n = np.divide(total, n, out=np.zeros_like(total), where=n > 0), (n > 0).astype(np.float64)
    return np.where(n.any(axis=0), total.sum(axis=0) / np.maximum(n.sum(axis=0), 1.0), np.nan)
