"""The study's page: figures as mean and spread over seeds, beside how many samples they are of."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
from study_claims import judge
from study_figure import draw_error_growth
from study_forest import describe_forest
from study_plan import ARMS, PLAIN, Arm
from study_tables import FEW, grid, order, pick, show

from tracklake.schemas.evaluations import EVERYTHING, FIGURES
from tracklake.schemas.protocols import PROTOCOLS

EVALUATIONS, SCENES, JOBS = "evaluations.csv", "evaluations-{nearest}-around.csv", "jobs.csv"
GROUPS = "groups.csv"
"""File in the study's folder: means over seeds of every group of samples; too large to stand beside the page."""
NEAREST = (2, 6, 10, 20)
"""Vehicles around the ego that scene models are shown in evaluation: scenes of 3, 7, 11 and 21."""
DATASETS = {"ngsim": "NGSIM-like", "highd": "highD-like"}
_TABLED_FIGURES = ("rmse_m", "rmse_longitudinal_m", "rmse_lateral_m", "mae_m", "nll_nats")
TABLED = (
    *("model", "dataset", "group", "average", "seconds", "n", "vehicles", "seeds"),
    *(column for name in _TABLED_FIGURES for column in (name, f"{name}_sd")),
)
"""Columns of the table beside the page."""
DRAWN = ("constant-velocity", "v-lstm", "cs-lstm", "cs-lstm-m")


@dataclass(frozen=True)
class Study:
    """What was run.

    Args:
        arms: those that were.
        work: the study's folder.
        digest: of the plan.
        plan: its options.
    """

    arms: Sequence[Arm]
    work: Path
    digest: str
    plan: dict[str, Any]


def write_page(out: Path, study: Study) -> None:
    """Write the page, its figure, and the tables behind both, beside each other."""
    rows = {arm.name: read_rows(study.work / arm.name / EVALUATIONS) for arm in study.arms}
    scored = {arm.name: at_scored(rows[arm.name], arm) for arm in study.arms}
    out.parent.mkdir(parents=True, exist_ok=True)
    named = out.with_suffix("")
    figure, curves = out.with_suffix(".svg"), read_curves(rows[study.arms[0].name])
    figure.write_bytes(draw_error_growth(curves).render(figure.suffix))
    curves.write_csv(named.with_name(f"{named.name}-curves.csv"), float_precision=4)
    summaries = [summarise(own).select(pl.lit(arm).alias("arm"), *TABLED) for arm, own in scored.items()]
    pl.concat(summaries).write_csv(study.work / GROUPS, float_precision=4)
    parts = [
        introduce(study, named.name),
        judge(scored, study.plan["seeds"]),
        f"## Errors over the horizon\n\n![RMSE and its growth over the horizon]({figure.name})\n\nProtocol "
        f"`{study.arms[0].protocol}`; the line is the mean over seeds, the band their range.",
        *(describe_arm(arm, scored[arm.name], study.work / arm.name) for arm in study.arms),
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
            **{name: pl.col(name).cast(pl.Float64) for name in (*FIGURES, "latency_ms", "latency_samples")},
        )
    )


def read_curves(rows: pl.DataFrame) -> pl.DataFrame:
    """RMSE at every tick, by dataset, of the models that are drawn."""
    drawn = pl.col("dataset").is_in(list(DATASETS)) & pl.col("model").is_in(DRAWN)
    everything = (pl.col("group") == EVERYTHING) & (pl.col("average") == "samples")
    return (
        rows.filter(drawn & everything)
        .select(
            "model", pl.col("dataset").replace_strict(DATASETS), "seed", pl.col("seconds").cast(pl.Float64), "rmse_m"
        )
        .sort(pl.col("model").replace_strict(list(DRAWN), range(len(DRAWN))), "dataset", "seed", "seconds")
    )


def at_scored(rows: pl.DataFrame, arm: Arm) -> pl.DataFrame:
    """Rows at the protocol's own seconds only."""
    return rows.filter(pl.col("seconds").is_in(PROTOCOLS[arm.protocol].scored_s))


def summarise(rows: pl.DataFrame) -> pl.DataFrame:
    """Mean and standard deviation over seeds of every figure."""
    keys = ("model", "dataset", "group", "average", "seconds")
    figures = (*FIGURES, "latency_ms", "latency_samples")
    return rows.group_by(keys, maintain_order=True).agg(
        pl.col("n", "vehicles").first(),
        seeds=pl.len(),
        **{name: pl.col(name).mean() for name in figures},
        **{f"{name}_sd": pl.col(name).std() for name in figures},
    )


