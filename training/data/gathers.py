"""Samples, whole scenes and the vehicles nearest to samples, gathered by indexing NumPy arrays or torch tensors."""

from math import inf
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import expand_ranges
from tracklake.training.data.batches import Array, Batch, SceneBatch
from tracklake.training.data.observed import Observed, ObservedScene, Reads, Truth, part_batch

NEAREST = 10
"""Most vehicles around the ego in a scene (Kim et al. 2020 train with the nearest ten)."""
Inputs = tuple[Observed[Any] | ObservedScene[Any], Truth[Any]]


class Folder(Protocol):
    """Holder of the arrays of a tensor folder by their names: all NumPy's (`TensorFolder`) or all torch's tensors."""

    def __getattr__(self, name: str, /) -> Any:  # noqa: ANN401  (an array of either library, or a fact of the folder)
        """Return an array, or a fact of the folder."""
        ...


def find_namespace(array: Array) -> Any:  # noqa: ANN401  (the module numpy or torch)
    """Return the module whose functions take an array: numpy or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def cast(array: Array, dtype: str) -> Array:
    """Convert an array to a dtype by its name, which both libraries share."""
    return array.astype(dtype) if isinstance(array, np.ndarray) else array.to(getattr(find_namespace(array), dtype))


def count_from(first: int, end: int, like: Array) -> Array:
    """Return first, first + 1, ... end - 1 where another array is: in memory or on its device."""
    if isinstance(like, np.ndarray):
        return np.arange(first, end)
    return find_namespace(like).arange(first, end, device=like.device)


def take_columns(array: Array, columns: Array) -> Array:
    """Return (B, C) chosen columns of each row: those numbered by `columns` (B, C)."""
    if isinstance(array, np.ndarray):
        return np.take_along_axis(array, columns, axis=1)
    return array.gather(1, columns)


def expand_groups(offset: Array, groups: Array) -> tuple[Array, Array]:
    """List members (K,) of groups (B,), offset[g] to offset[g + 1] - 1, and each one's position (K,) in `groups`."""
    first = offset[groups]
    count = offset[groups + 1] - first
    if isinstance(count, np.ndarray):
        return expand_ranges(first, count)
    owner = find_namespace(count).repeat_interleave(count)
    before = count.cumsum(0) - count
    return count_from(0, len(owner), owner) + (first - before)[owner], owner


def check_numbers(numbers: npt.ArrayLike, of: Array, what: str) -> Array:
    """Return the numbers (B,) of rows of an array as int64; IndexError where NumPy has no such row.

    Those of rows on a device are tensors there already, and taken as they are.
    """
    if not isinstance(of, np.ndarray):
        return numbers
    checked = np.asarray(numbers, dtype=np.int64)
    if len(checked) and (checked.min() < 0 or checked.max() >= len(of)):
        raise IndexError(f"{what}s are numbered 0 to {len(of) - 1}, got {checked.min()} to {checked.max()}")
    return checked


def find_runs(folder: Folder, row: Array) -> Array:
    """Return the run that each row stands in."""
    return find_namespace(row).searchsorted(folder.run_first_row, row, side="right") - 1


def read_history(folder: Folder, row: Array, first: Array) -> tuple[Array, Array]:
    """Read the positions (..., H, 2), as stored, of the H ticks up to rows (...), and whether each is known (..., H).

    Ticks before the `first` known rows repeat their position.
    """
    rows = row[..., None] + count_from(1 - folder.protocol.history_ticks, 1, row)
    return _read(folder, find_namespace(row).maximum(rows, first[..., None])), rows >= first[..., None]


def read_future(folder: Folder, row: Array, last: Array) -> tuple[Array, Array]:
    """Read the positions (..., F, 2), as stored, of the F ticks after rows (...), and whether each is known (..., F).

    Ticks after the `last` known rows repeat their position.
    """
    rows = row[..., None] + count_from(1, folder.protocol.horizon_ticks + 1, row)
    return _read(folder, find_namespace(row).minimum(rows, last[..., None])), rows <= last[..., None]


def _read(folder: Folder, rows: Array) -> Array:
    positions = folder.position_m
    # NumPy copies rows by `take` in a third of the time that indexing needs.
    return np.take(positions, rows, axis=0) if isinstance(positions, np.ndarray) else positions[rows]


