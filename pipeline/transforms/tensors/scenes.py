"""Scenes: all vehicles of a subset's tensors at one tick."""

from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Integers, find_run_starts


def build_scene_arrays(
    row: Integers, block: Integers, tick: Integers, sample: Integers, part_of_block: Bytes
) -> dict[str, npt.NDArray[Any]]:
    """Gather rows by block and tick; scenes without samples are left out, rows increase within a scene.

    Args:
        row: (N,) numbers of the rows, increasing.
        block: (N,) their blocks.
        tick: (N,) their ticks.
        sample: (N,) number of the sample of each, -1 = none.
        part_of_block: part of each block.
    """
    scene = (block << 32) | tick
    order = np.argsort(scene, kind="stable")
    start = find_run_starts(scene[order])
    length = np.diff(start, append=len(order))
    # A scene has samples if their running count grows over it.
    running = np.concatenate([[0], np.cumsum(sample[order] >= 0)])
    sampled = running[start + length] > running[start]
    order = order[np.repeat(sampled, length)]
    return {
        "scene_offset": np.concatenate([[0], np.cumsum(length[sampled])]),
        "scene_row": row[order],
        "scene_sample": sample[order],
        "scene_part": part_of_block[block[order[np.cumsum(length[sampled]) - length[sampled]]]],
    }
