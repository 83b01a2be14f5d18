"""Slices of a long subset: frames that are worked on at once, with the frames around them on which they depend."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Integers


@dataclass(frozen=True)
class Slice:
    """Frames of a subset that are worked on at once.

    Args:
        first_frame: first frame that the slice owns; every row of a table belongs to the slice that owns its frame.
        end_frame: frame behind the last one that it owns.
        context: number of frames on either side that are read as well, so that what is computed of the own ones equals
            that of the whole subset.
    """

    first_frame: int
    end_frame: int
    context: int

    @property
    def name(self) -> str:
        """Name of its files, after the fingerprint; names in order are slices in order of time."""
        return f"{self.first_frame:09d}-{self.end_frame:09d}"

    def is_own(self, frame: pl.Expr) -> pl.Expr:
        """Return whether the slice owns a frame."""
        return (frame >= self.first_frame) & (frame < self.end_frame)

    def is_own_tick(self, tick: pl.Expr, *, first_frame: int, stride: float) -> pl.Expr:
        """Return whether the slice owns the frame of a tick.

        Bounds in whole ticks, one wider on each side, come first: unlike the frames, which need not be whole, they tell
        from the statistics of a file that all its ticks are of other times, and it is not read.

        Args:
            tick: whole numbers.
            first_frame: frame of tick 0.
            stride: number of frames that make a tick.
        """
        low = floor((self.first_frame - first_frame) / stride) - 1
        high = ceil((self.end_frame - first_frame) / stride) + 1
        return tick.is_between(low, high) & self.is_own(first_frame + tick * stride)

    def is_read(self, frame: pl.Expr) -> pl.Expr:
        """Return whether a frame is the slice's own or of its context."""
        return (frame >= self.first_frame - self.context) & (frame < self.end_frame + self.context)


def cut_frames(frames: Integers, rows: Integers, most_rows: int, context: int) -> Iterator[Slice]:
    """Cut a subset into slices that own all its frames, each of them once.

    With its context a slice holds at most `most_rows` rows, unless it owns no more frames than its context has: a
    shorter one would read more context than rows of its own.

    Args:
        frames: (F,) frames with rows, in order.
        rows: (F,) number of rows of each.
        most_rows: most rows of a slice with its context.
        context: number of frames on either side of a slice that it depends on.
    """
    before = np.concatenate([[0], np.cumsum(rows)])
    most_rows = min(most_rows, int(before[-1]))  # NumPy cannot add a number of more than 63 bits
    first, end_of_all = int(frames[0]), int(frames[-1]) + 1
    while first < end_of_all:
        read = before[np.searchsorted(frames, first - context)]
        fitting = int(np.searchsorted(before, read + most_rows, side="right")) - 1
        end = end_of_all if fitting == len(frames) else int(frames[fitting]) - context
        end = min(max(end, first + max(context, 1)), end_of_all)
        yield Slice(first, end, context)
        first = end


def list_windows(first: Integers, size: Integers, most_rows: int) -> Iterator[tuple[Integers, Integers, Integers]]:
    """Yield windows of time, in order, in which runs of consecutive frames have at most so many rows together.

    A frame is not divided. Of each window: the runs that reach into it, how many of each one's frames lie before it,
    and how many in it.

    Args:
        first: (R,) first frame of each run.
        size: (R,) number of its frames.
        most_rows: most rows of a window.
    """
    if not len(first):
        return
    zero, end = int(first.min()), first + size
    changes = np.bincount(first - zero, minlength=int(end.max()) - zero + 1)
    rows = np.cumsum(changes - np.bincount(end - zero, minlength=len(changes)))
    frames = np.flatnonzero(rows)
    for window in cut_frames(frames + zero, rows[frames], most_rows, 0):
        runs = np.flatnonzero((first < window.end_frame) & (end > window.first_frame))
        if len(runs) == 0:  # a gap between runs
            continue
        before = np.maximum(window.first_frame - first[runs], 0)
        yield runs, before, np.minimum(size[runs], window.end_frame - first[runs]) - before