def to_relative(folder: Folder, positions: Array, origin: Array) -> Array:
    """Convert stored positions (..., T, 2) to m relative to stored origins (..., 2), float32."""
    step_m = folder.step_m
    if step_m is None:
        return positions - origin[..., None, :]
    apart = cast(positions, "float32") - cast(origin, "float32")[..., None, :]  # int16 would overflow
    return apart * cast(step_m, "float32")


def to_absolute(folder: Folder, positions: Array, row: Array) -> Array:
    """Convert stored positions (M, T, 2) of the subsets of rows (M,) to m on the carriageway, float32."""
    step_m = folder.step_m
    if step_m is None:
        return positions
    centre_m = folder.centre_m[folder.run_subset[find_runs(folder, row)]]
    return cast(centre_m[:, None] + positions * step_m, "float32")


def locate_rows(folder: Folder, row: Array) -> Array:
    """Return where rows (M,) are on the carriageway: (M, 2) in m, float32."""
    return to_absolute(folder, folder.position_m[row][:, None], row)[:, 0]


def gather_samples(folder: Folder, samples: npt.ArrayLike, *, absolute: bool = False) -> Batch:
    """Read samples by their numbers (B,), in any order; the arrays are of the folder's kind and device."""
    sample = check_numbers(samples, folder.sample_row, "sample")
    row = cast(folder.sample_row[sample], "int64")
    pair, owner = expand_groups(folder.neighbor_offset, sample)
    neighbor_row = cast(folder.neighbor_row[pair], "int64")
    history, _ = read_history(folder, row, row + 1 - folder.protocol.history_ticks)  # complete by definition
    future, future_mask = read_future(folder, row, row + cast(folder.sample_future[sample], "int64"))
    neighbor_first = neighbor_row + 1 - cast(folder.neighbor_known[pair], "int64")
    neighbor_history, neighbor_mask = read_history(folder, neighbor_row, neighbor_first)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
        neighbor_history = to_absolute(folder, neighbor_history, neighbor_row)
    else:
        origin = folder.position_m[row]
        history, future = to_relative(folder, history, origin), to_relative(folder, future, origin)
        neighbor_history = to_relative(folder, neighbor_history, origin[owner])
    return Batch(
        sample=sample,
        history=history,
        future=future,
        future_mask=future_mask,
        neighbor_history=neighbor_history,
        neighbor_mask=neighbor_mask,
        neighbor_sample=owner,
        neighbor_cell=folder.neighbor_cell[pair],
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
        origin=locate_rows(folder, row),
        absolute=absolute,
    )


def gather_scenes(folder: Folder, scenes: npt.ArrayLike, *, absolute: bool = False) -> SceneBatch:
    """Read scenes by their numbers (B,), in any order, as NumPy arrays."""
    scene = check_numbers(scenes, folder.scene_part, "scene")
    member, vehicle_scene = expand_groups(folder.scene_offset, scene)
    row, sample = folder.scene_row[member].astype(np.int64), folder.scene_sample[member]
    run = find_runs(folder, row)
    history, history_mask = read_history(folder, row, folder.run_first_row[run])
    future, future_mask = read_future(folder, row, folder.run_first_row[run + 1] - 1)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
    else:
        stored = folder.position_m[row]
        history, future = to_relative(folder, history, stored), to_relative(folder, future, stored)
    origin, subset = locate_rows(folder, row), folder.run_subset[run]
    lane, marked = folder.lane[row], folder.marked_lanes
    centre_m, width_m = marked[subset, np.clip(lane, 0, marked.shape[1] - 1)].T
    codes = (folder.sample_lateral, folder.sample_longitudinal)
    lateral, longitudinal = (np.where(sample >= 0, own[sample], np.int8(-1)).astype(np.int8) for own in codes)
    return SceneBatch(
        scene=scene,
        vehicle_scene=vehicle_scene,
        vehicle_id=folder.run_vehicle_id[run],
        sample=sample,
        history=history,
        history_mask=history_mask,
        future=future,
        future_mask=future_mask,
        lateral=lateral,
        longitudinal=longitudinal,
        origin=origin,
        speed_mps=folder.speed_mps[row],
        lane=lane,
        lane_offset_m=(origin[:, 1] - centre_m).astype(np.float32),
        lane_width_m=width_m.astype(np.float32),
        has_left=lane > 1,
        has_right=(lane > 0) & (lane < folder.last_lane[subset]),
        absolute=absolute,
    )


