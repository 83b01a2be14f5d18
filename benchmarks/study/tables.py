"""The study's committed tables: what was scored, compared and trained, on which tensors."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import polars as pl

from study.jobs import SCORES, VEHICLES, Job, Lake
from study.plan import Arm
from tracklake.schemas.comparisons import CALIBRATION, COMPARED_FIGURES, CONFORMAL_RADII, DENSITY_ERRORS, FEASIBILITY
from tracklake.schemas.evaluations import EVERYTHING
from tracklake.training.comparison.bootstrap import compare_errors
from tracklake.training.onboard.as_published import PUBLISHED

TEXT, WHOLE, NUMBER = pl.String(), pl.Int64(), pl.Float64()
KEY = {"arm": TEXT, "model": TEXT, "seed": WHOLE}
SQUARED = ("rmse_m", "rmse_longitudinal_m", "rmse_lateral_m")
MEANS = ("mae_m", "ade_m", "nll_nats", "lateral_accuracy", "longitudinal_accuracy")
TABLES: dict[str, dict[str, pl.DataType]] = {
    "seeds": {
        **KEY,
        **{"dataset": TEXT, "group": TEXT, "seconds": NUMBER, "n": WHOLE},
        **dict.fromkeys((*SQUARED, *MEANS), NUMBER),
    },
    "comparisons": {
        **{"arm": TEXT, "model": TEXT, "against": TEXT, "dataset": TEXT, "figure": TEXT, "seconds": NUMBER},
        **dict.fromkeys(("n", "vehicles", "a_seeds", "b_seeds"), WHOLE),
        **dict.fromkeys(("a_value", "b_value", "difference", "low", "high"), NUMBER),
    },
    "runs": {
        **KEY,
        "lake": TEXT,
        **dict.fromkeys(("weights", "train_samples", "steps", "samples_seen", "supervised_positions"), WHOLE),
        **dict.fromkeys(("seconds", "samples_per_s", "best_epoch", "validation_loss"), NUMBER),
    },
    "curves": {**KEY, "lake": TEXT, "epoch": WHOLE, "phase": TEXT, "loss": NUMBER, "validation_loss": NUMBER},
    "forests": {
        **dict.fromkeys(("arm", "figure", "model", "grid"), TEXT),
        **{"seconds": NUMBER, "forest": TEXT, "n": WHOLE, "vehicles": WHOLE},
        **dict.fromkeys(("value", "low", "high"), NUMBER),
    },
    "lakes": {
        **dict.fromkeys(("arm", "lake", "protocol", "protocol_digest", "split", "split_digest", "tensors"), TEXT),
        **dict.fromkeys(("train", "val", "eval"), WHOLE),
        "dose": NUMBER,
    },
}
EVIDENCE_TABLES = {table.name: table for table in (CALIBRATION, DENSITY_ERRORS, CONFORMAL_RADII, FEASIBILITY)}
TABLES |= {
    name: {**KEY, "lake": TEXT, **{column: dtype for column, dtype in table.dtypes.items() if column != "run"}}
    for name, table in EVIDENCE_TABLES.items()
}
"""Columns of docs/results-NAME.csv. `seeds` has one row per arm, model, seed, part of the data and horizon; the seed is
null where nothing was drawn. `dose` is the share of the vehicles that have the injected defect."""

LEARNED = {"train": "maneuver, training part", "eval": "maneuver, scored part"}
"""Figures of a forest's learning curve by part; the number of examples stands in the column `grid`."""
NOTHING = "-"
"""What a model is compared with where the interval is that of its own error."""
SUMS = pl.col("squared_longitudinal_m2", "squared_lateral_m2", "distance_m", "nll_nats")

FIGURES = {
    "rmse_m": "RMSE, m",
    "rmse_longitudinal_m": "RMSE along the road, m",
    "rmse_lateral_m": "RMSE across the road, m",
    "nll_nats": "negative log-likelihood, nats",
}
"""Figures that the pages show, and in which models are compared, with their titles."""
RADIUS_LEVEL = 0.9
"""Probability of the conformal radii that the pages show."""
LEVELS = {"calibration": (0.5, RADIUS_LEVEL, 0.95), "conformal_radii": (RADIUS_LEVEL,)}
"""Probabilities of regions that are kept, by table."""
DIGITS = 5
"""Decimals of the committed tables."""


