"""What was expected of the models, and what came: seed by seed, on everything and on each data set."""

from collections.abc import Mapping

import polars as pl
from study_plan import CLAIMS, Claim
from study_tables import FEW, grid, pick

from tracklake.schemas.evaluations import EVERYTHING

WHERE = {EVERYTHING: "all", "ngsim": "NGSIM-like", "highd": "highD-like"}
HOW = """\
A comparison is of one model with another, at one horizon, by one figure. It counts as *better* where the model is
better for every seed (against the same seed of the other), as *worse* where it is worse for every seed, and as *mixed*
else."""


def judge(scored: Mapping[str, pl.DataFrame], seeds: int) -> str:
    """The table of claims, and every comparison that did not come out better.

    Args:
        scored: rows by arm, at the protocols' seconds.
        seeds: of each learned model.
    """
    body, misses = [], []
    for claim in CLAIMS:
        for dataset, title in WHERE.items():
            if claim.arm not in scored or dataset not in set(scored[claim.arm]["dataset"].unique()):
                continue
            if dataset != EVERYTHING and scored[claim.arm]["dataset"].n_unique() < 3:
                continue  # all there is
            found = compare(claim, pick(scored[claim.arm], dataset), seeds)
            counts = [sum(own["outcome"] == outcome for own in found) for outcome in ("better", "mixed", "worse")]
            body.append([claim.text, claim.arm, title, verdict(claim, counts), *map(str, counts)])
            misses += [
                [
                    claim.arm,
                    title,
                    f"`{own['model']}`",
                    f"`{claim.worse}`",
                    f"{own['seconds']:g} s",
                    own["figure"],
                    *(f"{own[side]:.3f}" for side in ("mean", "limit")),
                    own["outcome"],
                ]
                for own in found
                if own["outcome"] != "better"
            ]
    heads = ["expected", "arm", "on", "holds", "better", "mixed", "worse"]
    against = ["arm", "on", "model", "against", "at", "figure", "mean", "its mean", "outcome"]
    return (
        f"## What was expected, and what came\n\n{HOW}\n\n{grid(heads, body)}\n\nWhat did not come out better:\n\n"
        f"{grid(against, misses)}"
    )


def verdict(claim: Claim, counts: list[int]) -> str:
    """Yes where every comparison is better (where `equal`: none is worse), no where one is worse, else mixed."""
    better, mixed, worse = counts
    if better + mixed + worse == 0:
        return "no samples"
    if worse:
        return "no"
    return "yes" if not mixed or claim.equal else "mixed"


def compare(claim: Claim, rows: pl.DataFrame, seeds: int) -> list[dict[str, object]]:
    """Every comparison of a claim that has samples enough.

    Raises:
        ValueError: a learned model lacks a seed.
    """
    found = []
    for figure in claim.figures:
        for seconds in claim.seconds:
            here = rows.filter((pl.col("seconds") == seconds) & (pl.col("n") >= FEW))
            limit = by_seed(here, claim.worse, figure)
            for model in claim.better:
                got = by_seed(here, model, figure)
                if not got or not limit:
                    continue
                if len(got) != seeds or len(limit) not in (1, seeds):
                    raise ValueError(f"{model} or {claim.worse}: expected {seeds} seeds, got {len(got)}, {len(limit)}")
                wins = sum(value < limit.get(seed, limit[0]) for seed, value in got.items())
                outcome = {len(got): "better", 0: "worse"}.get(wins, "mixed")
                means = {"mean": sum(got.values()) / len(got), "limit": sum(limit.values()) / len(limit)}
                found.append({"model": model, "figure": figure, "seconds": seconds, "outcome": outcome, **means})
    return found


def by_seed(rows: pl.DataFrame, model: str, figure: str) -> dict[int, float]:
    """A model's figure by seed; one that does not learn has seed 0 alone."""
    own = rows.filter((pl.col("model") == model) & pl.col(figure).is_not_null())
    return dict(zip(own["seed"].to_list(), own[figure].to_list(), strict=True))
