"""Scenes: every vehicle of one moment, found among the rows of a subset's tensors."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Scenes:
    """C scenes of M vehicles together, sorted by (block, tick).

    Args:
        offset: (C + 1,) vehicles of scene c are [offset[c], offset[c + 1]).
        block: (C,) the block that each scene stands in.
        row: (M,) rows of the vehicles, increasing within a scene.
        sample: (M,) number of the sample that the vehicle is there; -1 where it is none.
    """

    offset: Integers
    block: Integers
    row: Integers
    sample: Integers


def find_scenes(tick: Integers, block: Integers, sample: Integers) -> Scenes:
    """Gather rows by block and tick; moments at which nobody is a sample are left out.

    Args:
        tick: (N,) of rows sorted by (vehicle_id, tick), 0 to 2**31 - 1.
        block: (N,) of the split, 0 or more.
        sample: (N,) number of the sample that the row is; -1 where it is none.
    """
    moment = (block << 32) | tick
    row = np.argsort(moment, kind="stable")
    moment = moment[row]
    start = np.flatnonzero(np.diff(moment, prepend=-1))
    length = np.diff(start, append=len(row))
    # How many samples each moment has, from the running count of them.
    running = np.concatenate([[0], np.cumsum(sample[row] >= 0)])
    sampled = running[start + length] > running[start]
    row = row[np.repeat(sampled, length)]
    return Scenes(
        offset=np.concatenate([[0], np.cumsum(length[sampled])]),
        block=block[row[np.cumsum(length[sampled]) - length[sampled]]],
        row=row,
        sample=sample[row],
    )