def introduce(study: Study, name: str) -> str:
    """What this is and how it is made again."""
    jobs = pl.read_csv(study.work / JOBS, has_header=False, new_columns=["seconds", "commit", "command"])
    trained = jobs.filter(pl.col("command").str.starts_with("tracklake train"))
    commits = ", ".join(trained["commit"].unique(maintain_order=True))
    digests = ", ".join(dict.fromkeys(f"`{own.protocol}` {PROTOCOLS[own.protocol].digest}" for own in study.arms))
    options = study.plan
    absent = [own.name for own in ARMS if own not in study.arms]
    left_out = f" Not in it: {', '.join(absent)}." if absent else ""
    return f"""\
# Results

Written by `make study` (`--minutes {options["minutes"]:g} --seeds {options["seeds"]} --samples-per-epoch
{options["samples_per_epoch"]}`). Trained at commit {commits}; plan {study.digest}; protocols {digests}. Do not edit:
what the figures say is discussed in [{name}-discussion.md]({name}-discussion.md). Means over seeds of every group:
`{GROUPS}` in the study's folder; every seed at every tick of the models drawn:
[{name}-curves.csv]({name}-curves.csv).

{options["seeds"]} seeds a model, {options["minutes"]:g} minutes of generated traffic, congested (NGSIM-like) and free
(highD-like), in one lake. An epoch takes {options["samples_per_epoch"]:,} samples at most, and slow models a share of
them; how much each has seen stands below. The commands took {jobs["seconds"].sum() / 60:.0f} minutes together, most
of them two at a time on two cores, a thread each. Figures are mean ± standard deviation over seeds; a dash stands for
fewer than {FEW} samples. Networks count their places from constant velocity (`residual`), which the publications do
not. Generated traffic is not the field's: published figures stand beside measured ones where `tracklake evaluate`
prints them, not here.{left_out}"""


def describe_arm(arm: Arm, rows: pl.DataFrame, lake: Path) -> str:
    """One arm's tables."""
    means = summarise(rows)
    everything = pick(means)
    seconds = sorted(everything["seconds"].unique())
    parts = [f"## {arm.name}: protocol `{arm.protocol}`", describe_source(arm)]
    longer = f", {arm.epochs} epochs instead of the recipes'" if arm.epochs else ""
    parts.append(f"What was trained{longer}:\n\n{lay_out_training(arm, lake)}")
    headline = PROTOCOLS[arm.protocol].headline
    titles = {"RMSE, m": "rmse_m"}
    if headline == "rmse-by-axis":
        titles |= {"RMSE along the road, m": "rmse_longitudinal_m", "RMSE across it, m": "rmse_lateral_m"}
    if headline == "mae":
        titles |= {"MAE, m": "mae_m"}
    titles |= {"Negative log-likelihood, nats": "nll_nats"}
    parts += [f"{title}:\n\n{lay_out(everything, figure, seconds)}" for title, figure in titles.items()]
    if arm.source == "sample":
        for dataset, title in DATASETS.items():
            parts.append(f"RMSE, m, {title} only:\n\n{lay_out(pick(means, dataset), 'rmse_m', seconds)}")
    last = seconds[-1]
    parts.append(f"At {last:g} s, RMSE in m by true maneuver, findings and average:\n\n{lay_out_groups(means, last)}")
    parts.append(f"At {last:g} s:\n\n{lay_out_rest(everything, last)}")
    if arm.scenes:
        parts.append(describe_scenes(arm, lake, last))
    if arm.forest:
        parts.append(describe_forest(lake))
    return "\n\n".join(parts)


def describe_source(arm: Arm) -> str:
    """Where an arm's recordings come from."""
    if arm.source == "sample":
        split = arm.environment.get("TRACKLAKE_SPLIT", PROTOCOLS[arm.protocol].split)
        return f"Generated traffic, split `{split}`."
    return (
        "The public excerpt of US-101: 290 of its 2,169 vehicles, so that no vehicle's neighbors are known, split by "
        "blocks of time. It has no lanes; samples need some, and were given lanes of 12 ft from `Local_X`. Lateral "
        "maneuvers are only as good as these."
    )


