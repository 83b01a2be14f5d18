"""`tracklake lane-forest`: lane changes foretold by a random forest, and the cells in which vehicles will be.

Like the other commands, it imports heavy libraries where they are used.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, read_pairs
from tracklake.pipeline.cli.session import REFUSED, command, read_settings
from tracklake.schemas.errors import TracklakeError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from tracklake.pipeline.cli.console import Terminal
    from tracklake.training.data.tensor_folder import TensorFolder
    from tracklake.training.lane_changes import LaneForest, LaneForestSettings
    from tracklake.training.lane_changes.grid import CellScore, GridScores
    from tracklake.training.lane_changes.learning_curve import LearningPoint
    from tracklake.training.models import Predictor, Reads

FOLDER = "lane-forest"
"""Of the lake's models."""
FOREST, SCORES = "forest.skops", "lane_forest.json"
"""The scores are not called as those of a run: they are of cells, and the report's are of places."""
MODELS_BESIDE = ("constant-velocity", "ctrv")
"""They need no training."""
OPTIONS_OF_THEIR_OWN = ("examples", "augmentation")
"""Settings of a forest that `--set` does not take."""


def lane_forest(
    runs: Annotated[
        list[str] | None, typer.Argument(help="Runs whose cells are scored, too; none: all runs in the lake.")
    ] = None,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Of the draw, the shifts and the trees (default: 0).")
    ] = None,
    examples: Annotated[
        int | None, typer.Option("--examples", min=4, help="Drawn from the training part at most (default: 10000).")
    ] = None,
    augment: Annotated[
        bool | None,
        typer.Option("--augment/--as-recorded", help="Add mirrored and shifted copies of the examples (default: do)."),
    ] = None,
    settings_given: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Of the forest; repeatable (start_s=3, trees=200, leaf=5)."),
    ] = None,
    use: Annotated[
        bool, typer.Option("--use", help="Score the stored forest, beside the runs there are now; fit none.")
    ] = False,
    learning_curve: Annotated[
        bool, typer.Option("--learning-curve", help="Also fit fewer examples, with and without augmentation.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Fit a forest that foretells lane changes; score it, and the grid cells that models and trained runs predict.

    Made for the protocol grid-2021; it works with any.
    """
    with command(quiet=quiet, json=json) as terminal:
        from tracklake.pipeline.lake import load
        from tracklake.pipeline.lake.files import MODELS
        from tracklake.pipeline.stages.tensors import tensor_folder
        from tracklake.schemas.errors import TracklakeError, explain_file_errors
        from tracklake.training.data.tensor_folder import TensorFolder
        from tracklake.training.lane_changes import LaneForestSettings, evaluate_grid, fit_lane_forest, learn_curve

        if use and (seed, examples, augment, settings_given) != (None,) * 4:
            raise typer.BadParameter("--use scores a forest as it is: give no --seed, --examples, --augment or --set")
        asked = _read_settings(examples, augment, settings_given or [])
        settings = read_settings(lake=lake, protocol=protocol)
        folder = TensorFolder.open(tensor_folder(settings.lake, load(settings.lake), settings))
        out = settings.lake / MODELS / FOLDER
        if use:
            forest = _open_forest(out / FOREST, folder)
            asked = LaneForestSettings.read(forest.facts["settings"])
        else:
            forest = fit_lane_forest(folder, seed or 0, asked)
            with explain_file_errors(out):
                out.mkdir(parents=True, exist_ok=True)
                (out / SCORES).unlink(missing_ok=True)  # of another forest
                forest.save(out / FOREST)
        passed_by: dict[str, str] = {}

        def pass_by(name: str, why: str) -> None:
            passed_by[name] = why
            terminal.complain(f"{name}: {why}", label="passed by")

        predictors, reads = _find_predictors(settings.lake / MODELS, folder, runs or [], pass_by)
        scores = evaluate_grid(folder, predictors, forest, reads=reads, on_skip=pass_by)
        record = {
            "forest": forest.facts,
            "features": list(forest.names),
            **scores.to_dict(),
            "learning_curve": [],
            "passed_by": passed_by,
        }
        _write(out / SCORES, record)
        _show(terminal, folder, scores, forest)
        no_curve = ""
        if learning_curve:
            try:
                curve = learn_curve(folder, settings=asked)
            except TracklakeError as impossible:
                no_curve = str(impossible)
            else:
                record["learning_curve"] = [point.to_dict() for point in curve]
                _write(out / SCORES, record)
                _show_curve(terminal, curve)
        terminal.say(f"forest {out / FOREST}; coefficients of all features and scores by stratum: {out / SCORES}")
        terminal.give({"lake": settings.lake, "path": out, **record})
        if no_curve:
            terminal.complain(f"{no_curve}. Everything else is done", label="no learning curve")
            raise typer.Exit(REFUSED)


def _read_settings(examples: int | None, augment: bool | None, pairs: list[str]) -> "LaneForestSettings":
    """What was said of the forest; the rest is as it is by itself."""
    from dataclasses import asdict

    from tracklake.training.lane_changes import LaneForestSettings

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


def _open_forest(file: Path, folder: "TensorFolder") -> "LaneForest":
    """A stored forest, for tensors of the protocol that it was fitted for."""
    from tracklake.training.lane_changes import ForestError, LaneForest

    forest = LaneForest.load(file)
    if forest.facts["protocol"] != folder.index["protocol"]:
        raise ForestError(
            f"{file}: fitted for another protocol than {folder.protocol.name} ({folder.protocol.digest}), that of the "
            "tensors; run `tracklake lane-forest` without --use"
        )
    return forest


def _write(file: Path, record: dict[str, Any]) -> None:
    import json

    from tracklake.schemas.files import write_file

    write_file(file, json.dumps(record, indent=1, allow_nan=False).encode())


def _find_predictors(
    models: Path, folder: "TensorFolder", runs: list[str], pass_by: "Callable[[str, str], None]"
) -> tuple[dict[str, "Predictor"], dict[str, "Reads"]]:
    """Models that need no training, and the lake's runs that were trained on these tensors, with what each reads.

    What cannot be opened (made for other tensors, damaged, of an unknown model, torch missing) is passed by, unless it
    was asked for by name.
    """
    from tracklake.pipeline.stages.score import finished_runs
    from tracklake.training.models import MODELS
    from tracklake.training.runs.forecasters import open_forecaster

    predictors: dict[str, Predictor] = {name: MODELS[name].build(folder.protocol) for name in MODELS_BESIDE}
    reads = {name: MODELS[name].reads for name in MODELS_BESIDE}
    for name in runs or [file.parent.name for file in finished_runs(models.parent)]:
        if name in predictors:
            continue
        try:
            own = open_forecaster(name, folder, models, frozenset({"eval"}))
        except TracklakeError as refused:
            if runs:
                raise
            pass_by(name, str(refused))
            continue
        predictors[name], reads[name] = own.predictor, own.reads
    return predictors, reads


def _show(terminal: "Terminal", folder: "TensorFolder", scores: "GridScores", forest: "LaneForest") -> None:
    """Print cell accuracies by horizon, those of the last by stratum, and what the forest says of maneuvers."""
    protocol = folder.protocol
    terminal.say(f"eval of {folder.split}, protocol {protocol.name} ({protocol.digest})", style="bold")
    _show_cells(terminal, scores.cells, protocol.name)
    rows = [
        [own.stratum, f"{own.n:,}", *map(_percent, (own.accuracy, *own.recall.values(), own.majority))]
        for own in scores.maneuvers
    ]
    recalls = [f"of {name} %" for name in scores.maneuvers[0].recall]
    _show_table(terminal, "maneuver right", ["n", "all %", *recalls, "always the commonest %"], rows)
    _show_left_out(terminal, protocol.horizon_s, forest.facts["settings"]["start_s"], scores)
    terminal.say(f"features, the strongest first: {', '.join(forest.names)}", style="dim")


def _show_left_out(terminal: "Terminal", horizon_s: float, start_s: float, scores: "GridScores") -> None:
    """How many samples are not scored, and why."""
    told = {
        "no lane": "no lane now",
        "future unknown": f"not recorded for {horizon_s:g} s",
        "maneuver unknown": f"recorded for {horizon_s:g} s but not for the {start_s:g} s in which a change would begin "
        "(left out of the cells, too, whose strata are by maneuver)",
        "speed unknown": "of unknown speed",
    }
    why = "; ".join(f"{count:,} {told[reason]}" for reason, count in scores.left_out_by_reason.items() if count)
    terminal.say(f"{scores.left_out:,} samples are not scored{': ' * bool(why)}{why}", style="dim")


def _show_curve(terminal: "Terminal", curve: "list[LearningPoint]") -> None:
    from tracklake.training.lane_changes.learning_curve import SIZES

    points = [
        [f"{own.drawn:,}", "yes" if own.augmented else "no", own.seed, *map(_percent, figures)]
        for own in curve
        for figures in [(own.accuracy, own.balanced, own.lane)]
    ]
    headings = ["augmented", "seed", "maneuver right %", "mean recall %", "lane right %"]
    _show_table(terminal, "learning curve, examples drawn", headings, points)
    last = max((own.drawn for own in curve), default=0)
    if last < max(SIZES):
        terminal.say(f"it ends at {last:,} examples, with which the smallest stratum is used up", style="dim")


def _show_cells(terminal: "Terminal", cells: "list[CellScore]", protocol: str) -> None:
    from tracklake.training.evaluation.published import CELL_ACCURACY, CELL_ACCURACY_S
    from tracklake.training.lane_changes.examples import ALL

    horizons = sorted({own.seconds for own in cells})
    strata = list(dict.fromkeys(own.stratum for own in cells))
    by_key = {(own.model, own.column, own.seconds, own.stratum): own for own in cells}
    lines = list(dict.fromkeys((own.model, own.column) for own in cells))
    if not lines:
        terminal.say("no score: the evaluation part has no sample whose maneuver is known to the end")
        return
    first = lines[0]
    rows: list[list[Any]] = [
        [_name(*line), *(_percent(by_key[*line, ahead, ALL].cell) for ahead in horizons)] for line in lines
    ]
    for title, figure in (("always the commonest cell", "majority"), ("true place outside of the nine", "outside")):
        rows.append([title, *(_percent(getattr(by_key[*first, ahead, ALL], figure)) for ahead in horizons)])
    rows.append(["n", *(f"{by_key[*first, ahead, ALL].n:,}" for ahead in horizons)])
    if protocol == "grid-2021":
        for model, shares in CELL_ACCURACY.items():
            known = dict(zip(CELL_ACCURACY_S, shares, strict=True))
            rows.append([f"{model}, published", *(_percent(known.get(ahead)) for ahead in horizons)])
    _show_table(terminal, "right cell, %", [f"{ahead:g} s" for ahead in horizons], rows)
    last = horizons[-1]
    rows = [[_name(*line), *(_percent(by_key[*line, last, name].cell) for name in strata)] for line in lines]
    rows.append(["n", *(f"{by_key[*first, last, name].n:,}" for name in strata)])
    _show_table(terminal, f"right cell at {last:g} s, %", strata, rows)
    rows = [
        [_name(*line), _percent(own.row), _percent(own.lane), _percent(own.cell_clipped)]
        for line in lines
        for own in [by_key[*line, last, ALL]]
    ]
    _show_table(terminal, f"at {last:g} s, %", ["right row", "right column", "cell, outer ones endless"], rows)


def _name(model: str, column: str) -> str:
    return model if column == "place" else f"{model} + {column}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.2f}"


def _show_table(terminal: "Terminal", title: str, headings: list[str], rows: "Iterable[list[Any]]") -> None:
    """The first column is of names, the others of figures."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("")
    for heading in headings:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*(escape(str(value)) for value in row))
    if terminal.talks:
        terminal.out.print(table)