def read_table(docs: Path, name: str) -> pl.DataFrame:
    """Read a committed table; one that is missing has no rows."""
    file = docs / f"results-{name}.csv"
    return pl.read_csv(file, schema=TABLES[name]) if file.exists() else pl.DataFrame(schema=TABLES[name])


def update_tables(docs: Path, arm: Arm, jobs: Sequence[Job]) -> None:
    """Replace an arm's rows of the committed tables by what is scored; an arm without scores keeps its rows."""
    done = select_complete(jobs, max(1, len(arm.folds)))
    if not done:
        return
    lakes = {(lake.root, lake.name): lake for job in done for lake in (job.lake, job.trained_in)}.values()
    errors = read_errors(done)
    if arm.is_unseen:
        homes = {job.home.root: job.home for job in done if job.home}.values()
        errors = {model: select_unseen(own, homes) for model, own in errors.items()}
    found = {
        "seeds": pool_errors(arm, errors) if arm.is_unseen else pool_scores(done),
        "comparisons": pl.DataFrame(list(compare_models(arm, errors)), schema=TABLES["comparisons"]),
        "runs": pl.DataFrame([describe_run(job) for job in done if job.learner], schema=TABLES["runs"]),
        "curves": pl.concat([pl.DataFrame(schema=TABLES["curves"]), *(read_curve(job) for job in done if job.learner)]),
        "lakes": pl.DataFrame([describe_lake(lake) for lake in lakes], schema=TABLES["lakes"]),
    }
    found |= {name: read_evidence(done, name) for name in EVIDENCE_TABLES}
    replace_rows(docs, arm, found)


def update_forests(docs: Path, lake: Lake, file: Path) -> None:
    """Replace the rows of an arm of forests by the scores of its lake."""
    record = json.loads(file.read_text(encoding="utf-8"))["as_published"]
    named = {"arm": lake.arm.name}
    rows = [named | row for row in record["shares"]]
    for point in record["learning_curve"]:
        drawn = named | {"forest": PUBLISHED, "grid": str(point["drawn"])}
        rows += [
            drawn | {"figure": figure, "n": point[f"{part}_n"], "value": point[f"{part}_accuracy"]}
            for part, figure in LEARNED.items()
        ]
    found = {
        "forests": pl.DataFrame(rows, schema=TABLES["forests"]),
        "curves": pl.DataFrame(list(describe_course(lake, record["decoder"])), schema=TABLES["curves"]),
        "lakes": pl.DataFrame([describe_lake(lake)], schema=TABLES["lakes"]),
    }
    replace_rows(docs, lake.arm, found)


def describe_course(lake: Lake, course: Mapping[str, Any] | None) -> Iterator[dict[str, Any]]:
    """Describe the losses by epoch of a decoder; of none, nothing."""
    if course is not None:
        for epoch, (loss, held_back) in enumerate(zip(course["losses"], course["validation_losses"], strict=True)):
            named = {"arm": lake.arm.name, "model": "decoder", "lake": lake.name, "phase": "places"}
            yield named | {"epoch": epoch, "loss": loss, "validation_loss": held_back}


def replace_rows(docs: Path, arm: Arm, found: Mapping[str, pl.DataFrame]) -> None:
    """Replace an arm's rows of committed tables."""
    for name, table in found.items():
        kept = read_table(docs, name).filter(pl.col("arm") != arm.name)
        whole = pl.concat([kept, table.select(*TABLES[name])]).with_columns(pl.selectors.float().round(DIGITS))
        whole.write_csv(docs / f"results-{name}.csv")


def select_complete(jobs: Sequence[Job], folds: int) -> list[Job]:
    """Select the scored jobs of those models and seeds that are scored in all folds."""
    scored = [job for job in jobs if job.is_scored]
    counts: dict[tuple[str, int | None], int] = {}
    for job in scored:
        counts[job.model, job.seed] = counts.get((job.model, job.seed), 0) + 1
    return [job for job in scored if counts[job.model, job.seed] == folds]


