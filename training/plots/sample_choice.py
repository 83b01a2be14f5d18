"""The choice of samples: by vehicle and time, at random among those of a kind, or by a model's greatest error."""

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.inputs import read_samples, truth_of_ego
from tracklake.training.runs.forecasters import Forecaster

Pick = Literal["random", "lane-change", "lane-keep", "brake", "worst"]
PICKS: tuple[Pick, ...] = get_args(Pick)

MOST_SEARCHED = 20_000
"""Most samples searched for the worst; of more, so many are drawn at random."""
BATCH_SIZE = 2048
"""Samples predicted at once."""


class NoSampleError(TracklakeError):
    """No sample has the requested kind, vehicle or time."""


def find_sample(folder: TensorFolder, vehicle: str, time_s: float) -> int:
    """Find the number of a vehicle's sample at a time, or less than half a tick from it.

    Args:
        folder: tensors.
        vehicle: `SUBSET:ID` or `DATASET/SUBSET:ID`.
        time_s: seconds since the recording began.

    Raises:
        NoSampleError: no such subset, vehicle or time, or the vehicle is written in another form.
    """
    name, colon, number = vehicle.rpartition(":")
    if not colon or not name or not number.isascii() or not number.isdigit():
        raise NoSampleError(f"expected a vehicle as SUBSET:ID, for instance 02-lower:21, got `{vehicle}`")
    full = [f"{subset['dataset']}/{subset['subset']}" for subset in folder.index["subsets"]]
    subsets = [at for at, known in enumerate(full) if name in (known, known.partition("/")[2])]
    if not subsets:
        raise NoSampleError(f"{folder.path}: no subset `{name}`: expected one of {', '.join(sorted(full))}")
    if len(subsets) > 1:
        raise NoSampleError(
            f"{folder.path}: several subsets `{name}`: name one of {', '.join(full[at] for at in subsets)}"
        )
    run = folder.runs_of(folder.sample_row)
    inside = np.flatnonzero(folder.run_subset[run] == subsets[0])
    ids = folder.run_vehicle_id[run[inside]]
    own = inside[ids == int(number)]
    if len(own) == 0:
        known = np.unique(ids)
        near = np.sort(known[np.argsort(np.abs(known - float(number)), kind="stable")[:5]])
        nearest = ", ".join(map(str, near)) or "none"
        raise NoSampleError(
            f"{folder.path}: no sample of vehicle {number} in {name}; the nearest ids with any: {nearest}"
        )
    rate_hz = folder.protocol.rate_hz
    rows = folder.sample_row[own].astype(np.int64)
    times_s = (folder.run_first_tick[run[own]] + rows - folder.run_first_row[run[own]]) / rate_hz
    best = int(np.argmin(np.abs(times_s - time_s)))
    if not abs(times_s[best] - time_s) < 0.5 / rate_hz:
        raise NoSampleError(
            f"{folder.path}: no sample of vehicle {number} in {name} at {time_s:g} s: it has {len(own):,} from "
            f"{times_s.min():g} to {times_s.max():g} s; the nearest is at {times_s[best]:g} s"
        )
    return int(own[best])


def pick_samples(
    folder: TensorFolder, part: str, pick: Pick, *, count: int = 1, seed: int = 0, judge: Forecaster | None = None
) -> Integers:
    """Choose samples of a kind: numbers (count,), or fewer where there are fewer.

    Samples with a whole future come first, then, among lane changes, those that happen after the sample.

    Args:
        folder: tensors.
        part: train, val or eval.
        pick: the kind; `worst`: greatest distance at the last known position, the worst first.
        count: most samples.
        seed: seed of the draw.
        judge: the model whose distances count; needed by `worst`.

    Raises:
        NoSampleError: no sample is of the kind.
    """
    samples = folder.samples_of(part)
    found = samples[_is_kind(folder, samples, pick)]
    found = _prefer(found, folder.sample_future[found] == folder.protocol.horizon_ticks)
    if pick == "lane-change":
        found = _prefer(found, _changes_lane(folder, found))
    if len(found) == 0:
        raise NoSampleError(
            f"{folder.path}: no sample to pick by `{pick}` among the {len(samples):,} of part `{part}` of the split "
            f"`{folder.split}`; pick another kind (--pick) or part (--part)"
        )
    random = np.random.default_rng(seed)
    if pick != "worst":
        return random.permutation(found)[:count]
    if judge is None:
        raise UsageError("`worst` needs a model to judge by")
    if len(found) > MOST_SEARCHED:
        found = np.sort(random.choice(found, MOST_SEARCHED, replace=False))
    distance = measure_last_distance(folder, found, judge)
    return found[np.argsort(-distance, kind="stable")[:count]]


def measure_last_distance(folder: TensorFolder, samples: Integers, judge: Forecaster) -> npt.NDArray[np.float64]:
    """Measure the distance in m between predicted and true position at each sample's last known tick (B,)."""
    distances = []
    for start in range(0, len(samples), BATCH_SIZE):
        observed, everything = read_samples(folder, samples[start : start + BATCH_SIZE], judge.reads)
        truth = truth_of_ego(everything)
        position_m = judge.predictor.predict(observed).position_m.astype(np.float64)
        last = truth.future_mask.sum(axis=1) - 1
        apart = (position_m - truth.future)[np.arange(len(last)), last]
        distances.append(np.hypot(apart[:, 0], apart[:, 1]))
    return np.concatenate(distances)


def _is_kind(folder: TensorFolder, samples: Integers, pick: Pick) -> Flags:
    """Find which samples (B,) are of a kind."""
    keep = folder.sample_lateral[samples] == LATERAL_MANEUVERS.index("keep")
    normal = folder.sample_longitudinal[samples] == LONGITUDINAL_MANEUVERS.index("normal")
    kinds: dict[str, Flags] = {"lane-change": ~keep, "lane-keep": keep & normal, "brake": ~normal}
    return kinds.get(pick, np.ones(len(samples), dtype=np.bool_))


def _changes_lane(folder: TensorFolder, samples: Integers) -> Flags:
    """Find whether the last known lane of the future differs from the sample's (B,)."""
    row = folder.sample_row[samples].astype(np.intp)
    changes: Flags = folder.lane[row + folder.sample_future[samples]] != folder.lane[row]
    return changes


def _prefer(samples: Integers, flagged: Flags) -> Integers:
    """Keep the flagged samples if there are any, else all."""
    return samples[flagged] if flagged.any() else samples
