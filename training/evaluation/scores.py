"""Errors summed up over batches, and the figures made of the sums: by vehicle and maneuver, and over everything.

Samples are summed by stratum: those of one vehicle, with the same maneuvers and equally severe findings. Every group is
a union of strata, so that one pass over the samples serves all of them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.evaluations import AVERAGES, EVERYTHING, FINDING_GROUPS
from tracklake.training.data.findings import mark_flagged
from tracklake.training.data.observed import Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.densities import find_nll
from tracklake.training.models.prediction import Prediction

Sums = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """One row of figures; see `schemas.evaluations` for what they mean. None where there is nothing to measure.

    Args:
        dataset: `all`, or one.
        group: `all`, or for instance `lateral=left`.
        average: `samples` or `vehicles`.
        seconds: ahead of the sample.
        n: samples whose position is known then.
        vehicles: that these are of.
    """

    dataset: str
    group: str
    average: str
    seconds: float
    n: int
    vehicles: int
    rmse_m: float | None = None
    rmse_longitudinal_m: float | None = None
    rmse_lateral_m: float | None = None
    mae_m: float | None = None
    mae_longitudinal_m: float | None = None
    mae_lateral_m: float | None = None
    ade_m: float | None = None
    fde_m: float | None = None
    nll_nats: float | None = None
    lateral_accuracy: float | None = None
    longitudinal_accuracy: float | None = None
    majority_lateral_share: float | None = None
    majority_longitudinal_share: float | None = None


@dataclass(frozen=True)
class Strata:
    """Which samples are summed together: P strata of the vehicles of a part.

    Args:
        of_sample: (S_part,) the stratum of each of the part's samples, in their order.
        vehicle: (P,) the vehicle of each stratum, never falling.
        dataset: (P,) position in `datasets`.
        lateral: (P,) true maneuver, position in LATERAL_MANEUVERS.
        longitudinal: (P,) likewise.
        findings: (P,) how many of the severities of FINDING_GROUPS the samples' worst finding reaches; 0 has none.
        datasets: of the part, sorted.
    """

    of_sample: Integers
    vehicle: Integers
    dataset: Integers
    lateral: Integers
    longitudinal: Integers
    findings: Integers
    datasets: tuple[str, ...]

    def __len__(self) -> int:
        """P."""
        return len(self.vehicle)

    def groups(self) -> Iterator[tuple[str, str, Flags]]:
        """Dataset, group, and (P,) the strata in both."""
        groups = {EVERYTHING: np.ones(len(self), dtype=np.bool_)}
        groups |= {f"lateral={name}": self.lateral == code for code, name in enumerate(LATERAL_MANEUVERS)}
        groups |= {
            f"longitudinal={name}": self.longitudinal == code for code, name in enumerate(LONGITUDINAL_MANEUVERS)
        }
        for below, (found, others) in enumerate(FINDING_GROUPS.values()):
            groups |= {found: self.findings > below, others: self.findings <= below}
        for code, dataset in enumerate((EVERYTHING, *self.datasets), start=-1):
            within = groups[EVERYTHING] if code < 0 else self.dataset == code
            for group, members in groups.items():
                yield dataset, group, members & within


def find_strata(folder: TensorFolder, samples: Integers) -> Strata:
    """Part samples (S_part,) by vehicle, maneuvers and findings. A vehicle in several runs is one."""
    run = folder.runs_of(folder.sample_row[samples])
    subset = folder.run_subset[run].astype(np.int64)
    vehicle = np.unique((subset << 32) | folder.run_vehicle_id[run], return_inverse=True)[1].astype(np.int64)
    maneuvers = (len(LATERAL_MANEUVERS), len(LONGITUDINAL_MANEUVERS))
    code = vehicle * maneuvers[0] + folder.sample_lateral[samples]
    code = code * maneuvers[1] + folder.sample_longitudinal[samples]
    levels = 1 + len(FINDING_GROUPS)
    code = code * levels + sum(mark_flagged(folder, samples, severity).astype(np.int64) for severity in FINDING_GROUPS)
    found, first, of_sample = np.unique(code, return_index=True, return_inverse=True)
    names = [str(named["dataset"]) for named in folder.index["subsets"]]
    datasets = tuple(sorted({names[number] for number in np.unique(subset)}))
    dataset_of_subset = np.array([datasets.index(name) if name in datasets else -1 for name in names], dtype=np.int64)
    rest, maneuver = found // levels, found // levels % maneuvers[1]
    return Strata(
        of_sample=of_sample.astype(np.int64),
        vehicle=rest // (maneuvers[0] * maneuvers[1]),
        dataset=dataset_of_subset[subset[first]],
        lateral=rest // maneuvers[1] % maneuvers[0],
        longitudinal=maneuver,
        findings=found % levels,
        datasets=datasets,
    )


def measure_samples(prediction: Prediction, truth: Truth[Any]) -> dict[str, Sums]:
    """What is summed, of each sample and tick: (B, F); 0 where the position is not known.

    Raises:
        ValueError: places of another shape than the truth's.
    """
    if prediction.position_m.shape != truth.future.shape:
        raise ValueError(f"expected places of shape {truth.future.shape}, got {prediction.position_m.shape}")
    known = truth.future_mask
    error = np.where(known[..., None], prediction.position_m.astype(np.float64) - truth.future, 0.0)
    squares = error**2
    distance = np.sqrt(squares.sum(axis=-1))
    ticks = np.arange(1, distance.shape[1] + 1)
    sums = {
        "n": known.astype(np.float64),
        "longitudinal2": squares[..., 0],
        "lateral2": squares[..., 1],
        "longitudinal": np.abs(error[..., 0]),
        "lateral": np.abs(error[..., 1]),
        "distance": distance,
        "average_distance": np.where(known, distance.cumsum(axis=1) / ticks, 0.0),
    }
    if prediction.density is not None:
        sums["nll"] = np.where(known, find_nll(prediction.density, truth.future), 0.0)
    for name in ("lateral", "longitudinal"):
        said = getattr(prediction, name)
        if said is not None:
            sums[f"{name}_right"] = known * (said.argmax(axis=1) == getattr(truth, name))[:, None].astype(np.float64)
    return sums


class Tally:
    """Sums of `measure_samples` by stratum and tick, (P, F) each.

    Args:
        strata: P of them.
        ticks: F.
    """

    def __init__(self, strata: Strata, ticks: int) -> None:
        self.strata, self._shape = strata, (len(strata), ticks)
        self.sums: dict[str, Sums] = {}

    def add(self, stratum: Integers, prediction: Prediction, truth: Truth[Any]) -> None:
        """Add B samples, each to its stratum (B,).

        Raises:
            ValueError: places of another shape than the truth's.
        """
        if len(stratum) == 0:
            return
        order = np.argsort(stratum, kind="stable")
        mine, first = np.unique(stratum[order], return_index=True)
        for name, values in measure_samples(prediction, truth).items():
            total = self.sums.setdefault(name, np.zeros(self._shape))
            total[mine] += np.add.reduceat(values[order], first, axis=0)

    def score(self, seconds: Sequence[float], rate_hz: int) -> tuple[Score, ...]:
        """Figures of every dataset, group and average, so many seconds ahead.

        Raises:
            ValueError: seconds that are no tick of the horizon.
        """
        ticks = [_tick_at(own, rate_hz, self._shape[1]) for own in seconds]
        sums = {name: total[:, ticks] for name, total in self.sums.items()}
        rows: list[Score] = []
        for dataset, group, members in self.strata.groups():
            if group == EVERYTHING:
                sums |= self._count_majority(members, sums["n"])
            rows += _score_group(dataset, group, members, sums, self.strata.vehicle, seconds)
        return tuple(rows)

    def _count_majority(self, members: Flags, n: Sums) -> dict[str, Sums]:
        """Samples whose maneuver is the commonest of a dataset: (P, T); of equally common ones the first."""
        samples = np.bincount(self.strata.of_sample, minlength=len(self.strata)) * members
        counts = {}
        for name in ("lateral", "longitudinal"):
            code = getattr(self.strata, name)
            commonest = np.bincount(code, weights=samples).argmax()
            counts[f"majority_{name}"] = n * (code == commonest)[:, None]
        return counts


def _tick_at(seconds: float, rate_hz: int, ticks: int) -> int:
    """The position among the future's ticks that lies so many seconds ahead."""
    tick = round(seconds * rate_hz)
    if abs(tick - seconds * rate_hz) > 1e-6 or not 1 <= tick <= ticks:
        raise ValueError(
            f"no tick lies {seconds:g} s ahead: expected multiples of {1 / rate_hz:g} s up to {ticks / rate_hz:g}"
        )
    return tick - 1


