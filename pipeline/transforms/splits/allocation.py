"""The flow-balanced allocation of subsets to parts, and the one that leaves one block of each out of training.

No subset is in two parts, so the evaluation data cannot be reached from the training data. Among such allocations
the one is chosen whose parts differ least in the sample-weighted mean and standard deviation of `vehicles_per_lane_s`.
"""

from collections.abc import Sequence

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.splits.search import (
    FILLED,
    TOLERANCE,
    VEHICLES,
    Indices,
    Problem,
    find_allocation,
    sum_facts,
)
from tracklake.pipeline.transforms.splits.tables import COLUMNS, Allocation, add_defaults, tabulate_units
from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import UsageError
from tracklake.schemas.split_recipes import SplitRecipe


def allocate_flow_balanced(subsets: pl.DataFrame, recipe: SplitRecipe) -> Allocation:
    """Divide the subsets of each dataset into train and eval (and val) of alike traffic.

    Constraints, the most important first: train and eval each hold a subset with samples; each (site, direction) with
    at least two subsets has one in train and one in eval; val holds a subset with samples; train holds `train_share`
    of the vehicles and eval the rest (with a validation part train 0.1 less, and val 0.1), each +- 0.005.
    Coverage is counted in missing (site, direction, part), shares in vehicles. A constraint that cannot be met is
    `relaxed`, with the reason. Among the allocations that meet the constraints best, the one is chosen with the least
    sum, over pairs of parts, of the absolute differences of the weighted mean and of the weighted population standard
    deviation of `vehicles_per_lane_s`, which Hamalainen (2020) calls flow; among equals the one with the larger
    standard deviation in eval.

    If subsets are given in blocks, all of this applies to blocks.

    Up to 18 subsets (11 with a validation part) every allocation is tried: the optimum. Beyond, a local search starts
    from `restarts` random allocations of about the right shares and takes the best of all flips (one subset to another
    part) and swaps (two subsets of different parts) until none improves; then twice as often from the best allocation
    with a dozen subsets exchanged. With values of standard deviation s, a swap shifts the moments of an eval part of
    n / 5 subsets by about 5 s / n, and there are about n^2 / 6 swaps: the best of R descents ends about
    12 s / (n^2 sqrt R) from the target, for 117 subsets and s = 0.1 at 6e-6.

    `subsets` have one row per freeway subset that is not excluded, in any order: the columns of
    `splits.tables.COLUMNS`, and `block` if a subset has several rows. `weight` is the number of kept samples (of
    entries, before samples exist). A subset without vehicles_per_lane_s or with weight 0 counts for shares and
    coverage, not for the moments. With `validation` there is a third part, `val`. A dataset's result does not depend on
    other datasets.

    Raises:
        ValueError: a column is missing, a subset (or block) has two rows, a count is null or negative, or a part
            would have no share.

    Source: DESIGN section 8.
    """
    table = _check_subsets(subsets)
    shares = recipe.shares
    allocated = [table.with_columns(part=pl.lit(None, pl.String)).clear()]
    for (dataset,), rows in sorted(table.group_by("dataset"), key=lambda item: str(item[0][0])):
        random = np.random.default_rng([recipe.seed, *str(dataset).encode()])
        part = find_allocation(_build_problem(rows, shares), random, recipe.restarts)
        names = pl.Series("part", [list(shares)[position] for position in part], dtype=pl.String)
        allocated.append(rows.with_columns(names))
    return tabulate_allocation(pl.concat(allocated), recipe)


