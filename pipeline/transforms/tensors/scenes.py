"""Scenes: all vehicles of a subset's tensors at one tick."""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Integers, find_run_starts


@dataclass(frozen=True)
class Scenes:
    """C scenes with M vehicles in total, sorted by (block, tick); rows increase within a scene; a sample of -1 is none.

    The vehicles of scene c are [offset[c], offset[c + 1]).
    """

    offset: Integers
    block: Integers
    row: Integers
    sample: Integers


def find_scenes(tick: Integers, block: Integers, sample: Integers) -> Scenes:
    """Gather rows sorted by (vehicle_id, tick) by block and tick; scenes without samples (-1 = none) are left out."""
    scene = (block << 32) | tick
    row = np.argsort(scene, kind="stable")
    start = find_run_starts(scene[row])
    length = np.diff(start, append=len(row))
    # A scene has samples if their running count grows over it.
    running = np.concatenate([[0], np.cumsum(sample[row] >= 0)])
    sampled = running[start + length] > running[start]
    row = row[np.repeat(sampled, length)]
    return Scenes(
        offset=np.concatenate([[0], np.cumsum(length[sampled])]),
        block=block[row[np.cumsum(length[sampled]) - length[sampled]]],
        row=row,
        sample=sample[row],
    )