ROOTS = {
    "rmse_m": ("longitudinal2", "lateral2"),
    "rmse_longitudinal_m": ("longitudinal2",),
    "rmse_lateral_m": ("lateral2",),
}
"""Figures that are roots of means, and what is summed for them."""
MEANS = {
    "mae_m": "distance",
    "mae_longitudinal_m": "longitudinal",
    "mae_lateral_m": "lateral",
    "ade_m": "average_distance",
    "fde_m": "distance",
    "nll_nats": "nll",
    "lateral_accuracy": "lateral_right",
    "longitudinal_accuracy": "longitudinal_right",
    "majority_lateral_share": "majority_lateral",
    "majority_longitudinal_share": "majority_longitudinal",
}
"""Figures that are means, likewise."""


def _score_group(
    dataset: str, group: str, members: Flags, sums: dict[str, Sums], vehicle: Integers, seconds: Sequence[float]
) -> Iterator[Score]:
    """The rows of one group: by average and horizon."""
    chosen = np.flatnonzero(members)
    if len(chosen):
        starts = np.unique(vehicle[chosen], return_index=True)[1]
        by_vehicle = {name: np.add.reduceat(total[chosen], starts, axis=0) for name, total in sums.items()}
    else:
        by_vehicle = {name: total[chosen] for name, total in sums.items()}
    n = by_vehicle["n"]
    total_n, vehicles = n.sum(axis=0), (n > 0).sum(axis=0)
    for average in AVERAGES:
        means = {name: _average(total, n, average) for name, total in by_vehicle.items()}
        for at, ahead in enumerate(seconds):
            figures: dict[str, float] = {}
            if total_n[at]:
                roots = {name: float(np.sqrt(sum(means[own][at] for own in owns))) for name, owns in ROOTS.items()}
                figures = roots | {name: float(means[own][at]) for name, own in MEANS.items() if own in means}
            yield Score(dataset, group, average, float(ahead), int(total_n[at]), int(vehicles[at]), **figures)


def _average(total: Sums, n: Sums, average: str) -> Sums:
    """(T,) of sums (V, T) over n (V, T) samples of each vehicle; 0 where there are none."""
    if average == "vehicles":
        total, n = np.divide(total, n, out=np.zeros_like(total), where=n > 0), (n > 0).astype(np.float64)
    averaged: Sums = total.sum(axis=0) / np.maximum(n.sum(axis=0), 1.0)
    return averaged