def leave_block_out(blocks: pl.DataFrame, recipe: SplitRecipe) -> Allocation:
    """Make the block `eval_block` of each subset its evaluation part; all others train.

    With a validation part, `val` is the block half the subset's blocks away, in subsets of at least three: next to
    eval, more vehicles would be in both and lost to both. A subset without that block is in train, but for `val`.

    `blocks` have the columns of `splits.tables.COLUMNS`, and `block`.

    Raises:
        UsageError: no subset has that block.
    """
    left_out = recipe.eval_block
    numbers = blocks["block"].to_list()
    if left_out is None or (numbers and left_out not in numbers):
        last = max(numbers, default=0)
        raise UsageError(f"setting split_eval_block: expected 0 to {last}, the last block there is, got {left_out}")
    count = pl.len().over("dataset", "subset")
    validates = (pl.col("block") == (left_out + count // 2) % count) & (count > 2) & recipe.validation
    part = pl.when(pl.col("block") == left_out).then(pl.lit(PARTS[2])).when(validates).then(pl.lit(PARTS[1]))
    return tabulate_allocation(blocks.with_columns(part=part.otherwise(pl.lit(PARTS[0]))), recipe)


def tabulate_allocation(units: pl.DataFrame, recipe: SplitRecipe) -> Allocation:
    """Build the tables of an allocation, and check by the given counts whether it is relaxed; none that was set is.

    `units` have the columns of `splits.tables.COLUMNS`, `part`, and `block` if a subset has several rows.
    """
    shares = recipe.shares
    units = add_defaults(units).sort("dataset", "site", "direction", "subset", "block")
    reasons: dict[str, str | None] = {}
    for (dataset,), rows in units.group_by("dataset") if recipe.eval_block is None else ():
        part = rows["part"].replace_strict(list(shares), range(len(shares)), return_dtype=pl.Int64).to_numpy()
        reasons[str(dataset)] = _describe_broken(rows, _build_problem(rows, shares), part.astype(np.intp), shares)
    return tabulate_units(units, split=recipe.name, parts=list(shares), reasons=reasons)


def _check_subsets(subsets: pl.DataFrame) -> pl.DataFrame:
    """Select and cast the needed columns in canonical order; an input that cannot be allocated is refused."""
    missing = [name for name in COLUMNS if name not in subsets.columns]
    if missing:
        raise ValueError(
            f"the table of subsets lacks the column(s) {', '.join(missing)}: expected {', '.join(COLUMNS)}, "
            f"got {', '.join(subsets.columns)}"
        )
    table = add_defaults(subsets).select(
        *(pl.col(name).cast(dtype) for name, dtype in COLUMNS.items()), pl.col("block").cast(pl.Int32)
    )
    bad = table.filter(
        pl.any_horizontal(pl.exclude("vehicles_per_lane_s").is_null())
        | (pl.col("vehicles") < 0)
        | (pl.col("weight") < 0)
        | (pl.col("vehicles_per_lane_s") < 0)
        | pl.col("vehicles_per_lane_s").is_infinite()
    )
    if bad.height:
        raise ValueError(
            "a subset needs a site, a direction, frames, vehicles_per_lane_s that is null or not negative, and counts "
            f"that are not negative: got {bad.row(0, named=True)} ({bad.height} such row(s))"
        )
    twice = table.filter(pl.struct("dataset", "subset", "block").is_duplicated())
    if twice.height:
        raise ValueError(f"the subset {twice['dataset'][0]}/{twice['subset'][0]} has more than one row")
    table = table.with_columns(pl.col("vehicles_per_lane_s").fill_nan(None))
    return table.sort("dataset", "site", "direction", "subset", "block")


def _build_problem(rows: pl.DataFrame, shares: dict[str, int]) -> Problem:
    """Build the arrays of one dataset's subsets."""
    weight = rows["weight"].to_numpy().astype(np.float64)
    rate = rows["vehicles_per_lane_s"].to_numpy().astype(np.float64)
    known = np.where(np.isnan(rate), 0.0, weight)
    rate = np.nan_to_num(rate)
    # Centred, so that the variance is not a small difference of large numbers.
    rate = rate - (rate @ known / known.sum() if known.sum() > 0 else 0.0)
    # If fewer than two subsets have samples, no part can be required to have some: then every subset counts as filled.
    filled = weight > 0 if (weight > 0).sum() > 1 else np.ones(len(weight), dtype=np.bool_)
    group = rows.select(pl.struct("site", "direction").rank("dense")).to_series().to_numpy().astype(np.intp) - 1
    return Problem(
        shares=np.array(list(shares.values()), dtype=np.float64),
        facts=np.stack(
            [rows["vehicles"].to_numpy().astype(np.float64), filled, known, known * rate, known * rate**2], axis=1
        ),
        group=group,
        paired=np.bincount(group) > 1,
    )


def _describe_broken(rows: pl.DataFrame, problem: Problem, part: Indices, shares: dict[str, int]) -> str | None:
    """Describe the constraints that the allocation breaks and by how much; None if it breaks none."""
    reasons: list[str] = []
    names: Sequence[str] = list(shares)
    sums = sum_facts(problem, part[None])[0]
    total = sums[:, VEHICLES].sum()
    empty = [name for name, filled in zip(names, sums[:, FILLED], strict=True) if filled == 0]
    if empty:
        reasons.append(f"{' and '.join(empty)} without samples ({rows.height} subset(s) to allocate)")
    for end in ("train", "eval"):
        lacking = (
            rows.group_by("site", "direction", maintain_order=True)
            .agg(pl.len().alias("subsets"), (pl.col("part") == end).any().alias("covered"))
            .filter((pl.col("subsets") > 1) & ~pl.col("covered"))
        )
        reasons += [f"no subset of {site} {direction} in {end}" for site, direction, *_ in lacking.iter_rows()]
    for name, share, vehicles in zip(names, shares.values(), sums[:, VEHICLES], strict=True):
        if abs(1000 * vehicles - share * total) > TOLERANCE * total:
            reasons.append(
                f"{name} holds {vehicles / total:.3f} of the vehicles instead of {share / 1000:.3f} "
                f"+- {TOLERANCE / 1000:.3f}"
            )
    return "; ".join(reasons) or None