def pool_scores(jobs: Iterable[Job]) -> pl.DataFrame:
    """Pool the scores of all folds: means by the number of samples, roots last; of groups, the last horizon alone."""
    read = pl.concat(
        pl.read_csv(job.scores / SCORES, infer_schema_length=None)
        .filter(average="samples")
        .select(
            pl.lit(job.lake.arm.name).alias("arm"),
            pl.lit(job.model).alias("model"),
            pl.lit(job.seed, WHOLE).alias("seed"),
            "dataset",
            "group",
            pl.col("seconds", *SQUARED, *MEANS).cast(NUMBER),
            pl.col("n").cast(WHOLE),
        )
        for job in jobs
    )
    last = pl.col("seconds") == pl.col("seconds").max()
    shown = (pl.col("group") == EVERYTHING) | (last & ~pl.col("group").str.starts_with("findings"))
    weighted = {name: pl.col(name) ** 2 for name in SQUARED} | {name: pl.col(name) for name in MEANS}
    pooled = {
        name: pl.when(pl.col(name).is_not_null().all()).then((figure * pl.col("n")).sum() / pl.col("n").sum())
        for name, figure in weighted.items()
    }
    return (
        read.filter(shown, pl.col("n") > 0)
        .group_by(*KEY, "dataset", "group", "seconds", maintain_order=True)
        .agg(pl.col("n").sum(), **pooled)
        .with_columns(pl.col(SQUARED).sqrt())
    )


def read_errors(jobs: Iterable[Job]) -> dict[str, pl.DataFrame]:
    """Read the errors by vehicle of every model, over all its folds and seeds."""
    errors: dict[str, list[pl.DataFrame]] = {}
    for job in jobs:
        errors.setdefault(job.model, []).append(pl.read_parquet(job.scores / VEHICLES))
    return {model: pl.concat(own) for model, own in errors.items()}


def select_unseen(errors: pl.DataFrame, homes: Iterable[Lake]) -> pl.DataFrame:
    """Select the errors of vehicles whose numbers are in the evaluation part of all these lakes."""
    for home in homes:
        blocks = pl.DataFrame((home.index or {})["blocks"], infer_schema_length=None).filter(part="eval")
        within = pl.col("vehicle_id").is_between("first_vehicle_id", "last_vehicle_id")
        numbers = blocks.select("dataset", "subset", "first_vehicle_id", "last_vehicle_id")
        errors = errors.join(numbers, on=["dataset", "subset"]).filter(within).select(errors.columns)
    return errors


