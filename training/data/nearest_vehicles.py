"""The vehicles nearest to samples: read from their scenes, padded to one size, everything as seen from the sample."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tracklake.training.data.batches import Flags, Floats, Integers
from tracklake.training.data.observed import ObservedScene, Truth
from tracklake.training.data.windows import Rows, check_numbers, place, subtract

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder

NOBODY = np.iinfo(np.int64).max
ITSELF = np.iinfo(np.int64).min
"""Sort behind and before every distance."""


@dataclass(frozen=True)
class Around:
    """Who is around B samples.

    Args:
        row: (B, V) of the folder's positions; the ego first, then the others from the nearest to the farthest. Where
            nobody is left, the ego again.
        present: (B, V) where somebody is.
    """

    row: Rows
    present: Flags


def gather_surroundings(
    folder: "TensorFolder", samples: npt.ArrayLike, *, nearest: int
) -> tuple[ObservedScene[Any], Truth[Any]]:
    """Read samples (egos) with the vehicles nearest to them; no sample is looked at by itself.

    Every vehicle of the moment counts, sample or not: whether it is one depends on its future. The nearest are those
    with the smallest distance between front centres; of two equally far the smaller id comes first.

    Args:
        folder: where from.
        samples: (B,) numbers of samples, in any order.
        nearest: vehicles around the ego, at most; V = 1 + nearest, whoever is there.

    Returns:
        What may be seen, and what came, of every vehicle: `future` (B, V, F, 2) is relative to the EGO's last position;
        where masked, the vehicle's last known position again, and zeros where there is no vehicle.

    Raises:
        IndexError: a number below 0, or not below S.
        ValueError: `nearest` is negative.
    """
    if nearest < 0:
        raise ValueError(f"cannot look at the {nearest} nearest: expected 0 or more")
    sample = check_numbers(samples, len(folder.sample_row), "sample")
    around = find_around(folder, sample, nearest)
    row, present = around.row.reshape(-1), around.present.reshape(-1)
    run = folder.runs_of(row)
    first, last = folder.run_first_row[run], folder.run_first_row[run + 1] - 1
    history_ticks, horizon_ticks = folder.protocol.history_ticks, folder.protocol.horizon_ticks
    history_known = np.minimum(row - first + 1, history_ticks)
    future_known = np.minimum(last - row, horizon_ticks)
    origin = np.repeat(folder.position_m[around.row[:, 0]], 1 + nearest, axis=0)
    history = folder.histories.take(row + 1 - history_ticks, first, row, history_known < history_ticks)
    future = folder.futures.take(row + 1, row, last, future_known < horizon_ticks)
    history, future = subtract(history, origin, folder.step_m), subtract(future, origin, folder.step_m)
    size_m = np.stack([folder.run_length_m[run], folder.run_width_m[run]], axis=-1)
    size_m[np.isnan(size_m)] = 0

    def part(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        values[~present] = 0
        return values.reshape(*around.row.shape, *values.shape[1:])

    observed = ObservedScene(
        history=part(history),
        history_mask=part(folder.history_masks.take(history_known.astype(np.uint8))),
        vehicle_mask=around.present,
        size_m=part(size_m),
        lanes=_describe_lanes(folder, sample),
    )
    truth = Truth(
        future=part(future),
        future_mask=part(folder.future_masks.take(future_known.astype(np.uint8))),
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
    )
    return observed, truth


def find_around(folder: "TensorFolder", sample: Integers, nearest: int) -> Around:
    """The ego and the nearest around it.

    Distances and ids are sorted as one number: the bits of a float that is not negative sort as it does, and the lowest
    of its squared distance give way to the place within the scene, where ids increase. What is lost is a billionth of a
    metre.
    """
    scene = folder.scene_of_sample[sample].astype(np.intp)
    begin = folder.scene_offset[scene]
    count = folder.scene_offset[scene + 1] - begin
    rank = np.arange(max(int(count.max(initial=0)), 1 + nearest))
    absent = rank >= count[:, None]
    member = np.where(absent, begin[:, None], begin[:, None] + rank)
    row = folder.scene_row[member].astype(np.intp)
    ego = folder.sample_row[sample].astype(np.intp)[:, None]

    apart = folder.position_m[row].astype(np.float64)
    apart -= folder.position_m[ego]
    if folder.step_m is not None:
        apart *= folder.step_m
    apart *= apart
    rank_bits = (1 << int(rank[-1]).bit_length()) - 1
    keys = (apart[..., 0] + apart[..., 1]).view(np.int64)
    keys &= ~rank_bits
    keys |= rank
    keys[row == ego] = ITSELF
    keys[absent] = NOBODY
    chosen = _smallest(keys, 1 + nearest)
    present = chosen < NOBODY
    another = present & (chosen != ITSELF)
    found = np.take_along_axis(row, np.where(another, chosen & rank_bits, 0), axis=1)
    return Around(np.where(another, found, ego), present)


def _smallest(keys: Integers, count: int) -> Integers:
    """(B, count) the smallest numbers of each row, in order."""
    if count < keys.shape[1]:
        keys = np.partition(keys, count - 1, axis=1)[:, :count]
    return np.sort(keys, axis=1)


def _describe_lanes(folder: "TensorFolder", sample: Integers) -> Floats:
    """(B, 3, 3) of the lanes left of, under and right of each ego, see `ObservedScene`."""
    row, subset, around = folder.sample_row[sample], folder.subset_of(sample), folder.lanes.around
    described = around[subset, np.clip(folder.lane[row], 0, around.shape[1] - 1)]
    y_m = place(folder.position_m[row][:, None, :], folder.centre_m[subset], folder.step_m)[:, 0, 1]
    described[..., 0] -= y_m[:, None] * described[..., 2]
    lanes: Floats = described.astype(np.float32)
    return lanes
