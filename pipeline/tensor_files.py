"""Tensor folders on disk: one `.npy` per array, and `index.json`."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from schemas.tensors import ARRAYS

INDEX = "index.json"


def write_tensors(folder: Path, arrays: Mapping[str, np.ndarray], index: Mapping[str, Any]) -> None:
    """Write a tensor folder.

    Args:
        folder: exists and is empty; the lake makes it visible, whole, afterwards.
        arrays: one per name of `schemas.tensors.ARRAYS`, of its dtype.
        index: what `index.json` holds, see `pipeline.transforms.tensors.describe_tensors`.

    Raises:
        ValueError: an array is missing or not of the declared dtype.
    """
    for declared in ARRAYS:
        found = arrays[declared.name].dtype if declared.name in arrays else "nothing"
        if found != np.dtype(declared.dtype):
            raise ValueError(f"{folder}: array `{declared.name}`: expected {declared.dtype}, got {found}")
    for declared in ARRAYS:
        np.save(folder / f"{declared.name}.npy", arrays[declared.name], allow_pickle=False)
    (folder / INDEX).write_text(json.dumps(index, indent=1), encoding="utf-8")
