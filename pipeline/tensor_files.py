"""Tensor folders on disk: one `.npy` per array, and `index.json`, written last, that makes the folder valid."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from schemas.tensors import ARRAYS

INDEX = "index.json"


def write_tensors(folder: Path, arrays: Mapping[str, np.ndarray], index: Mapping[str, Any]) -> None:
    """Write a tensor folder.

    Each file is written aside, synced and renamed, so that a reader who has the old one mapped keeps it; `index.json`
    comes last: a folder without it was left unfinished and is to be written again.

    Args:
        folder: made where it does not exist.
        arrays: one per name of `schemas.tensors.ARRAYS`, of its dtype.
        index: what `index.json` holds, see `pipeline.transforms.tensors.describe_tensors`.

    Raises:
        ValueError: an array is missing or not of the declared dtype.
    """
    for declared in ARRAYS:
        found = arrays[declared.name].dtype if declared.name in arrays else "nothing"
        if found != np.dtype(declared.dtype):
            raise ValueError(f"{folder}: array `{declared.name}`: expected {declared.dtype}, got {found}")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / INDEX).unlink(missing_ok=True)
    for declared in ARRAYS:
        aside = folder / f"{declared.name}.npy.partial"
        with aside.open("wb") as file:
            np.save(file, arrays[declared.name], allow_pickle=False)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(folder / f"{declared.name}.npy")
    aside = folder / f"{INDEX}.partial"
    with aside.open("w", encoding="utf-8") as text:
        json.dump(index, text, indent=1)
        text.flush()
        os.fsync(text.fileno())
    aside.replace(folder / INDEX)
