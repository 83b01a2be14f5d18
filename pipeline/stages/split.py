"""Split: which subsets train and which evaluate, by every requested recipe, and what the parts share."""

from typing import Any

import polars as pl

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
from tracklake.schemas.split_recipes import MEANINGS, SplitRecipe


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Divide the subsets that are not excluded by every recipe, and measure what the parts share.

    Raises:
        StageError: a split that claims to be free of leakage is not.
    """
    inputs = SplitInputs(reader, gather_subsets(reader, settings.get_protocol()), settings.get_protocol())
    made = {recipe: make_split(recipe, inputs) for recipe in settings.get_split_recipes()}
    measured = _measure_all(inputs, made)
    refuse_leaks(measured)
    frames = {
        SPLITS: [split.allocation.splits for split in made.values()],
        SPLIT_BALANCE: [split.allocation.balance for split in made.values()],
        SPLIT_LEFT_OUT: [split.left_out for split in made.values()],
        SPLIT_RECIPES: [_describe_recipes(made, inputs.protocol)],
        SPLIT_LEAKAGE: [found.leakage for found in measured.values()],
        SPLIT_CONTEXT: [found.context for found in measured.values()],
        SPLIT_SHIFTS: [found.shifts for found in measured.values()],
    }
    return StageResult(
        {table: pl.concat(parts).sort(table.key) for table, parts in frames.items()},
        notes=[note for recipe, split in made.items() for note in _write_notes(recipe, split, measured[recipe])],
    )


def gather_subsets(reader: LakeReader, protocol: Protocol) -> pl.DataFrame:
    """Return the freeway subsets that are not excluded, with the number of their samples.

    Returns:
        What `allocate_flow_balanced` reads, and recording, lanes, frame_rate_hz.
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


def _describe_recipes(made: dict[SplitRecipe, SplitResult], protocol: Protocol) -> pl.DataFrame:
    """Return the rows of `split_recipes`."""
    rows = [
        {
            "split": recipe.name,
            "meaning": MEANINGS[recipe.name],
            "claims_no_leakage": recipe.claims_no_leakage,
            "trains": recipe.name == protocol.split,
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
    }


STAGE = Stage(
    name="split",
    meaning="Divide the subsets into train and eval.",
    scope="lake",
    after=(INGEST, "validate", "samples"),
    settings=(_describe_splits, "validation_part"),
    version=3,
    build=build,
)
