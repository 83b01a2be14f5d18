"""`tracklake lane-forest`: lane changes predicted by a random forest, and the grid cells of vehicles ahead."""

import json as json_format
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from tracklake.pipeline.cli.command import REFUSED, command, read_settings
from tracklake.pipeline.cli.comparability import print_comparability
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.lane_forest_tables import show_curve, show_published, show_scores
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, read_pairs
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import MODELS as RUNS
from tracklake.pipeline.stages.score import list_finished_runs
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.errors import TracklakeError, UsageError, explain_file_errors
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_file
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import LaneForestSettings
from tracklake.training.lane_changes.forest import ForestError, LaneForest, fit_lane_forest
from tracklake.training.lane_changes.scores import (
    evaluate_grid,
    learn_curve,
)
from tracklake.training.onboard.as_published import PublishedScores, score_published
from tracklake.training.onboard.overhead import require_ticks
from tracklake.training.runs.forecasters import Forecaster, open_forecaster

FOLDER = "lane-forest"
"""Folder of the forest, among the lake's runs."""

FOREST, SCORES = "forest.skops", "lane_forest.json"
"""Names of the files; the scores are of grid cells, so that their file is named otherwise than a run's."""

MODELS_BESIDE = ("constant-velocity", "ctrv")
"""Models scored beside the forest; they need no training."""

PUBLISHED_PROTOCOL = "grid-2021"
"""Protocol by which the published cell accuracies were measured."""

OPTIONS_OF_THEIR_OWN = ("examples", "augmentation")
"""Settings of a forest that have options of their own and are no names for `--set`."""


RunsArgument = Annotated[
    list[str] | None, typer.Argument(help="Runs whose cells are scored, too; none: all runs in the lake.")
]
ForestSeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of the draw, the shifts and the trees (default: 0).")
]
ExamplesOption = Annotated[
    int | None, typer.Option("--examples", min=4, help="Most examples drawn from the training part (default: 10000).")
]
AugmentOption = Annotated[
    bool | None,
    typer.Option("--augment/--as-recorded", help="Add mirrored and shifted copies of the examples (default: add)."),
]
ForestSetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="A setting of the forest; repeatable (start_s=3, trees=200, leaf=5)."
    ),
]
UseOption = Annotated[bool, typer.Option("--use", help="Score the stored forest beside the lake's runs; fit none.")]
CurveOption = Annotated[
    bool, typer.Option("--learning-curve", help="Also fit fewer examples, with and without augmentation.")
]
AsPublishedOption = Annotated[
    bool,
    typer.Option(
        "--as-published", help="Also fit the publication's forest, and this one, on 70 % of the vehicles; compare."
    ),
]
DecoderEpochsOption = Annotated[
    int | None,
    typer.Option("--epochs", min=1, help="With --as-published: also train its decoder, for so many epochs."),
]


