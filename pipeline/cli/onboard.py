"""`tracklake onboard ...`: what an instrumented vehicle predicts of the vehicles around it, and how well."""

import json as json_format
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import polars as pl
import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.evaluate import FOLDER as EVALUATIONS
from tracklake.pipeline.cli.onboard_tables import show_forest, show_scores, show_warnings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import MODELS as RUNS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.drive_score import FOLDER, read_drives
from tracklake.schemas.errors import TracklakeError, explain_file_errors
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_file
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.protocols import V2V
from tracklake.training.onboard.collisions import score_warnings
from tracklake.training.onboard.maneuvers import CORRELATED, ManeuverForest, fit_forest
from tracklake.training.onboard.models import CTRV, MODELS, NETWORKS, Forecaster, find_network
from tracklake.training.onboard.samples import Parts, build_samples, split_samples
from tracklake.training.onboard.scores import count_confusion, learn_curve, list_published, score_forest, score_model
from tracklake.training.onboard.training import open_model, train_run
from tracklake.training.runs.config import TrainConfig

onboard = typer.Typer(
    help="Predict the vehicles around an instrumented vehicle from its own logs; train, evaluate, warn.",
    no_args_is_help=True,
    add_completion=False,
)
ModelsArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="[MODEL]...", help=f"Of {', '.join(MODELS)}; none: ctrv and all that are trained."),
]


@onboard.callback()
def _onboard() -> None:
    """Predict the vehicles around an instrumented vehicle from its own logs; train, evaluate, warn."""


@onboard.command()
def train(
    model: Annotated[str, typer.Argument(help=f"Model: {' or '.join(NETWORKS)}.")],
    lake: LakeOption = None,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="Passes over the training part.")] = None,
    batch_size: Annotated[int | None, typer.Option("--batch-size", min=1, help="Samples per step.")] = None,
    learning_rate: Annotated[float | None, typer.Option("--learning-rate", help="Of the optimiser.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of weights, copies and batches.")] = 0,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of torch.")] = 1,
    device: Annotated[str, typer.Option("--device", help="cpu or cuda.")] = "cpu",
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Train a model on 70 % of the drives' trajectories and evaluate it once on the others."""
    with command(quiet=quiet, json=json) as terminal:
        _, recipe = find_network(model)
        config = TrainConfig(
            epochs=epochs or recipe.epochs,
            batch_size=batch_size or recipe.batch_size,
            learning_rate=learning_rate or recipe.learning_rate,
            seed=seed,
            threads=threads,
            device=device,
        )
        require_extras(f"the model `{model}`", "training")
        settings = read_settings(lake=lake)
        parts, left_out, _ = _read_parts(terminal, settings)
        out = settings.lake / RUNS / FOLDER / model
        with explain_file_errors(out), terminal.show_training(f"train {model}") as show:
            metrics = train_run(model, parts, left_out, out, config, show)
        evaluation = metrics["evaluation"]
        show_scores(terminal, parts, evaluation["scores"], [])
        terminal.print_line(f"run {out}; `tracklake onboard evaluate` compares models, `warn` their warnings")
        terminal.print_json(metrics)


