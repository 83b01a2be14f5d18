"""Context that `export csp --clean` reads from the lake: the parts, late starts and excluded subsets."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import polars as pl

from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.lake import Manifest, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.split import find_training_split, gather_subsets
from tracklake.pipeline.stages.split_makers import SplitInputs, make_split
from tracklake.pipeline.transforms.csp.subset import CleanContext
from tracklake.schemas import MISSING_STARTS, SPLITS, SUBSET_STATUS, VEHICLE_STARTS
from tracklake.schemas.columns import PARTS
from tracklake.schemas.split_recipes import LEAKAGE_FREE

Contexts = dict[tuple[str, str], CleanContext | None]


def read_context(
    settings: Settings, manifest: Manifest, subsets: Sequence[dict[str, Any]], notes: list[str]
) -> Contexts:
    """Read the context of every subset; None for a subset that validation excludes.

    The files have three parts. The lake's split (setting `split`) is used if it has a validation part; else a split is
    planned with `validation_part = true`.

    Raises:
        StageError: validation, repair, samples or the split has not run, or its inputs have changed.
        ExportError: the parts of the split share data.
    """
    root, protocol = settings.lake, settings.get_protocol()
    if protocol.split not in LEAKAGE_FREE:
        raise ExportError(
            f"--clean needs a split whose parts share nothing, and the setting `split` is {protocol.split!r}. Set it "
            f"to one of {', '.join(LEAKAGE_FREE)}, or leave --clean out: the files are then cut by vehicle id."
        )
    Planner(root, manifest, settings).require("split")
    names = {facts["dataset"] for facts in subsets}
    name = find_training_split(manifest, settings)
    splits = scan(root, manifest, SPLITS).filter(split=name).collect()
    parts = splits.select("dataset", "part").unique().rows()
    if not {(dataset, part) for dataset in names for part in PARTS} <= set(parts):
        recipe = settings.get_split_recipe(name)
        reader = LakeReader(root, manifest)
        inputs = SplitInputs(reader, gather_subsets(reader, protocol), settings)
        allocation = make_split(replace(recipe, validation=True), inputs).allocation
        splits = allocation.splits
        notes.append(
            f"the lake's split {name} has no validation part; the files hold the split that "
            "`validation_part = true` makes: TestSet.mat is not the lake's eval part, and TrainSet.mat may hold some "
            "of it"
        )
        notes += [
            f"split of {dataset} is relaxed: {reason}"
            for dataset, reason in sorted(allocation.relaxations.items())
            if dataset in names
        ]
    excluded = set(scan(root, manifest, SUBSET_STATUS).filter("excluded").select("dataset", "subset").collect().rows())
    found: Contexts = {}
    for facts in subsets:
        values = {"dataset": facts["dataset"], "subset": facts["subset"]}
        key = (facts["dataset"], facts["subset"])
        found[key] = (
            None
            if key in excluded
            else CleanContext(
                blocks=splits.filter(pl.col("dataset") == key[0], pl.col("subset") == key[1]),
                vehicle_starts=scan(root, manifest, VEHICLE_STARTS, **values).collect(),
                missing_starts=scan(root, manifest, MISSING_STARTS, **values).collect(),
            )
        )
    return found
