"""Positions of rows and their histories and futures, read by one gather for NumPy arrays and torch tensors."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Integers, expand_ranges

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder

Array = Any
"""A NumPy array or a torch tensor; the arguments and results of one call are all of the same kind."""
Folder: TypeAlias = "TensorFolder | DeviceFolder"
"""Holder of the arrays of a tensor folder, all NumPy's or all torch's."""


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
    """List the members of ragged groups (B,), of which group g has the members offset[g] to offset[g + 1] - 1.

    Returns:
        (K,) members, in the order of `groups`; and (K,) positions in `groups`, increasing.
    """
    first = offset[groups]
    count = offset[groups + 1] - first
    if isinstance(count, np.ndarray):
        return expand_ranges(first, count)
    owner = find_namespace(count).repeat_interleave(count)
    before = count.cumsum(0) - count
    return count_from(0, len(owner), owner) + (first - before)[owner], owner


def check_numbers(numbers: npt.ArrayLike, count: int, what: str) -> Integers:
    """Return numbers (B,) of samples or scenes as int64.

    Raises:
        IndexError: one is not 0 to count - 1; NumPy would count a negative one from the end.
    """
    checked = np.asarray(numbers, dtype=np.int64)
    if len(checked) and (checked.min() < 0 or checked.max() >= count):
        raise IndexError(f"{what}s are numbered 0 to {count - 1}, got {checked.min()} to {checked.max()}")
    return checked


def find_runs(folder: Folder, row: Array) -> Array:
    """Return the run that each row stands in."""
    return find_namespace(row).searchsorted(folder.run_first_row, row, side="right") - 1


def read_history(folder: Folder, row: Array, first: Array) -> tuple[Array, Array]:
    """Read the positions of the H ticks up to rows (...); ticks before the `first` known rows repeat their position.

    Returns:
        (..., H, 2) positions as stored, and (..., H) True where the position is known.
    """
    rows = row[..., None] + count_from(1 - folder.protocol.history_ticks, 1, row)
    return _read(folder, find_namespace(row).maximum(rows, first[..., None])), rows >= first[..., None]


def read_future(folder: Folder, row: Array, last: Array) -> tuple[Array, Array]:
    """Read the positions of the F ticks after rows (...); ticks after the `last` known rows repeat their position.

    Returns:
        (..., F, 2) positions as stored, and (..., F) True where the position is known.
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
