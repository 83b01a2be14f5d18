"""`tracklake train`: a model trained on the lake's split, and gone on with where it was interrupted.

Like the other commands, it imports heavy libraries where they are used.
"""

import re
import shlex
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, read_pairs
from tracklake.pipeline.cli.session import command, failure, read_settings

if TYPE_CHECKING:
    from tracklake.training.models import Model
    from tracklake.training.runs.config import TrainConfig


def train(
    model: Annotated[str, typer.Argument(help="A model's name, for instance lstm.")],
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, help="How long to train; default: the model's own epochs.")
    ] = None,
    epochs: Annotated[int | None, typer.Option("--epochs", min=1, help="Of all its phases together.")] = None,
    steps: Annotated[
        int | None, typer.Option("--steps", min=1, help="Of the optimiser, of all phases together.")
    ] = None,
    samples_per_epoch: Annotated[
        int | None, typer.Option("--samples-per-epoch", min=1, help="At most, drawn anew each epoch (default: 200000).")
    ] = None,
    patience: Annotated[
        int | None,
        typer.Option(
            "--patience", min=1, help="Stop after so many epochs without a better loss on `val`; keep the best."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of weights, batches and dropout (default: 0).")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Of the model or its recipe; repeatable (batch_size=64)."),
    ] = None,
    resume: Annotated[
        bool | None,
        typer.Option("--resume/--anew", help="Go on with an interrupted training, as it was begun; or lose it."),
    ] = None,
    device: Annotated[str | None, typer.Option("--device", help="cpu or cuda (default: cpu).")] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Of torch (default: 1).")] = None,
    name: Annotated[str | None, typer.Option("--name", help="Name of the run; default: the model's.")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Train a model on the split's training part and evaluate it once on the evaluation part."""
    with command(quiet=quiet, json=json) as terminal:
        from tracklake.pipeline.cli.console import command_here, show_scores
        from tracklake.pipeline.lake import load
        from tracklake.pipeline.lake.files import MODELS
        from tracklake.pipeline.stages.tensors import tensor_folder
        from tracklake.training.models import MODELS as MODELS_KNOWN

        if model not in MODELS_KNOWN:
            raise typer.BadParameter(f"MODEL is one of {', '.join(MODELS_KNOWN)}; got {model!r}")
        run_name = _check_name(model if name is None else name)
        entry = MODELS_KNOWN[model]
        if not entry.learns:
            raise typer.BadParameter(f"{model} does not learn; `tracklake evaluate {model}` scores it")
        given = {
            "seconds": seconds,
            "epochs": epochs,
            "steps": steps,
            "samples_per_epoch": samples_per_epoch,
            "patience": patience,
            "seed": seed,
            "device": device,
            "threads": threads,
            **_read_settings_of_model(entry, settings or []),
        }
        config = _make_config({key: value for key, value in given.items() if value is not None}, resume=resume)
        found = read_settings(lake=lake, protocol=protocol)
        tensors = tensor_folder(found.lake, load(found.lake), found)
        out = found.lake / MODELS / run_name
        from tracklake.training.train import TrainingInterruptedError
        from tracklake.training.train import train as train_model

        try:
            with terminal.measuring(f"train {model}") as tell:
                metrics = train_model(model, tensors, out, config, tell, resume=resume)
        except TrainingInterruptedError as stopped:
            again = [command_here(), "train", model, "--resume", *(["--name", name] if name is not None else [])]
            again += ["--lake", str(lake)] if lake is not None else []
            again += ["--protocol", protocol] if protocol is not None else []
            raise failure(terminal, f"{stopped}\nTo go on: {shlex.join(again)}") from None
        if metrics["evaluation"] is not None:
            show_scores(terminal, [metrics["evaluation"]])
        else:
            terminal.say("note: nothing was scored: the split has no samples in `eval`; add recordings", style="dim")
        terminal.say(
            f"{metrics['steps']:,} steps in {metrics['seconds']:,.1f} s: {metrics['samples_per_s']:,.0f} samples/s; "
            f"reading them took {metrics['data_share']:.1%} of it"
        )
        terminal.say(f"run {out}; `tracklake evaluate` compares runs, `tracklake report` adds them to the report")
        terminal.give(metrics)


def _check_name(name: str) -> str:
    """A run's name, which is a folder's."""
    from tracklake.pipeline.cli.lane_forest import FOLDER as FOREST
    from tracklake.training.models import MODELS

    if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", name):
        raise typer.BadParameter(f"--name is a plain name (letters, digits, `-`, `_`, `.`); got {name!r}")
    if name == FOREST:
        raise typer.BadParameter(f"`{name}` is where `tracklake lane-forest` keeps its forest; name the run otherwise")
    if name in MODELS and not MODELS[name].learns:
        raise typer.BadParameter(f"{name} does not learn; `tracklake evaluate {name}` scores it")
    return name


def _read_settings_of_model(entry: "Model", settings: list[str]) -> dict[str, Any]:
    """NAME=VALUE pairs as keywords of TrainConfig: settings of the recipe, and `parameters` of the model."""
    from tracklake.training.runs.config import RECIPE_SETTINGS

    recipe = {name: getattr(entry.recipe, name) for name in RECIPE_SETTINGS}
    known = {**recipe, **entry.parameters}
    read = read_pairs(settings, known, entry.name)
    config = {name: value for name, value in read.items() if name in recipe}
    parameters = {name: value for name, value in read.items() if name not in recipe}
    return {**config, **({"parameters": parameters} if parameters else {})}


def _make_config(given: dict[str, Any], *, resume: bool | None) -> "TrainConfig | None":
    """What was said about the training; None where nothing was and a training is gone on with as it was begun."""
    from tracklake.training.runs.config import TrainConfig

    if resume and not given:
        return None
    return TrainConfig(**given)