def lane_forest(
    runs: RunsArgument = None,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    seed: ForestSeedOption = None,
    examples: ExamplesOption = None,
    augment: AugmentOption = None,
    settings_given: ForestSetOption = None,
    use: UseOption = False,
    learning_curve: CurveOption = False,
    as_published: AsPublishedOption = False,
    epochs: DecoderEpochsOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit a forest that predicts lane changes; score it, and the grid cells that models predict.

    Made for the protocol grid-2021; it works with any.
    """
    with command(quiet=quiet, json=json) as terminal:
        require_extras("the lane forest", "forest")
        if use and (seed, examples, augment, settings_given) != (None,) * 4:
            raise typer.BadParameter("--use scores a forest as it is: give no --seed, --examples, --augment or --set")
        if epochs is not None:
            if not as_published:
                raise typer.BadParameter("--epochs trains the decoder of --as-published: give both")
            require_extras("the decoder", "training")
        wanted = None if use else _read_forest_settings(examples, augment, settings_given or [])
        settings = read_settings(lake=lake, protocol=protocol)
        folder = TensorFolder.open(tensor_folder(settings.lake, load(settings.lake), settings))
        if as_published:
            require_ticks(folder)
        comparable = print_comparability(
            terminal, settings.lake, folder, published=folder.protocol.name == PUBLISHED_PROTOCOL
        )
        out = settings.lake / RUNS / FOLDER
        forest = _open_forest(out / FOREST, folder) if wanted is None else _fit_forest(out, folder, seed or 0, wanted)
        record = _score_forest(terminal, settings.lake / RUNS, folder, forest, runs or [], published=bool(comparable))
        _write_scores(out / SCORES, record)
        lacking = {}
        if learning_curve:
            lacking["learning curve"] = _add_curve(terminal, record, folder, forest.settings)
        if as_published:
            fit = partial(score_published, folder, forest.settings, seed or 0, with_curve=learning_curve)
            lacking["comparison"] = _add_published(terminal, record, fit, epochs or 0, shown=bool(comparable))
        _write_scores(out / SCORES, record)
        terminal.print_line(
            f"forest {out / FOREST}; coefficients of all features and scores by stratum: {out / SCORES}"
        )
        terminal.print_json({"lake": settings.lake, "path": out, **record})
        problems = {what: why for what, why in lacking.items() if why}
        for what, why in problems.items():
            terminal.print_problem(f"{why}. Everything else is done", label=f"no {what}")
        if problems:
            raise typer.Exit(REFUSED)


def _read_forest_settings(examples: int | None, augment: bool | None, pairs: list[str]) -> LaneForestSettings:
    """Make the forest's settings of the given options and the defaults."""
    known = {name: value for name, value in asdict(LaneForestSettings()).items() if name not in OPTIONS_OF_THEIR_OWN}
    given = read_pairs(pairs, known, "the forest")
    if examples is not None:
        given["examples"] = examples
    if augment is False:
        given["augmentation"] = ()
    try:
        return LaneForestSettings(**given)
    except UsageError as wrong:
        raise UsageError(f"--set {wrong}") from None


def _open_forest(file: Path, folder: TensorFolder) -> LaneForest:
    """Load a stored forest; one that was fitted for another protocol is refused."""
    forest = LaneForest.load(file)
    if forest.facts["protocol"] != folder.index["protocol"]:
        raise ForestError(
            f"{file}: fitted for another protocol than {folder.protocol.title}, that of the "
            "tensors; run `tracklake lane-forest` without --use"
        )
    return forest


def _fit_forest(out: Path, folder: TensorFolder, seed: int, settings: LaneForestSettings) -> LaneForest:
    """Fit a forest and store it; the scores of an earlier forest are removed before."""
    forest = fit_lane_forest(folder, seed, settings)
    with explain_file_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        (out / SCORES).unlink(missing_ok=True)
        forest.save(out / FOREST)
    return forest


def _score_forest(
    terminal: Terminal, models: Path, folder: TensorFolder, forest: LaneForest, runs: list[str], *, published: bool
) -> dict[str, Any]:
    """Score a forest beside models and runs, print the scores, and return the record that is stored."""
    skipped: dict[str, str] = {}

    def skip(name: str, why: str) -> None:
        skipped[name] = why
        terminal.print_problem(f"{name}: {why}", label="skipped")

    opened = list(_open_forecasters(models, folder, runs, skip))
    scores = evaluate_grid(folder, opened, forest, on_skip=skip)
    show_scores(terminal, folder, scores, forest, published=published)
    features = list(forest.names)
    facts = {"forest": forest.facts, "features": features, **asdict(scores)}
    return {**facts, "learning_curve": [], "as_published": None, "skipped": skipped}


def _add_curve(
    terminal: Terminal, record: dict[str, Any], folder: TensorFolder, settings: LaneForestSettings
) -> str | None:
    """Fit the learning curve, print it and add it to the record; the reason where it is impossible."""
    try:
        curve = learn_curve(folder, settings=settings)
    except TracklakeError as impossible:
        return str(impossible)
    record["learning_curve"] = [asdict(point) for point in curve]
    show_curve(terminal, curve)
    return None


def _add_published(
    terminal: Terminal, record: dict[str, Any], fit: Callable[..., PublishedScores], epochs: int, *, shown: bool
) -> str | None:
    """Fit and score the arm as published, print it and add it to the record; the reason where it is impossible."""
    try:
        with terminal.show_training("train the decoder") if epochs else nullcontext() as show:
            scores = fit(epochs=epochs, progress=show)
    except TracklakeError as impossible:
        return str(impossible)
    record["as_published"] = asdict(scores)
    show_published(terminal, scores, published=shown)
    return None


def _write_scores(file: Path, record: dict[str, Any]) -> None:
    write_file(file, json_format.dumps(record, indent=1, allow_nan=False).encode())


def _open_forecasters(
    models: Path, folder: TensorFolder, runs: list[str], skip: Callable[[str, str], None]
) -> Iterator[Forecaster]:
    """Open models that need no training, and the lake's runs that fit these tensors.

    A run that cannot be opened (made for other tensors, damaged, of an unknown model, torch missing) is skipped, unless
    the user named it.
    """
    for name in dict.fromkeys(
        [*MODELS_BESIDE, *(runs or [file.parent.name for file in list_finished_runs(models.parent)])]
    ):
        try:
            yield open_forecaster(name, folder, models, frozenset({"eval"}))
        except TracklakeError as refused:
            if runs:
                raise
            skip(name, str(refused))
