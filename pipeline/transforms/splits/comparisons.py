"""Splits for comparison: the one of published tables, and recordings drawn at random."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.csp.parts import assign_parts_by_id
from tracklake.pipeline.transforms.splits.tables import Allocation, tabulate_units
from tracklake.schemas.columns import PARTS
from tracklake.schemas.split_recipes import SplitRecipe


def divide_by_id(subsets: pl.DataFrame, vehicles: pl.DataFrame, recipe: SplitRecipe) -> Allocation:
    """Cut each subset at 70 and 80 % of its highest vehicle id, as conv-social-pooling's preprocessing does.

    Ids are numbered in the order of appearance, so the parts overlap in time and vehicles on either side of a cut are
    neighbors. A part without vehicles has no row.

    `subsets` have the columns of `splits.tables.COLUMNS`, `vehicles` dataset, subset, vehicle_id, weight (kept
    samples).

    Source: Deo and Trivedi 2018, `preprocess_data.m`.
    """
    units = [subsets.with_columns(part=pl.lit(None, pl.String)).clear()]
    for (dataset, subset), own in vehicles.group_by("dataset", "subset", maintain_order=True):
        codes = assign_parts_by_id(own["vehicle_id"].cast(pl.Int32).to_numpy())
        ranges = (
            own.with_columns(part=pl.Series([PARTS[code] for code in codes], dtype=pl.String))
            .group_by("part")
            .agg(
                vehicles=pl.len().cast(pl.Int64),
                weight=pl.col("weight").sum().cast(pl.Int64),
                first_vehicle_id=pl.col("vehicle_id").min().cast(pl.Int32),
                last_vehicle_id=pl.col("vehicle_id").max().cast(pl.Int32),
            )
            .sort("first_vehicle_id")
            .with_row_index("block")
        )
        whole = subsets.filter((pl.col("dataset") == dataset) & (pl.col("subset") == subset))
        units.append(whole.drop("vehicles", "weight").join(ranges, how="cross"))
    return tabulate_units(pl.concat(units, how="diagonal_relaxed"), split=recipe.name, parts=PARTS)


def divide_by_recording(subsets: pl.DataFrame, recipe: SplitRecipe) -> Allocation:
    """Assign recordings to parts at random, each with all its subsets, by the shares of the flow-balanced split.

    Shares are of recordings, rounded, but at least one of two recordings is in eval, and one of three in val.

    `subsets` have the columns of `splits.tables.COLUMNS` and `recording`. A dataset's draw does not depend on other
    datasets.

    Raises:
        ValueError: a part would have no share.
    """
    shares = recipe.shares
    drawn = [pl.DataFrame(schema={"dataset": pl.String, "recording": pl.String, "part": pl.String})]
    for (dataset,), rows in subsets.group_by("dataset"):
        names = rows["recording"].unique().sort()
        order = np.random.default_rng([recipe.seed, *str(dataset).encode()]).permutation(len(names))
        parts: list[str] = []
        for part in reversed(shares):  # eval first; train gets the rest
            wanted = max(1, round(len(names) * shares[part] / 1000)) if part != "train" else len(names)
            parts += [part] * min(wanted, len(names) - len(parts) - (part != "train"))
        drawn.append(
            pl.DataFrame({"recording": names.gather(order), "part": parts}).with_columns(dataset=pl.lit(dataset))
        )
    units = subsets.join(pl.concat(drawn, how="diagonal"), on=["dataset", "recording"])
    return tabulate_units(units, split=recipe.name, parts=list(shares))
