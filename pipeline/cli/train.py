"""`tracklake train`: a model trained on the lake's split, or a training resumed where it was interrupted."""

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.comparability import print_lane_centres
from tracklake.pipeline.cli.console import Terminal, find_command
from tracklake.pipeline.cli.lane_forest import FOLDER as FOREST
from tracklake.pipeline.cli.options import (
    JsonOption,
    LakeOption,
    OnlyDatasetOption,
    OnlyRecordingOption,
    ProtocolOption,
    QuietOption,
    read_pairs,
)
from tracklake.pipeline.cli.score_tables import describe_fit
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import MODELS as RUNS
from tracklake.pipeline.stages.drive_score import FOLDER as ONBOARD
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.errors import explain_file_errors
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.text import quote_shell
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MODELS, Model, find_model
from tracklake.training.models.fitting import Fit
from tracklake.training.runs.config import RECIPE_SETTINGS, TrainConfig
from tracklake.training.train import TrainingInterruptedError
from tracklake.training.train import train as train_model

SecondsOption = Annotated[
    float | None, typer.Option("--seconds", min=0.1, help="How long to train; default: the model's own epochs.")
]
EpochsOption = Annotated[int | None, typer.Option("--epochs", min=1, help="Epochs of all its phases together.")]
StepsOption = Annotated[
    int | None, typer.Option("--steps", min=1, help="Steps of the optimiser, of all phases together.")
]
EpochSamplesOption = Annotated[
    int | None,
    typer.Option(
        "--samples-per-epoch", min=1, help="Most samples of an epoch, drawn again each epoch (default: 200000)."
    ),
]
PatienceOption = Annotated[
    int | None,
    typer.Option("--patience", min=1, help="Stop after so many epochs without a better loss on `val`; keep the best."),
]
TrainingSeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of weights, batches and dropout (default: 0).")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="A setting of the model or its recipe; repeatable (batch_size=64)."
    ),
]
ResumeOption = Annotated[
    bool | None,
    typer.Option(
        "--resume/--anew",
        help="Continue an interrupted training with its own settings; or start over, and replace what has this name.",
    ),
]
NoEvaluationOption = Annotated[
    bool, typer.Option("--no-evaluation", help="Train also where the split has nothing to evaluate on.")
]


def train(
    model: Annotated[str, typer.Argument(help="A model's name, for instance lstm, or your own as mymodule:MyModel.")],
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    dataset: OnlyDatasetOption = None,
    recording: OnlyRecordingOption = None,
    seconds: SecondsOption = None,
    epochs: EpochsOption = None,
    steps: StepsOption = None,
    samples_per_epoch: EpochSamplesOption = None,
    patience: PatienceOption = None,
    seed: TrainingSeedOption = None,
    settings: SetOption = None,
    resume: ResumeOption = None,
    no_evaluation: NoEvaluationOption = False,
    device: Annotated[str | None, typer.Option("--device", help="cpu or cuda (default: cpu).")] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Threads of torch (default: 1).")] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the run; default: the model's.")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Train a model on the split's training part and evaluate it once on the evaluation part."""
    with command(quiet=quiet, json=json) as terminal:
        entry = find_model(model)
        run_name = _check_name(model.rpartition(":")[2] if name is None else name, model)
        if not entry.learns and not entry.fitted:
            raise typer.BadParameter(f"{model} does not learn; `tracklake evaluate {model}` scores it")
        given: dict[str, Any] = {"seconds": seconds, "epochs": epochs, "steps": steps, "patience": patience}
        given |= {"samples_per_epoch": samples_per_epoch, "seed": seed, "device": device, "threads": threads}
        unused = [own for own, value in {**given, "resume": resume or None}.items() if value is not None]
        if entry.fitted and unused:
            names = ", ".join(f"--{own.replace('_', '-')}" for own in unused)
            raise typer.BadParameter(f"{model} is fitted in one pass over `train`, without {names}; it takes --set")
        given |= {"dataset": dataset, "recording": recording}
        given |= read_model_settings(entry, settings or [])
        config = _make_config({key: value for key, value in given.items() if value is not None}, resume=resume)
        found = read_settings(lake=lake, protocol=protocol)
        tensors = tensor_folder(found.lake, load(found.lake), found)
        folder = TensorFolder.open(tensors).narrow(dataset, recording)
        terminal.print_origin(describe_synthetic(folder.origins))
        print_lane_centres(terminal, folder)
        out = found.lake / RUNS / run_name
        try:
            with explain_file_errors(out), terminal.show_training(f"train {model}") as show:
                metrics = train_model(
                    model, tensors, out, config, show, resume=resume, without_evaluation=no_evaluation
                )
        except TrainingInterruptedError as stopped:
            again = ["train", model, "--resume", *(["--name", name] if name is not None else [])]
            again += ["--lake", str(lake)] if lake is not None else []
            again += ["--protocol", protocol] if protocol is not None else []
            again += ["--no-evaluation"] if no_evaluation else []
            command_again = f"{find_command()} {' '.join(map(quote_shell, again))}"
            raise KeyboardInterrupt(f"{stopped}\nTo go on: {command_again}") from None
        _show_training(terminal, metrics, out)
        terminal.print_json(metrics)


