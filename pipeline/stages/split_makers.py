"""The functions that make each split of `schemas.split_recipes` from the lake."""

from collections.abc import Callable
from dataclasses import dataclass

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.transforms.splits.allocation import (
    allocate_flow_balanced,
    leave_block_out,
    tabulate_allocation,
)
from tracklake.pipeline.transforms.splits.comparisons import divide_by_id, divide_by_recording
from tracklake.pipeline.transforms.splits.tables import Allocation
from tracklake.pipeline.transforms.splits.time_blocks import (
    VISITS,
    WEIGHTS,
    count_samples,
    cut_blocks,
    describe_blocks,
    find_left_out,
    find_visits,
    recount_blocks,
)
from tracklake.schemas import SAMPLES, SPLIT_LEFT_OUT, TRACKS, VEHICLES
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.split_recipes import BY_RECORDING, CSP_2018, FLOW_BALANCED, TIME_BLOCKS, SplitRecipe


@dataclass(frozen=True)
class SplitInputs:
    """The reader of the lake's tables, the subsets to split, and the settings.

    Subsets are the freeway ones not excluded: the columns of `splits.tables.COLUMNS`, and recording, lanes,
    frame_rate_hz.
    """

    reader: LakeReader
    subsets: pl.DataFrame
    settings: Settings

    @property
    def protocol(self) -> Protocol:
        """The protocol whose samples count."""
        return self.settings.get_protocol()


@dataclass(frozen=True)
class SplitResult:
    """A split as tables: `splits` and `split_balance`, `split_left_out`, and rates of blocks with their own."""

    allocation: Allocation
    left_out: pl.DataFrame
    rates: pl.DataFrame | None = None


def make_split(recipe: SplitRecipe, inputs: SplitInputs) -> SplitResult:
    """Make one split of the lake's subsets."""
    return _MAKERS[recipe.name](recipe, inputs)


def _make_time_blocks(recipe: SplitRecipe, inputs: SplitInputs) -> SplitResult:
    blocks = cut_blocks(inputs.subsets, block_s=recipe.block_s, purge_s=recipe.purge_s)
    visits, weights = [pl.DataFrame(schema=VISITS)], [pl.DataFrame(schema=WEIGHTS)]
    for facts in inputs.subsets.sort("dataset", "subset").iter_rows(named=True):
        reader = inputs.reader.open_subset(facts["dataset"], facts["subset"])
        own = blocks.filter(pl.col("dataset") == facts["dataset"], pl.col("subset") == facts["subset"])
        stride = facts["frame_rate_hz"] / recipe.rate_hz
        for part in reader.cut(inputs.settings, 0):
            visits.append(find_visits(part.table(TRACKS, "vehicle_id", "frame"), own))
            rows = reader.scan(SAMPLES).filter(pl.col("protocol") == inputs.protocol.name)
            if part.slice is not None:
                is_own = part.slice.is_own_tick(pl.col("tick"), first_frame=facts["first_frame"], stride=stride)
                rows = rows.filter(is_own)
            weights.append(
                count_samples(
                    rows.select("vehicle_id", "tick").collect(),
                    own,
                    stride=stride,
                    first_frame=facts["first_frame"],
                    history=round(recipe.history_s * recipe.rate_hz) * stride,
                    future=recipe.min_future_ticks * stride,
                )
            )
    seen, sampled = _add_up(visits, "entries"), _add_up(weights, "weight")
    units = describe_blocks(blocks, inputs.subsets, seen, sampled)
    allocation = (allocate_flow_balanced if recipe.eval_block is None else leave_block_out)(units, recipe)
    left_out = find_left_out(seen, allocation.splits)
    # The search counts a vehicle in every block in which it is; what the parts hold is known only afterwards.
    recounted = recount_blocks(units, allocation.splits, left_out, seen, sampled)
    written = tabulate_allocation(recounted, recipe)
    return SplitResult(written, left_out, units.select("dataset", "subset", "block", "vehicles_per_lane_s"))


def _add_up(counts: list[pl.DataFrame], count: str) -> pl.DataFrame:
    """Add up what slices of a subset count of one vehicle in one block; sorted."""
    joined = pl.concat(counts)
    key = [name for name in joined.columns if name != count]
    return joined.group_by(key).agg(pl.col(count).sum()).sort(key)


def _make_csp(recipe: SplitRecipe, inputs: SplitInputs) -> SplitResult:
    kept = (
        inputs.reader.scan(SAMPLES)
        .filter(pl.col("protocol") == inputs.protocol.name)
        .group_by("dataset", "subset", "vehicle_id")
        .agg(weight=pl.len().cast(pl.Int64))
    )
    vehicles = (
        inputs.reader.scan(VEHICLES)
        .select("dataset", "subset", "vehicle_id")
        .join(inputs.subsets.lazy().select("dataset", "subset"), on=["dataset", "subset"], how="semi")
        .join(kept, on=["dataset", "subset", "vehicle_id"], how="left")
        .with_columns(pl.col("weight").fill_null(0))
        .collect()
        .sort("dataset", "subset", "vehicle_id")
    )
    return SplitResult(divide_by_id(inputs.subsets, vehicles, recipe), SPLIT_LEFT_OUT.empty())


_MAKERS: dict[str, Callable[[SplitRecipe, SplitInputs], SplitResult]] = {
    FLOW_BALANCED: lambda recipe, inputs: SplitResult(
        allocate_flow_balanced(inputs.subsets, recipe), SPLIT_LEFT_OUT.empty()
    ),
    TIME_BLOCKS: _make_time_blocks,
    CSP_2018: _make_csp,
    BY_RECORDING: lambda recipe, inputs: SplitResult(
        divide_by_recording(inputs.subsets, recipe), SPLIT_LEFT_OUT.empty()
    ),
}
