"""Runs that differ in their seed alone, so that one comparison covers all of them."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from tracklake.schemas.comparisons import COMPARED_FIGURES, COMPARISONS, VEHICLE_ERRORS
from tracklake.schemas.errors import UsageError
from tracklake.training.comparison.bootstrap import compare_errors
from tracklake.training.evaluation.evaluate import Evaluation
from tracklake.training.runs.run_folder import UNCHANGING

IGNORED_SETTINGS = UNCHANGING | {"seed"}
"""Settings of a training in which the runs of one arm may differ."""


def group_arms(evaluations: Sequence[Evaluation]) -> dict[str, list[Evaluation]]:
    """Group evaluations of runs that differ in the seed alone; each group is named after its first run."""
    arms: dict[str, list[Evaluation]] = {}
    for own in evaluations:
        arms.setdefault(_identify(own), []).append(own)
    return {group[0].model + (f" ({len(group)} seeds)" if len(group) > 1 else ""): group for group in arms.values()}


def _identify(evaluation: Evaluation) -> str:
    """Describe what a run is without its seed."""
    run: Mapping[str, Any] = evaluation.run
    if not run.get("recipe"):
        return evaluation.model
    training = {name: value for name, value in run["training"].items() if name not in IGNORED_SETTINGS}
    own = {name: value for name, value in run.items() if name != "versions"} | {"training": training}
    return json.dumps([own, evaluation.nearest], sort_keys=True)


def compare_arms(evaluations: Sequence[Evaluation]) -> pl.DataFrame:
    """Compare the first arm with every other one: rows of `schemas.comparisons.COMPARISONS`.

    Raises:
        UsageError: there are not two arms, or two runs of an arm have the same seed.
        SamplesDifferError: the arms are not of the same samples.
    """
    arms = {name: _join(name, group) for name, group in group_arms(evaluations).items()}
    if len(arms) < 2:
        named = ", ".join(own.model for own in evaluations)
        found = f"{named} differ in their seed alone" if len(evaluations) > 1 else f"there is {named or 'none'} alone"
        raise UsageError(f"a comparison needs two models, but {found}: name another run or model")
    (a, own), *others = arms.items()
    tables = [
        compare_errors(own, other, figure).with_columns(a=pl.lit(a), b=pl.lit(b), figure=pl.lit(figure))
        for b, other in others
        for figure, sums in COMPARED_FIGURES.items()
        if not any(one[name].has_nulls() for one in (own, other) for name in sums)
    ]
    return COMPARISONS.conform(pl.concat(tables).lazy()).sort(COMPARISONS.key).collect()


def _join(arm: str, group: Sequence[Evaluation]) -> pl.DataFrame:
    """Join the errors of an arm's runs; UsageError where two have the same seed."""
    errors = pl.concat([VEHICLE_ERRORS.empty(), *(own.to_vehicle_errors() for own in group)])
    if errors["seed"].n_unique() < len(group):
        raise UsageError(f"{arm}: two of the runs {', '.join(own.model for own in group)} have the same seed")
    return errors