def _check_name(name: str, model: str) -> str:
    """Refuse a name that is no run's: a path, a folder of others, or another model that is no network."""
    if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", name):
        raise typer.BadParameter(f"--name is a plain name (letters, digits, `-`, `_`, `.`); got {name!r}")
    if name in (FOREST, ONBOARD):
        keeps = "`tracklake lane-forest` keeps its forest" if name == FOREST else "`tracklake onboard` keeps its runs"
        raise typer.BadParameter(f"`{name}` is where {keeps}; name the run otherwise")
    if name in MODELS and not MODELS[name].learns and not (name == model and MODELS[name].fitted):
        raise typer.BadParameter(f"{name} does not learn; `tracklake evaluate {name}` scores it")
    return name


def read_model_settings(entry: Model, settings: list[str]) -> dict[str, Any]:
    """Read NAME=VALUE pairs as keywords of TrainConfig: settings of the recipe, and `parameters` of the model."""
    recipe = {name: getattr(entry.recipe, name) for name in RECIPE_SETTINGS} if entry.recipe else {}
    known = {**recipe, **entry.settings}
    read = read_pairs(settings, known, entry.name)
    config = {name: value for name, value in read.items() if name in recipe}
    parameters = {name: value for name, value in read.items() if name not in recipe}
    return {**config, **({"parameters": parameters} if parameters else {})}


def _make_config(given: dict[str, Any], *, resume: bool | None) -> TrainConfig | None:
    """Make the config of the given options; None to resume a training with its own settings."""
    if resume and not given:
        return None
    return TrainConfig(**given)


def _show_training(terminal: Terminal, metrics: dict[str, Any], out: Path) -> None:
    """Print what a training took and reached, and what can be done next."""
    if metrics["evaluation"] is not None:
        _show_scores(terminal, metrics["evaluation"])
    else:
        terminal.print_line("note: nothing was scored: the split has no samples in `eval`; add recordings", style="dim")
    if fit := metrics.get("fit"):
        terminal.print_line(describe_fit(Fit(**fit)))
    else:
        terminal.print_line(
            f"{metrics['steps']:,} steps in {metrics['seconds']:,.1f} s: {metrics['samples_per_s']:,.0f} samples/s; "
            f"reading them took {metrics['data_share']:.1%} of it"
        )
    terminal.print_line(f"run {out}; `tracklake evaluate` compares runs, `tracklake report` adds them to the report")


def _show_scores(terminal: Terminal, evaluation: dict[str, Any]) -> None:
    """Print the errors at each horizon, with the number of samples behind them."""
    title = (
        f"{evaluation['model']} on {evaluation['part']} of {evaluation['split']} "
        f"({evaluation['samples']:,} samples, protocol {evaluation['protocol']})"
    )
    figures = ("rmse_m", "rmse_longitudinal_m", "rmse_lateral_m", "mae_m")
    rows = [
        [f"{row['seconds']:g} s", *(format_number(row[name]) for name in figures), f"{row['n']:,}"]
        for row in evaluation["horizons"]
    ]
    headings = ["horizon", "RMSE m", "longitudinal m", "lateral m", "MAE m", "n"]
    print_table(terminal, headings, rows, title=title, right=[True] * len(headings))