def gather_nearest(folder: Folder, samples: npt.ArrayLike, *, nearest: int) -> tuple[ObservedScene[Any], Truth[Any]]:
    """Read samples (egos, by their numbers (B,)) with the `nearest` vehicles around them, in any order.

    Every vehicle of the scene counts, sample or not: whether it is one depends on its future. The nearest are those
    with the smallest distance between front centres; of two equally far the smaller id comes first.

    In the truth, `future` (B, V, F, 2) is relative to the EGO's last position; where masked, the vehicle's last known
    position again, and zeros where there is no vehicle. ValueError for a negative `nearest`.
    """
    if nearest < 0:
        raise ValueError(f"cannot gather the {nearest} nearest vehicles: expected 0 or more")
    sample = check_numbers(samples, folder.sample_row, "sample")
    xp = find_namespace(sample)
    row, present = find_nearest(folder, sample, nearest)
    run = find_runs(folder, row)
    history, history_mask = read_history(folder, row, folder.run_first_row[run])
    future, future_mask = read_future(folder, row, folder.run_first_row[run + 1] - 1)
    origin = folder.position_m[row[:, :1]]
    there = present[..., None, None]
    lanes, all_lanes = _describe_lanes(folder, cast(folder.sample_row[sample], "int64"))
    observed = ObservedScene(
        history=xp.where(there, to_relative(folder, history, origin), 0),
        history_mask=history_mask & present[..., None],
        vehicle_mask=present,
        size_m=xp.where(present[..., None], folder.run_size_m[run], 0),
        lanes=lanes,
        all_lanes=all_lanes,
    )
    truth = Truth(
        future=xp.where(there, to_relative(folder, future, origin), 0),
        future_mask=future_mask & present[..., None],
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
    )
    return observed, truth


def find_nearest(folder: Folder, sample: Array, nearest: int) -> tuple[Array, Array]:
    """Find the egos of samples (B,) int64 and the vehicles nearest to them; equal distances are ordered by id.

    Returns:
        (B, V) rows of the folder: the ego, the others by distance and, where there are fewer, the ego again; and (B, V)
        whether there is a vehicle.
    """
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
    return xp.where(present, take_columns(row, order), ego), present


def _describe_lanes(folder: Folder, row: Array) -> tuple[Array, Array]:
    """Return (B, 3, 3) the lanes left of, under and right of each ego, and (B, M, 3) all, see `ObservedScene`."""
    subset, adjacent = folder.run_subset[find_runs(folder, row)], folder.adjacent_lanes
    own = find_namespace(row).clip(cast(folder.lane[row], "int64"), 0, adjacent.shape[1] - 1)
    y_m = locate_rows(folder, row)[:, 1:]
    described = adjacent[subset, own], folder.all_lanes[subset]
    for lanes in described:
        lanes[..., 0] -= y_m * lanes[..., 2]
    return cast(described[0], "float32"), cast(described[1], "float32")


def read_samples(folder: Folder, samples: npt.ArrayLike, reads: Reads, *, nearest: int = NEAREST) -> Inputs:
    """Read samples by their numbers (B,) in any order, as arrays of the folder's kind and device.

    Of a mapped folder they are 0 <= number < S (else IndexError), of a device's copy int64 tensors there. A scene has
    V = 1 + nearest vehicles.
    """
    if reads == "grid":
        return part_batch(gather_samples(folder, samples))
    return gather_nearest(folder, samples, nearest=nearest)


def select_ego_truth(truth: Truth[Any]) -> Truth[Any]:
    """Return the truth of the samples themselves: of scenes, that of vehicle 0."""
    if truth.future.ndim == 3:
        return truth
    return Truth(truth.future[:, 0], truth.future_mask[:, 0], truth.lateral, truth.longitudinal)