def pool_errors(arm: Arm, errors: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    """Pool errors by vehicle into the table of seeds; figures that they do not have are null."""
    along, across = ("squared_longitudinal_m2", "squared_lateral_m2")
    mean = {name: pl.col(name).sum() / pl.col("n").sum() for name in (along, across)}
    has_density = pl.col("nll_nats").is_not_null().all()
    figures = {
        "rmse_m": (mean[along] + mean[across]).sqrt(),
        "rmse_longitudinal_m": mean[along].sqrt(),
        "rmse_lateral_m": mean[across].sqrt(),
        "nll_nats": pl.when(has_density).then(pl.col("nll_nats").sum() / pl.col("n").sum()),
    }
    rows = [pl.DataFrame(schema=TABLES["seeds"])]
    for model, own in errors.items():
        named = {"arm": arm.name, "model": model, "group": EVERYTHING}
        for part in (own, own.with_columns(dataset=pl.lit(EVERYTHING))):
            pooled = part.group_by("seed", "dataset", "seconds", maintain_order=True).agg(pl.col("n").sum(), **figures)
            rows.append(pooled.with_columns(pl.lit(value).alias(name) for name, value in named.items()))
    return pl.concat(rows, how="diagonal_relaxed").select(*TABLES["seeds"]).cast(TABLES["seeds"])


def compare_models(arm: Arm, errors: Mapping[str, pl.DataFrame]) -> Iterator[dict[str, Any]]:
    """Compare models with nothing, networks with plain models, and the arm's pairs, on the part that the arm shows."""
    learned = [own.name for own in arm.learners]
    for model, against in (*product(errors, (NOTHING,)), *product(learned, arm.plain), *arm.pairs):
        if model not in errors or against not in (*errors, NOTHING):
            continue
        others = errors[model].with_columns(SUMS * 0.0) if against == NOTHING else errors[against]
        own, other = (select_part(each, arm.dataset) for each in (errors[model], others))
        if own.height and set(own["dataset"]) == set(other["dataset"]):
            named = {"arm": arm.name, "model": model, "against": against, "dataset": arm.dataset}
            for figure in FIGURES:
                sums = COMPARED_FIGURES[figure]
                if not any(each[column].has_nulls() for each in (own, other) for column in sums):
                    rows = compare_errors(own, other, figure).to_dicts()
                    yield from (named | {"figure": figure} | row for row in rows)


def select_part(errors: pl.DataFrame, dataset: str) -> pl.DataFrame:
    """Select the errors on a part of the data."""
    return errors if dataset == EVERYTHING else errors.filter(dataset=dataset)


def read_evidence(jobs: Iterable[Job], name: str) -> pl.DataFrame:
    """Read a table beside the scores of the jobs that have it, at LEVELS, and for each fold apart."""
    tables = [pl.DataFrame(schema=TABLES[name])]
    for job in jobs:
        file = job.evidence / f"{name}.csv" if job.evidence else None
        if file is not None and file.exists():
            schema = EVIDENCE_TABLES[name].dtypes
            table = pl.read_csv(file, schema_overrides=schema, infer_schema_length=None)
            if "level" in table.columns:
                table = table.filter(pl.col("level").is_in(LEVELS[name]))
            named = {"arm": job.lake.arm.name, "model": job.model, "seed": job.seed, "lake": job.lake.name}
            tables.append(table.with_columns(pl.lit(own, TABLES[name][key]).alias(key) for key, own in named.items()))
    return pl.concat([table.select(*TABLES[name]) for table in tables])


def describe_run(job: Job) -> dict[str, Any]:
    """Describe a training by its metrics.json."""
    metrics = json.loads((job.run_folder / "metrics.json").read_text(encoding="utf-8"))
    best = metrics.get("best") or {}
    named = {"arm": job.lake.arm.name, "model": job.model, "seed": job.seed, "lake": job.trained_in.name}
    kept = {name: metrics.get(name) for name in TABLES["runs"] if name not in named}
    return named | kept | {"best_epoch": best.get("epoch"), "validation_loss": best.get("validation_loss")}


def read_curve(job: Job) -> pl.DataFrame:
    """Read losses by epoch of a training that stops by its validation loss."""
    log = pl.read_csv(job.run_folder / "epochs.csv")
    named = {"arm": job.lake.arm.name, "model": job.model, "seed": job.seed, "lake": job.trained_in.name}
    rows = log.with_columns(pl.lit(value).alias(name) for name, value in named.items())
    return rows.select(pl.col(name).cast(dtype) for name, dtype in TABLES["curves"].items()).drop_nulls()


def describe_lake(lake: Lake) -> dict[str, Any]:
    """Describe the tensors of a lake by their index."""
    index = lake.index or {}
    recipe, protocol = index["split_recipe"] or {}, index["protocol"]
    return {
        **{"arm": lake.arm.name, "lake": lake.name, "tensors": lake.digest, "split": index["split"]},
        **{"protocol": protocol["name"], "protocol_digest": protocol["digest"], "split_digest": recipe.get("digest")},
        **index["samples_by_part"],
        "dose": read_dose(lake.truth),
    }


def read_dose(truth: Path) -> float | None:
    """Read from a sample's truth which share of its vehicles has the defect that was asked for; None where none was."""
    rows = pl.read_parquet(truth, columns=["kind", "vehicles"]) if truth.exists() else pl.DataFrame({"kind": []})
    doses = rows.filter(kind="dose")
    return doses["vehicles"].sum() / rows.filter(kind="first_frame").height if doses.height else None
