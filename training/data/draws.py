"""In which order samples (or scenes) are read, and how they fall into batches."""

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]

SCANNED = 2**20
"""Samples looked at together where the order is their own."""


def draw_numbers(
    parts: npt.NDArray[np.uint8],
    part: int,
    batch_size: int,
    *,
    shuffle_seed: int | None = None,
    shuffle_block: int | None = None,
) -> Iterator[Integers]:
    """Numbers of all samples of one part, batch by batch; the last batch may be smaller.

    Args:
        parts: (S,) the part of each sample.
        part: which one.
        batch_size: B.
        shuffle_seed: draws the order; None = increasing.
        shuffle_block: shuffle blocks of so many successive samples, and the samples inside a block, instead of
            everything: reads stay within a block, and no list of all samples is held in memory. None = everything.

    Raises:
        ValueError: a batch or block of no samples.
    """
    if batch_size < 1 or (shuffle_block is not None and shuffle_block < 1):
        raise ValueError(f"expected batches and blocks of at least 1, got {batch_size} and {shuffle_block}")
    random = np.random.default_rng(shuffle_seed) if shuffle_seed is not None else None
    if random is not None and shuffle_block is None:
        # Four bytes a sample: the one thing that grows with the dataset.
        everything = np.flatnonzero(parts == part).astype(np.int32)
        random.shuffle(everything)
        return _cut([everything], batch_size)
    return _cut(_blocks(parts, part, shuffle_block or SCANNED, random), batch_size)


def _blocks(
    parts: npt.NDArray[np.uint8], part: int, block: int, random: np.random.Generator | None
) -> Iterator[npt.NDArray[np.int32]]:
    """Numbers of a part, block by block."""
    order = np.arange(-(-len(parts) // block))
    if random is not None:
        random.shuffle(order)
    for start in order * block:
        found = (np.flatnonzero(parts[start : start + block] == part) + start).astype(np.int32)
        if random is not None:
            random.shuffle(found)
        yield found


def _cut(pieces: Iterable[npt.NDArray[np.int32]], size: int) -> Iterator[Integers]:
    """Join pieces and cut them into batches."""
    left = np.empty(0, dtype=np.int32)
    for piece in pieces:
        numbers = np.concatenate([left, piece]) if len(left) else piece
        whole = len(numbers) // size * size
        for start in range(0, whole, size):
            yield numbers[start : start + size].astype(np.int64)
        left = numbers[whole:].copy()
    if len(left):
        yield left.astype(np.int64)
