"""The vehicles nearest to samples, gathered from their scenes and padded to one size."""

from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from tracklake.training.data.observed import ObservedScene, Truth
from tracklake.training.data.positions import (
    Array,
    Folder,
    cast,
    check_numbers,
    count_from,
    find_namespace,
    find_runs,
    locate_rows,
    read_future,
    read_history,
    take_columns,
    to_relative,
)

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


@dataclass(frozen=True)
class NearestVehicles:
    """The vehicles nearest to B samples.

    Args:
        row: (B, V) rows of the folder; the ego first, then the others from the nearest to the farthest. Where there
            are fewer, the ego's again.
        present: (B, V) True where there is a vehicle.
    """

    row: Array
    present: Array


def gather_nearest(
    folder: "TensorFolder", samples: npt.ArrayLike, *, nearest: int
) -> tuple[ObservedScene[Any], Truth[Any]]:
    """Read samples (egos, by their numbers (B,)) with the `nearest` vehicles around them, as NumPy arrays.

    Every vehicle of the scene counts, sample or not: whether it is one depends on its future. The nearest are those
    with the smallest distance between front centres; of two equally far the smaller id comes first.

    Returns:
        What may be seen, and the truth, of every vehicle: `future` (B, V, F, 2) is relative to the EGO's last position;
        where masked, the vehicle's last known position again, and zeros where there is no vehicle.

    Raises:
        IndexError: a number is below 0 or not below S.
        ValueError: `nearest` is negative.
    """
    if nearest < 0:
        raise ValueError(f"cannot gather the {nearest} nearest vehicles: expected 0 or more")
    return gather_vehicles(folder, check_numbers(samples, len(folder.sample_row), "sample"), nearest)


def gather_vehicles(folder: Folder, sample: Array, nearest: int) -> tuple[ObservedScene[Any], Truth[Any]]:
    """Read samples with the vehicles nearest to them: `gather_nearest` without its checks, on any device."""
    xp = find_namespace(sample)
    vehicles = find_nearest(folder, sample, nearest)
    row, present = vehicles.row, vehicles.present
    run = find_runs(folder, row)
    history, history_mask = read_history(folder, row, folder.run_first_row[run])
    future, future_mask = read_future(folder, row, folder.run_first_row[run + 1] - 1)
    origin = folder.position_m[row[:, :1]]
    there = present[..., None, None]
    observed = ObservedScene(
        history=xp.where(there, to_relative(folder, history, origin), 0),
        history_mask=history_mask & present[..., None],
        vehicle_mask=present,
        size_m=xp.where(present[..., None], folder.run_size_m[run], 0),
        lanes=_describe_lanes(folder, cast(folder.sample_row[sample], "int64")),
    )
    truth = Truth(
        future=xp.where(there, to_relative(folder, future, origin), 0),
        future_mask=future_mask & present[..., None],
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
    )
    return observed, truth


def find_nearest(folder: Folder, sample: Array, nearest: int) -> NearestVehicles:
    """Find the egos of samples (B,) int64 and the vehicles nearest to them; equal distances are ordered by id."""
    xp = find_namespace(sample)
    scene = cast(folder.scene_of_sample[sample], "int64")
    begin = folder.scene_offset[scene]
    count = folder.scene_offset[scene + 1] - begin
    most = max(int(count.max()) if len(count) else 0, 1 + nearest)
    rank = count_from(0, most, sample)
    absent = rank >= count[:, None]
    row = cast(folder.scene_row[begin[:, None] + xp.where(absent, 0, rank)], "int64")  # ids increase within a scene
    ego = cast(folder.sample_row[sample], "int64")[:, None]
    apart = cast(folder.position_m[row], "float64") - cast(folder.position_m[ego], "float64")
    if folder.step_m is not None:
        apart = apart * folder.step_m
    apart = apart * apart
    squared = xp.where(row == ego, -1.0, apart[..., 0] + apart[..., 1])  # m2; the ego first
    order = xp.argsort(xp.where(absent, inf, squared), axis=1, stable=True)[:, : 1 + nearest]
    present = ~take_columns(absent, order)
    return NearestVehicles(xp.where(present, take_columns(row, order), ego), present)


def _describe_lanes(folder: Folder, row: Array) -> Array:
    """Return (B, 3, 3) the lanes left of, under and right of each ego, see `ObservedScene`."""
    subset, lanes = folder.run_subset[find_runs(folder, row)], folder.adjacent_lanes
    described = lanes[subset, find_namespace(row).clip(cast(folder.lane[row], "int64"), 0, lanes.shape[1] - 1)]
    described[..., 0] -= locate_rows(folder, row)[:, 1:] * described[..., 2]
    return cast(described, "float32")
