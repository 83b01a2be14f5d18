"""Split: which subsets train and which evaluate, by every requested recipe, and what the parts share."""

from typing import Any

import polars as pl

from tracklake.pipeline.lake import Manifest
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.split_leakage import Leakage, measure_leakage, open_tables, refuse_leaks
from tracklake.pipeline.stages.split_makers import SplitInputs, SplitResult, make_split
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.schemas import (
    SAMPLES,
    SPLIT_BALANCE,
    SPLIT_CONTEXT,
    SPLIT_LEAKAGE,
    SPLIT_LEFT_OUT,
    SPLIT_RECIPES,
    SPLIT_SHIFTS,
    SPLITS,
    SUBSET_STATUS,
    SUBSETS,
)
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.split_recipes import TIME_BLOCKS, SplitRecipe


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Divide the subsets that are not excluded by every recipe, and measure what the parts share.

    Raises:
        StageError: a split that claims to be free of leakage is not.
    """
    inputs = SplitInputs(reader, gather_subsets(reader, settings.get_protocol()), settings)
    made = {recipe: make_split(recipe, inputs) for recipe in settings.get_split_recipes()}
    measured = _measure_all(inputs, made)
    refuse_leaks(measured)
    trains, reason = _choose_training_split(made, settings)
    frames = {
        SPLITS: [split.allocation.splits for split in made.values()],
        SPLIT_BALANCE: [split.allocation.balance for split in made.values()],
        SPLIT_LEFT_OUT: [split.left_out for split in made.values()],
        SPLIT_RECIPES: [_describe_recipes(made, trains)],
        SPLIT_LEAKAGE: [found.leakage for found in measured.values()],
        SPLIT_CONTEXT: [found.context for found in measured.values()],
        SPLIT_SHIFTS: [found.shifts for found in measured.values()],
    }
    return StageResult(
        {table: pl.concat(parts).sort(table.key) for table, parts in frames.items()},
        info={"trains": trains},
        notes=reason
        + [note for recipe, split in made.items() for note in _write_notes(recipe, split, measured[recipe])],
    )


def find_training_split(manifest: Manifest, settings: Settings) -> str:
    """Return the name of the split that tensors are made of: the setting's, else what the lake's subsets allow."""
    made = manifest.commits.get(STAGE.name)
    return str((made.info if made is not None else {}).get("trains", settings.get_protocol().split))


def _choose_training_split(made: dict[SplitRecipe, SplitResult], settings: Settings) -> tuple[str, list[str]]:
    """Choose the split that tensors are made of, and a note where it is not the protocol's.

    Without a setting it is one in which something is left to evaluate on.
    """
    wanted = settings.get_protocol().split
    able = [recipe.name for recipe, split in made.items() if _can_evaluate(split)]
    if wanted in able or settings.split is not None or TIME_BLOCKS not in able:
        return wanted, []
    note = f"too few subsets for the split {wanted}, which would evaluate on nothing: tensors are made of {TIME_BLOCKS}"
    return TIME_BLOCKS, [note]


def _can_evaluate(split: SplitResult) -> bool:
    """Return whether both the training and the evaluation part hold samples."""
    counts = split.allocation.balance.group_by("part").agg(pl.col("samples").sum())
    sampled = counts.filter(pl.col("samples") > 0)["part"].to_list()
    return {"train", "eval"} <= set(sampled)


def gather_subsets(reader: LakeReader, protocol: Protocol) -> pl.DataFrame:
    """Return the freeway subsets that are not excluded, with the number of their samples.

    They have what `allocate_flow_balanced` reads, and recording, lanes, frame_rate_hz.
    """
    kept = (
        reader.scan(SAMPLES)
        .filter(pl.col("protocol") == protocol.name)
        .group_by("dataset", "subset")
        .agg(weight=pl.len().cast(pl.Int64))
    )
    shown = ("dataset", "subset", "recording", "site", "direction", "lanes", "frame_rate_hz", "vehicles", "weight")
    return (
        reader.scan(SUBSETS)
        .filter(pl.col("freeway"))
        .join(reader.scan(SUBSET_STATUS).select("dataset", "subset", "excluded"), on=["dataset", "subset"])
        .filter(~pl.col("excluded"))
        .join(kept, on=["dataset", "subset"], how="left")
        .with_columns(pl.col("weight").fill_null(0))
        .select(*shown, "vehicles_per_lane_s", "first_frame", "last_frame")
        .collect()
    )


def _measure_all(inputs: SplitInputs, made: dict[SplitRecipe, SplitResult]) -> dict[SplitRecipe, Leakage]:
    places = inputs.subsets.select(
        "dataset", "subset", "frame_rate_hz", "vehicles_per_lane_s", subset_first_frame="first_frame"
    )
    with open_tables(inputs.reader.root, inputs.reader.manifest) as connection:
        return {
            recipe: measure_leakage(
                connection,
                split.allocation.splits,
                split.left_out,
                places,
                recipe=recipe,
                protocol=inputs.protocol.name,
                rates=split.rates,
            )
            for recipe, split in made.items()
        }


def _describe_recipes(made: dict[SplitRecipe, SplitResult], trains: str) -> pl.DataFrame:
    """Return the rows of `split_recipes`."""
    rows = [
        {
            "split": recipe.name,
            "meaning": recipe.meaning,
            "claims_no_leakage": recipe.claims_no_leakage,
            "trains": recipe.name == trains,
            "window_s": recipe.window_s,
            "digest": recipe.digest,
            "parameters": recipe.parameters,
        }
        for recipe in made
    ]
    return pl.DataFrame(rows, schema=SPLIT_RECIPES.dtypes)


def _write_notes(recipe: SplitRecipe, made: SplitResult, measured: Leakage) -> list[str]:
    """Return what the user should know of a split: constraints that were relaxed, vehicles left out, leakage."""
    notes = [
        f"split {recipe.name} of {dataset} is relaxed: {reason}"
        for dataset, reason in sorted(made.allocation.relaxations.items())
    ]
    counted = made.left_out.group_by("dataset").agg(vehicles=pl.len(), entries=pl.col("entries").sum()).sort("dataset")
    notes += [
        f"split {recipe.name} of {dataset}: {vehicles:,} vehicle(s) in two parts give no samples and no context to val "
        f"and eval ({entries:,} entries)"
        for dataset, vehicles, entries in counted.iter_rows()
    ]
    if measured.find_leaks(recipe.window_s):
        notes.append(f"split {recipe.name}, made for comparison, leaks: {'; '.join(measured.summarise())}")
    return notes


def _describe_splits(settings: Settings) -> dict[str, Any]:
    return {
        "protocol": settings.get_protocol().digest,
        "splits": {recipe.name: recipe.digest for recipe in settings.get_split_recipes()},
        "seed": settings.split_seed,
        "asked": settings.split,  # a split that is asked for is taken, whatever it leaves to evaluate on
    }


STAGE = Stage(
    name="split",
    meaning="Divide the subsets into train and eval.",
    scope="lake",
    after=(INGEST, "validate", "samples"),
    settings=(_describe_splits, "validation_part"),
    version=4,
    build=build,
)
