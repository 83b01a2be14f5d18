"""The study's page: figures as mean and spread over seeds, what was expected of them and whether it is so."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
from study_forest import describe_forest
from study_plan import CLAIMS, PLAIN, Arm, Claim
from study_tables import grid, order, show

from schemas.evaluations import EVERYTHING, FIGURES
from schemas.protocols import PROTOCOLS
from training.error_figure import draw_error_growth

EVALUATIONS = "evaluations.csv"
DATASETS = {"ngsim": "NGSIM-like", "highd": "highD-like"}
DRAWN = ("constant-velocity", "v-lstm", "cs-lstm", "cs-lstm-m")


@dataclass(frozen=True)
class Study:
    """What was run.

    Args:
        arms: those that were.
        work: the study's folder.
        digest: of the plan.
        plan: its options.
        commit: of the code.
        seconds: of work, interruptions not counted.
        command: that repeats it.
    """

    arms: Sequence[Arm]
    work: Path
    digest: str
    plan: dict[str, Any]
    commit: str
    seconds: float
    command: str


def write_page(out: Path, study: Study) -> None:
    """Write the page, its figure and the table behind both, beside each other."""
    rows = {arm.name: read_rows(study.work / arm.name / EVALUATIONS) for arm in study.arms}
    figure, table = out.with_suffix(".svg"), out.with_suffix(".csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    curves = rows[study.arms[0].name].filter(
        (pl.col("group") == EVERYTHING)
        & (pl.col("average") == "samples")
        & pl.col("dataset").is_in(list(DATASETS))
        & pl.col("model").is_in(DRAWN)
    )
    curves = curves.select(
        "model", pl.col("dataset").replace_strict(DATASETS), "seed", pl.col("seconds").cast(pl.Float64), "rmse_m"
    ).sort(pl.col("model").replace_strict(list(DRAWN), range(len(DRAWN))), "dataset", "seed", "seconds")
    figure.write_bytes(draw_error_growth(curves).render(figure.suffix))
    joined = pl.concat(
        summarise(at_scored(own, arm)).select(pl.lit(arm.name).alias("arm"), pl.all())
        for arm, own in zip(study.arms, rows.values(), strict=True)
    )
    joined.write_csv(table, float_precision=4)
    parts = [
        introduce(study),
        judge(study, rows),
        f"## Errors over the horizon\n\n![RMSE and its growth over the horizon]({figure.name})\n\nProtocol "
        f"`{study.arms[0].protocol}`; the line is the mean over seeds, the band their range.",
        *(describe_arm(arm, rows[arm.name], study.work / arm.name) for arm in study.arms),
    ]
    out.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def read_rows(file: Path) -> pl.DataFrame:
    """Measured rows of an evaluation; `model` without the seed, which is a column of its own."""
    return (
        pl.read_csv(file, infer_schema_length=None)
        .filter(pl.col("origin") == "measured")
        .with_columns(
            seed=pl.col("model").str.extract(r"-seed(\d+)$").cast(pl.Int64).fill_null(0),
            model=pl.col("model").str.replace(r"-seed\d+$", ""),
            **{name: pl.col(name).cast(pl.Float64) for name in (*FIGURES, "latency_ms")},
        )
    )


def at_scored(rows: pl.DataFrame, arm: Arm) -> pl.DataFrame:
    """Rows at the protocol's own seconds only."""
    return rows.filter(pl.col("seconds").is_in(PROTOCOLS[arm.protocol].scored_s))


def summarise(rows: pl.DataFrame) -> pl.DataFrame:
    """Mean and standard deviation over seeds of every figure."""
    keys = ("model", "dataset", "group", "average", "seconds")
    figures = (*FIGURES, "latency_ms")
    return rows.group_by(keys, maintain_order=True).agg(
        pl.col("n").first(),
        seeds=pl.len(),
        **{name: pl.col(name).mean() for name in figures},
        **{f"{name}_sd": pl.col(name).std() for name in figures},
    )


def introduce(study: Study) -> str:
    """What this is and how it is made again."""
    options = study.plan
    digests = ", ".join(f"`{arm.protocol}` {PROTOCOLS[arm.protocol].digest}" for arm in study.arms)
    return f"""\
# Results

Written by `{study.command}` at commit {study.commit}; plan {study.digest}; protocols {digests}. Do not edit: what the
figures say is discussed in [results-discussion.md](results-discussion.md), and all rows are in
[results.csv](results.csv).

{options["seeds"]} seeds a model, at most {options["samples_per_epoch"]:,} samples an epoch (slow models take a share
of them: `benchmarks/study_plan.py`), {options["minutes"]:g} minutes of generated traffic: congested and
NGSIM-like, free and highD-like. {study.seconds / 60:.0f} minutes of work on two cores. Figures are mean ± standard
deviation over seeds.
Generated traffic is easier than real traffic in some ways and harder in others: published figures stand beside measured
ones where `tracklake evaluate` prints them, not here."""


def judge(study: Study, rows: dict[str, pl.DataFrame]) -> str:
    """What was expected, and what came."""
    lines = [
        "## What was expected, and what came",
        "",
        "| expected | where | holds | figures |",
        "| --- | --- | --- | --- |",
    ]
    for claim in CLAIMS:
        if claim.arm in rows:
            arm = next(own for own in study.arms if own.name == claim.arm)
            lines.append(weigh(claim, summarise(pick(at_scored(rows[claim.arm], arm)))))
    return "\n".join(lines)


