"""Array operations that NumPy and torch spell differently, so that one gather serves both."""

from typing import Any

import numpy as np

from tracklake.schemas.arrays import expand_ranges

Array = Any
"""A NumPy array or a torch tensor; the arguments and results of one call are all of the same kind."""


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
    """List the members of ragged groups.

    Args:
        offset: the members of group g are offset[g] to offset[g + 1] - 1.
        groups: (B,) numbers of groups.

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
