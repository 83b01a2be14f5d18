"""`tracklake lane-forest`: lane changes foretold by a random forest, and the cells in which vehicles will be.

Like the other commands, it imports heavy libraries where they are used.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.options import JsonOption, LakeOption, ProtocolOption, QuietOption
from pipeline.session import command, read_settings

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pipeline.terminal import Terminal
    from training.lane_changes.grid import CellScore, GridScores
    from training.lane_changes.learning import LearningPoint
    from training.models import Predictor, Reads
    from training.tensors import TensorFolder

FOLDER = "lane-forest"
"""Of the lake's models."""
FOREST, SCORES = "forest.npz", "lane_forest.json"
"""The scores are not called as those of a run: they are of cells, and the report's are of places."""
MODELS_BESIDE = ("constant-velocity", "ctrv")
"""They need no training."""


def lane_forest(
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the draw, the shifts and the trees.")] = 0,
    examples: Annotated[
        int | None, typer.Option("--examples", min=4, help="Drawn from the training part at most (default: 10000).")
    ] = None,
    augment: Annotated[
        bool, typer.Option("--augment/--as-recorded", help="Add mirrored and shifted copies of the examples.")
    ] = True,
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
        import json as json_text
        from dataclasses import replace

        from pipeline.lake import load, write_aside
        from pipeline.lake.files import MODELS
        from pipeline.stages.tensors import tensor_folder
        from training.lane_changes import LaneForestSettings, evaluate_grid, fit_lane_forest, learn_curve
        from training.observed import FutureInputError
        from training.tensors import TensorFolder

        settings = read_settings(lake=lake, protocol=protocol)
        folder = TensorFolder.open(tensor_folder(settings.lake, load(settings.lake), settings))
        asked = LaneForestSettings()
        asked = replace(asked, examples=examples or asked.examples, augmentation=asked.augmentation if augment else ())
        forest = fit_lane_forest(folder, seed, asked)
        predictors, reads = _find_predictors(terminal, settings.lake / MODELS, folder)
        try:
            scores = evaluate_grid(folder, predictors, forest, reads=reads)
        except FutureInputError as leak:
            raise ValueError(str(leak)) from leak
        curve = learn_curve(folder, settings=asked) if learning_curve else []

        out = settings.lake / MODELS / FOLDER
        out.mkdir(parents=True, exist_ok=True)
        forest.save(out / FOREST)
        record = {
            "forest": forest.facts,
            "features": list(forest.names),
            **scores.to_dict(),
            "learning_curve": [point.to_dict() for point in curve],
        }
        write_aside(out / SCORES, json_text.dumps(record, indent=1, allow_nan=False).encode())
        _show(terminal, folder, scores, curve, forest.names)
        terminal.say(f"forest {out / FOREST}; coefficients of all features and scores by stratum: {out / SCORES}")
        terminal.give({"lake": settings.lake, "path": out, **record})


def _find_predictors(
    terminal: "Terminal", models: Path, folder: "TensorFolder"
) -> tuple[dict[str, "Predictor"], dict[str, "Reads"]]:
    """Models that need no training, and the lake's runs that were trained on these tensors, with what each reads."""
    from pipeline.stages.score import finished_runs
    from training.models import MODELS
    from training.runs import StaleRunError, load_run, refuse_leak

    predictors: dict[str, Predictor] = {name: MODELS[name].build(folder.protocol) for name in MODELS_BESIDE}
    reads = {name: MODELS[name].reads for name in MODELS_BESIDE}
    for path in (file.parent for file in finished_runs(models.parent)):
        if path.name in predictors:
            continue
        try:
            run = load_run(path, folder.protocol)
            refuse_leak(run.config, folder, "eval")
        except StaleRunError as stale:
            terminal.complain(str(stale), label="passed by")
            continue
        predictors[path.name] = run.predictor
        reads[path.name] = MODELS[run.config["model"]].reads
    return predictors, reads


def _show(
    terminal: "Terminal",
    folder: "TensorFolder",
    scores: "GridScores",
    curve: "list[LearningPoint]",
    features: tuple[str, ...],
) -> None:
    """Print cell accuracies by horizon, those of the last by stratum, what the forest says of maneuvers, the curve."""
    protocol = folder.protocol
    terminal.say(f"eval of {folder.split}, protocol {protocol.name} ({protocol.digest})", style="bold")
    _show_cells(terminal, scores.cells, protocol.name)
    rows = [
        [own.stratum, f"{own.n:,}", *map(_percent, (own.accuracy, *own.recall.values(), own.majority))]
        for own in scores.maneuvers
    ]
    recalls = [f"of {name} %" for name in scores.maneuvers[0].recall]
    _show_table(terminal, "maneuver right", ["n", "all %", *recalls, "always the commonest %"], rows)
    terminal.say(f"{scores.left_out:,} samples are not scored: what they do is not recorded to the end", style="dim")
    terminal.say(f"features, the strongest first: {', '.join(features)}", style="dim")
    if curve:
        points = [
            [f"{own.drawn:,}", "yes" if own.augmented else "no", own.seed, *map(_percent, figures)]
            for own in curve
            for figures in [(own.accuracy, own.balanced, own.lane)]
        ]
        headings = ["augmented", "seed", "maneuver right %", "mean recall %", "lane right %"]
        _show_table(terminal, "learning curve, examples drawn", headings, points)


def _show_cells(terminal: "Terminal", cells: "list[CellScore]", protocol: str) -> None:
    from training.lane_changes.grid import ALL
    from training.published import CELL_ACCURACY, CELL_ACCURACY_S

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