def pick(
    rows: pl.DataFrame, dataset: str = EVERYTHING, group: str = EVERYTHING, average: str = "samples"
) -> pl.DataFrame:
    """Rows of one dataset, group and average."""
    return rows.filter((pl.col("dataset") == dataset) & (pl.col("group") == group) & (pl.col("average") == average))


def weigh(claim: Claim, means: pl.DataFrame) -> str:
    """One line of the judgement: where it fails, by how much."""
    failed, compared = [], 0
    for figure in claim.figures:
        for seconds in claim.seconds:
            here = means.filter(pl.col("seconds") == seconds)
            limit = take(here, claim.worse, figure)
            for model in claim.better:
                got = take(here, model, figure)
                if limit is None or got is None:
                    failed.append(f"{model} at {seconds:g} s: no figure")
                    continue
                compared += 1
                slack = (take(here, model, f"{figure}_sd") or 0.0) if claim.equal else 0.0
                if got > limit + slack or (not claim.equal and got == limit):
                    failed.append(f"{model} at {seconds:g} s: {figure} {got:.3f}, {claim.worse} {limit:.3f}")
    verdict = "yes" if not failed else f"no: {len(failed)} of {compared}"
    shown = "; ".join(failed[:12]) + (" ..." if len(failed) > 12 else "")
    return f"| {claim.text} | {claim.arm} | {verdict} | {shown or f'all {compared} comparisons'} |"


def take(rows: pl.DataFrame, model: str, figure: str) -> float | None:
    """One figure of one model; None where there is none."""
    found = rows.filter(pl.col("model") == model)[figure]
    return None if not len(found) or found[0] is None else float(found[0])


def describe_arm(arm: Arm, rows: pl.DataFrame, lake: Path) -> str:
    """One arm's tables."""
    means = summarise(at_scored(rows, arm))
    everything = pick(means)
    seconds = sorted(everything["seconds"].unique())
    source = (
        "the public excerpt of US-101 (290 of its 2,169 vehicles: no neighbors)"
        if arm.source == "us-101"
        else "generated traffic"
    )
    parts = [f"## {arm.name}: protocol `{arm.protocol}` on {source}"]
    counts = everything.filter(pl.col("model") == PLAIN[0]).sort("seconds")
    parts.append(f"Samples: {', '.join(f'{n:,} at {s:g} s' for s, n in counts.select('seconds', 'n').iter_rows())}.")
    parts.append(f"RMSE, m:\n\n{lay_out(everything, 'rmse_m', seconds)}")
    if arm.protocol == "mha-2020":
        parts.append(f"RMSE along the road, m:\n\n{lay_out(everything, 'rmse_longitudinal_m', seconds)}")
        parts.append(f"RMSE across the road, m:\n\n{lay_out(everything, 'rmse_lateral_m', seconds)}")
    if arm.protocol == "grid-2021":
        parts.append(f"MAE, m:\n\n{lay_out(everything, 'mae_m', seconds)}")
    parts.append(f"Negative log-likelihood, nats:\n\n{lay_out(everything, 'nll_nats', seconds)}")
    if arm.source == "sample":
        for dataset, title in DATASETS.items():
            parts.append(f"RMSE, m, {title} only:\n\n{lay_out(pick(means, dataset), 'rmse_m', seconds)}")
    parts.append(f"At {seconds[-1]:g} s, RMSE in m over groups of samples:\n\n{lay_out_groups(means, seconds[-1])}")
    parts.append(f"At {seconds[-1]:g} s:\n\n{lay_out_rest(everything, seconds[-1])}")
    if arm.forest:
        parts.append(describe_forest(lake))
    return "\n\n".join(parts)


def lay_out(means: pl.DataFrame, figure: str, seconds: Sequence[float]) -> str:
    """Models by seconds; models without the figure are left out."""
    body = []
    for model in order(means["model"].unique()):
        own = means.filter((pl.col("model") == model) & pl.col(figure).is_not_null())
        if own.height:
            body.append([f"`{model}`", *(show(own.filter(pl.col("seconds") == at), figure) for at in seconds)])
    return grid(["model", *(f"{at:g} s" for at in seconds)], body)


def lay_out_groups(means: pl.DataFrame, at: float) -> str:
    """Models by group, at one horizon; the last column counts vehicles alike."""
    here = means.filter((pl.col("seconds") == at) & (pl.col("dataset") == EVERYTHING))
    groups = here.filter(pl.col("average") == "samples")["group"].unique(maintain_order=True).to_list()
    body = [
        [
            f"`{model}`",
            *(show(pick(here, group=group).filter(pl.col("model") == model), "rmse_m") for group in groups),
            show(pick(here, average="vehicles").filter(pl.col("model") == model), "rmse_m"),
        ]
        for model in order(here["model"].unique())
    ]
    return grid(["model", *groups, "all, by vehicle"], body)


def lay_out_rest(means: pl.DataFrame, at: float) -> str:
    """What does not belong to a horizon, or has one column."""
    here = means.filter(pl.col("seconds") == at)
    columns = {
        "ADE, m": "ade_m",
        "MAE, m": "mae_m",
        "lateral maneuver right": "lateral_accuracy",
        "always the commonest": "majority_lateral_share",
        "braking right": "longitudinal_accuracy",
        "always the commonest ": "majority_longitudinal_share",
        "ms a scene": "latency_ms",
    }
    body = [
        [f"`{model}`", *(show(here.filter(pl.col("model") == model), name) for name in columns.values())]
        for model in order(here["model"].unique())
    ]
    return grid(["model", *columns], body)
