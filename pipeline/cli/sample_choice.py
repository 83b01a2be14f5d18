"""Samples that `tracklake predict` draws: by vehicle and time, at random by kind, or by a model's greatest error."""

from enum import StrEnum

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.runs.forecasters import Forecaster

MOST_SEARCHED = 20_000
"""Most samples searched for the worst; of more, so many are drawn at random."""


class Pick(StrEnum):
    """Kinds of samples that can be picked."""

    LANE_CHANGE = "lane-change"
    LANE_KEEP = "lane-keep"
    BRAKE = "brake"
    WORST = "worst"
    RANDOM = "random"


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
    name, _, number = vehicle.rpartition(":")
    if not name or not number.isascii() or not number.isdigit():
        raise NoSampleError(f"expected a vehicle as SUBSET:ID, for instance 02-lower:21, got `{vehicle}`")
    full = [f"{subset['dataset']}/{subset['subset']}" for subset in folder.index["subsets"]]
    subsets = [at for at, known in enumerate(full) if name in (known, known.partition("/")[2])]
    if not subsets:
        raise NoSampleError(f"{folder.path}: no subset `{name}`: expected one of {', '.join(sorted(full))}")
    if len(subsets) > 1:
        names = ", ".join(full[at] for at in subsets)
        raise NoSampleError(f"{folder.path}: several subsets `{name}`: name one of {names}")
    run = folder.runs_of(folder.sample_row)
    inside = np.flatnonzero(folder.run_subset[run] == subsets[0])
    ids = folder.run_vehicle_id[run[inside]]
    own = inside[ids == int(number)]
    missing = f"{folder.path}: no sample of vehicle {number} in {name}"
    if len(own) == 0:
        known = np.unique(ids)
        near = np.sort(known[np.argsort(np.abs(known - float(number)), kind="stable")[:5]])
        raise NoSampleError(f"{missing}; the nearest ids with any: {', '.join(map(str, near)) or 'none'}")
    rows = folder.sample_row[own].astype(np.int64)
    times_s = (folder.run_first_tick[run[own]] + rows - folder.run_first_row[run[own]]) / folder.protocol.rate_hz
    best = int(np.argmin(np.abs(times_s - time_s)))
    if not abs(times_s[best] - time_s) < 0.5 / folder.protocol.rate_hz:
        raise NoSampleError(
            f"{missing} at {time_s:g} s: it has {len(own):,} from {times_s.min():g} to {times_s.max():g} s; "
            f"the nearest is at {times_s[best]:g} s"
        )
    return int(own[best])


def pick_samples(
    folder: TensorFolder, part: str, pick: Pick, *, count: int = 1, seed: int = 0, judge: Forecaster | None = None
) -> Integers:
    """Choose samples of a kind: at most `count` numbers.

    Samples with a whole future come first, then, among lane changes, those that happen after the sample. `worst` are
    those with the greatest distance at the last known position, the worst first, of the model `judge`.

    Raises:
        NoSampleError: no sample is of the kind.
    """
    samples = folder.samples_of(part)
    keep = folder.sample_lateral[samples] == LATERAL_MANEUVERS.index("keep")
    normal = folder.sample_longitudinal[samples] == LONGITUDINAL_MANEUVERS.index("normal")
    kinds = {Pick.LANE_CHANGE: ~keep, Pick.LANE_KEEP: keep & normal, Pick.BRAKE: ~normal}
    found = samples[kinds[pick]] if pick in kinds else samples
    found = _prefer(found, folder.sample_future[found] == folder.protocol.horizon_ticks)
    if pick == Pick.LANE_CHANGE:
        row = folder.sample_row[found].astype(np.intp)
        found = _prefer(found, folder.lane[row + folder.sample_future[found]] != folder.lane[row])
    if len(found) == 0:
        raise NoSampleError(
            f"{folder.path}: no sample to pick by `{pick}` among the {len(samples):,} of part `{part}` of the split "
            f"`{folder.split}`; pick another kind (--pick) or part (--part)"
        )
    random = np.random.default_rng(seed)
    if pick != Pick.WORST:
        return random.permutation(found)[:count]
    if judge is None:
        raise UsageError("`worst` needs a model to judge by")
    if len(found) > MOST_SEARCHED:
        found = np.sort(random.choice(found, MOST_SEARCHED, replace=False))
    distance = measure_last_distance(folder, found, judge)
    return found[np.argsort(-distance, kind="stable")[:count]]


def _prefer(samples: Integers, flagged: Flags) -> Integers:
    """Keep the flagged samples if there are any, else all."""
    return samples[flagged] if flagged.any() else samples


def measure_last_distance(folder: TensorFolder, samples: Integers, judge: Forecaster) -> Floats:
    """Measure the distance in m between predicted and true position at each sample's last known tick (B,).

    Where lateral positions are lane centres, it is the distance along the road.
    """
    apart_m = np.empty((len(samples), 2))
    for chosen, prediction, truth in judge.predict(folder, samples):
        last = truth.future_mask.sum(axis=1) - 1
        error_m = prediction.position_m.astype(np.float64) - truth.future
        apart_m[chosen] = error_m[np.arange(len(last)), last]
    centred = folder.lane_centred[folder.run_subset[folder.runs_of(folder.sample_row[samples])]]
    return np.hypot(apart_m[:, 0], np.where(centred, 0.0, apart_m[:, 1]))