def lay_out_training(arm: Arm, lake: Path) -> str:
    """What each learner saw, over its seeds."""
    body = []
    for learner in arm.learners:
        files = sorted((lake / "models").glob(f"{learner.name}-seed*/metrics.json"))
        runs = pl.DataFrame([_read_training(file) for file in files])
        mean = runs.mean().row(0, named=True)
        speed = f"{mean['samples_per_s']:,.0f}"
        shown = [f"{mean[key]:,.0f}" for key in ("weights", "steps", "samples_seen", "seconds")]
        body.append([f"`{learner.name}`", *shown, speed, f"{100 * mean['data_share']:.1f}"])
    return grid(["model", "weights", "steps", "samples seen", "s", "samples a second", "reading, % of a step"], body)


def _read_training(file: Path) -> dict[str, Any]:
    record = json.loads(file.read_text(encoding="utf-8"))
    return {key: record[key] for key in ("weights", "steps", "samples_seen", "seconds", "samples_per_s", "data_share")}


def describe_scenes(arm: Arm, lake: Path, at: float) -> str:
    """Models that are shown other numbers of vehicles than they were trained with."""
    body = []
    for nearest in NEAREST:
        means = pick(summarise(at_scored(read_rows(lake / SCENES.format(nearest=nearest)), arm)))
        for model in order(means["model"].unique()):
            own = means.filter((pl.col("model") == model) & (pl.col("seconds") == at))
            shown = [
                show(own, figure) for figure in ("rmse_longitudinal_m", "rmse_lateral_m", "nll_nats", "latency_ms")
            ]
            body.append([f"`{model}`", str(nearest + 1), *shown])
    heads = ["model", "vehicles at most", "RMSE along, m", "RMSE across, m", "NLL, nats", "ms a scene"]
    return f"Scenes of other sizes, at {at:g} s (trained with 11 at most):\n\n{grid(heads, body)}"


def lay_out(means: pl.DataFrame, figure: str, seconds: Sequence[float]) -> str:
    """Models by seconds; models without the figure are left out. The last line is how many samples."""
    body = []
    for model in order(means["model"].unique()):
        own = means.filter((pl.col("model") == model) & pl.col(figure).is_not_null())
        if own.height:
            body.append([f"`{model}`", *(show(own.filter(pl.col("seconds") == at), figure) for at in seconds)])
    first = means.filter(pl.col("model") == PLAIN[0])
    counts = [first.filter(pl.col("seconds") == at)["n"] for at in seconds]
    body.append(["samples", *(f"{count[0]:,}" if len(count) else "0" for count in counts)])
    return grid(["model", *(f"{at:g} s" for at in seconds)], body)


def lay_out_groups(means: pl.DataFrame, at: float) -> str:
    """Models by group, at one horizon; the last column counts vehicles alike."""
    here = means.filter((pl.col("seconds") == at) & (pl.col("dataset") == EVERYTHING))
    sampled = here.filter(pl.col("average") == "samples")
    groups = sampled["group"].unique(maintain_order=True).to_list()
    body = []
    for model in order(here["model"].unique()):
        own = here.filter(pl.col("model") == model)
        by_group = [show(pick(own, group=group), "rmse_m") for group in groups]
        body.append([f"`{model}`", *by_group, show(pick(own, average="vehicles"), "rmse_m")])
    first = here.filter(pl.col("model") == PLAIN[0])
    counts = [pick(first, group=group)["n"] for group in groups]
    vehicles = pick(first, average="vehicles")["vehicles"]
    body.append(["samples", *(f"{count[0]:,}" if len(count) else "0" for count in counts), f"{vehicles[0]:,} vehicles"])
    return grid(["model", *groups, "all, by vehicle"], body)


def lay_out_rest(means: pl.DataFrame, at: float) -> str:
    """What does not belong to a horizon, or has one column."""
    here = means.filter(pl.col("seconds") == at)
    columns = {
        "ADE, m": "ade_m",
        "MAE (FDE), m": "mae_m",
        "lateral maneuver right": "lateral_accuracy",
        "always the commonest": "majority_lateral_share",
        "braking right": "longitudinal_accuracy",
        "always the commonest ": "majority_longitudinal_share",
        "ms a scene": "latency_ms",
        "samples a scene": "latency_samples",
    }
    body = [
        [f"`{model}`", *(show(here.filter(pl.col("model") == model), name) for name in columns.values())]
        for model in order(here["model"].unique())
    ]
    return grid(["model", *columns], body)
