"""The contents of a tensor folder's `index.json`: sources, sizes and rounding errors of the arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tensors.arrays import SubsetTensors
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import LANE_CENTRES, NOMINAL_LANE_M, RECORDED_POSITIONS, TENSORS_VERSION


def describe_subset(facts: Mapping[str, Any], tensors: SubsetTensors) -> dict[str, Any]:
    """Describe a subset by `schemas.tensors.SUBSET_KEYS`; without lane_markings_m its lanes count."""
    markings = facts["lane_markings_m"]
    last_lane = len(markings) - 1 if markings else tensors.last_lane
    return {
        "dataset": facts["dataset"],
        "subset": facts["subset"],
        "origin": facts["origin"],
        "frame_rate_hz": facts["frame_rate_hz"],
        "centre_m": list(tensors.centre_m),
        "lane_markings_m": list(markings) if markings else None,
        "last_lane": last_lane,
        "width_m": float(markings[-1]) if markings else last_lane * NOMINAL_LANE_M,
        "lateral_positions": LANE_CENTRES if "y_m" in facts.get("columns_missing", ()) else RECORDED_POSITIONS,
    }


def describe_tensors(
    subsets: Sequence[Mapping[str, Any]],
    splits: pl.DataFrame,
    protocol: Protocol,
    *,
    storage: str,
    sizes: Mapping[str, int],
    samples_by_part: Sequence[int],
    max_error_m: Sequence[float],
    squared_error_m2: Sequence[float],
    split_recipe: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Describe the tensors by `schemas.tensors.INDEX_KEYS`.

    `subsets` are descriptions from `describe_subset`, in the order of `run_subset`; `splits` the split's rows of
    SPLITS, by which an evaluation proves that a model was trained on other data; sizes are by letter, errors along and
    across; `split_recipe` has digest, parameters, left_out_vehicles.
    """
    split = splits["split"].unique().sort()
    return {
        "version": TENSORS_VERSION,
        "split": split[0] if len(split) == 1 else protocol.split,
        "protocol": {**asdict(protocol), "scored_s": list(protocol.scored_s), "digest": protocol.digest},
        "storage": storage,
        "max_error_m": [float(error) for error in max_error_m],
        "rms_error_m": [float(np.sqrt(square / max(1, sizes["N"]))) for square in squared_error_m2],
        "subsets": [dict(subset) for subset in subsets],
        "blocks": splits.drop("split").sort("dataset", "subset", "block").to_dicts(),
        "sizes": dict(sizes),
        "samples_by_part": {part: int(count) for part, count in zip(PARTS, samples_by_part, strict=True)},
        "split_recipe": None if split_recipe is None else dict(split_recipe),
    }