@onboard.command()
def evaluate(
    models: ModelsArgument = None,
    lake: LakeOption = None,
    learning_curve: Annotated[
        bool, typer.Option("--learning-curve", help="Also fit forests on fewer examples; scores on both parts.")
    ] = False,
    confusion: Annotated[bool, typer.Option("--confusion", help="Also print predicted against true cells.")] = False,
    published: Annotated[
        bool, typer.Option("--published/--no-published", help="Show published figures, too, marked as such.")
    ] = True,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Score errors and grid cells every half second, by scenario, beside published figures.

    All figures go to LAKE/evaluations/v2v-2021.json, the scores to v2v-2021.csv.
    """
    with command(quiet=quiet, json=json) as terminal:
        require_extras("the forest of maneuvers", "onboard")
        settings = read_settings(lake=lake)
        parts, left_out, is_synthetic = _read_parts(terminal, settings)
        found = _open_models(terminal, settings.lake, parts, models)
        forest = _fit_forest(terminal, parts)
        rows = [asdict(row) for model in found for row in score_model(model, parts.eval, forest)]
        beside = [asdict(row) for row in list_published()] if published else []
        cells = {model.name: count_confusion(model, parts.eval).tolist() for model in found}
        record: dict[str, Any] = {
            "protocol": {"name": V2V.name, "digest": V2V.digest},
            "split": parts.digest,
            "synthetic_drives": is_synthetic,
            "samples": {"train": len(parts.train), "eval": len(parts.eval)},
            "left_out": left_out,
            "scores": rows,
            "published": beside,
            "maneuvers": [asdict(row) for row in score_forest(forest, parts.eval)] if forest else [],
            "examples": forest.examples if forest else 0,
            "correlations": [asdict(row) for row in forest.coefficients] if forest else [],
            "correlation_matrix": {"names": CORRELATED, "values": forest.matrix.round(4).tolist()} if forest else {},
            "confusion": cells,
            "learning_curve": [asdict(row) for row in learn_curve(parts, 0)] if learning_curve and forest else [],
        }
        show_scores(terminal, parts, rows, beside, is_synthetic=is_synthetic)
        show_forest(terminal, record, with_confusion=confusion)
        target = _write_record(settings.lake, record)
        terminal.print_line(f"all figures: {target}", style="dim")
        terminal.print_json({"path": target, **record})


@onboard.command()
def warn(
    models: ModelsArgument = None, lake: LakeOption = None, quiet: QuietOption = False, json: JsonOption = False
) -> None:
    """Compare collision warnings with the true future: hits, missed, false, and how early.

    A model warns where the cells of the two vehicles overlap within 2 s (docs/onboard.md).
    """
    with command(quiet=quiet, json=json) as terminal:
        settings = read_settings(lake=lake)
        parts, _, _ = _read_parts(terminal, settings)
        rows = [
            asdict(score_warnings(model, parts.eval)) for model in _open_models(terminal, settings.lake, parts, models)
        ]
        show_warnings(terminal, rows)
        terminal.print_json({"protocol": V2V.name, "split": parts.digest, "warnings": rows})


def _read_parts(terminal: Terminal, settings: Settings) -> tuple[Parts, dict[str, int], bool]:
    """Read the lake's drives and divide their samples; also returns what is left out, and if any drive is synthetic."""
    tables = read_drives(settings.lake, load(settings.lake))
    origins = dict(tables.drives.select("subset", "origin").iter_rows())
    synthetic = describe_synthetic(origins, noun="drive", maker="instrument")
    terminal.print_origin(synthetic)
    samples, left_out = build_samples(*tables)
    return split_samples(samples, settings.split_seed), left_out, synthetic is not None


def _open_models(terminal: Terminal, root: Path, parts: Parts, names: list[str] | None) -> list[Forecaster]:
    """Make the named models ready; without names all that there are, but for those of other drives."""
    runs = root / RUNS / FOLDER
    if names:
        return [open_model(name, parts, runs) for name in dict.fromkeys(names)]
    found = [open_model(CTRV, parts, runs)]
    for name in NETWORKS:
        if (runs / name).is_dir():
            try:
                found.append(open_model(name, parts, runs))
            except TracklakeError as refused:
                terminal.print_problem(str(refused), label="skipped")
    return found


def _fit_forest(terminal: Terminal, parts: Parts) -> ManeuverForest | None:
    """Fit the forest, which takes a second; None, with the reason printed, where that is impossible."""
    try:
        return fit_forest(parts.train, seed=0)
    except TracklakeError as impossible:
        terminal.print_problem(str(impossible), label="no forest")
        return None


def _write_record(root: Path, record: dict[str, Any]) -> Path:
    """Write the record as JSON, and the scores as CSV beside it; returns the path of the former."""
    folder = root / EVALUATIONS
    with explain_file_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    scores = pl.DataFrame(
        [
            {"origin": origin, **row}
            for origin, rows in (("measured", record["scores"]), ("published", record["published"]))
            for row in rows
        ],
        infer_schema_length=None,
    )
    write_file(folder / f"{V2V.name}.csv", scores.write_csv().encode())
    target = folder / f"{V2V.name}.json"
    write_file(target, json_format.dumps(record, indent=1, allow_nan=False).encode())
    return target
