"""Tables of `tracklake lane-forest` in a terminal: cells, maneuvers, learning curves, and the arm as published."""

from collections.abc import Sequence
from typing import Any

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.schemas.lane_forest import ALL, CellScore, GridScores, LearningPoint
from tracklake.schemas.protocols import V2V
from tracklake.schemas.published_results import CELL_ACCURACY, CELL_ACCURACY_S
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.forest import LaneForest
from tracklake.training.lane_changes.scores import SIZES
from tracklake.training.onboard.as_published import PublishedScores

CELL_ACCURACIES = {
    "cell": "right cell",
    "cell_clipped": "right cell, outer ones endless",
    "one_against_rest": "one cell against the rest, mean",
}
"""Names of the three accuracies of cells, by their fields of `CellScore`."""


def show_scores(
    terminal: Terminal, folder: TensorFolder, scores: GridScores, forest: LaneForest, *, published: bool
) -> None:
    """Print cell accuracies by horizon, those of the last horizon by stratum, and the maneuvers' accuracies."""
    protocol = folder.protocol
    terminal.print_line(f"eval of {folder.split}, protocol {protocol.title}", style="bold")
    _show_cells(terminal, scores.cells, published=published)
    rows = [
        [own.stratum, f"{own.n:,}", *map(_format_percent, (own.accuracy, *own.recall.values(), own.majority))]
        for own in scores.maneuvers
    ]
    recalls = [f"of {name} %" for name in scores.maneuvers[0].recall]
    _show_table(terminal, "maneuver right", ["n", "all %", *recalls, "always the commonest %"], rows)
    _show_left_out(terminal, protocol.horizon_s, forest.facts["settings"]["start_s"], scores)
    terminal.print_line(f"features, the strongest first: {', '.join(forest.names)}", style="dim")


def _show_left_out(terminal: Terminal, horizon_s: float, start_s: float, scores: GridScores) -> None:
    """Print how many samples are not scored, and why."""
    reasons = {
        "no lane": "no lane now",
        "future unknown": f"not recorded for {horizon_s:g} s",
        "maneuver unknown": f"recorded for {horizon_s:g} s but not for the {start_s:g} s in which a change would begin "
        "(left out of the cells, too, whose strata are by maneuver)",
        "speed unknown": "of unknown speed",
    }
    why = "; ".join(f"{count:,} {reasons[reason]}" for reason, count in scores.left_out_by_reason.items() if count)
    terminal.print_line(f"{scores.left_out:,} samples are not scored{': ' * bool(why)}{why}", style="dim")


def show_curve(terminal: Terminal, curve: list[LearningPoint]) -> None:
    """Print the learning curve of our forest."""
    points = [
        [f"{own.drawn:,}", "yes" if own.augmented else "no", own.seed, *map(_format_percent, figures)]
        for own in curve
        for figures in [(own.accuracy, own.balanced, own.lane)]
    ]
    headings = ["augmented", "seed", "maneuver right %", "mean recall %", "lane right %"]
    _show_table(terminal, "learning curve, examples drawn", headings, points)
    last = max((own.drawn for own in curve), default=0)
    if last < max(SIZES):
        terminal.print_line(f"it ends at {last:,} examples, with which the smallest stratum is used up", style="dim")


def _show_cells(terminal: Terminal, cells: list[CellScore], *, published: bool) -> None:
    horizons = sorted({own.seconds for own in cells})
    strata = list(dict.fromkeys(own.stratum for own in cells))
    by_key = {(own.model, own.column, own.seconds, own.stratum): own for own in cells}
    lines = list(dict.fromkeys((own.model, own.column) for own in cells))
    if not lines:
        terminal.print_line("no score: the evaluation part has no sample whose maneuver is known to the end")
        return
    first = lines[0]
    _show_accuracy(terminal, f"{CELL_ACCURACIES['cell']}, %", cells, "cell", published=published)
    last = horizons[-1]
    rows = [
        [_name_line(*line), *(_format_percent(by_key[*line, last, name].cell) for name in strata)] for line in lines
    ]
    rows.append(["n", *(f"{by_key[*first, last, name].n:,}" for name in strata)])
    _show_table(terminal, f"right cell at {last:g} s, %", strata, rows)
    rows = [
        [_name_line(*line), *map(_format_percent, (own.row, own.lane, own.cell_clipped, own.one_against_rest))]
        for line in lines
        for own in [by_key[*line, last, ALL]]
    ]
    _show_table(terminal, f"at {last:g} s, %", ["right row", "right column", *list(CELL_ACCURACIES.values())[1:]], rows)


def _show_accuracy(terminal: Terminal, title: str, cells: Sequence[CellScore], figure: str, *, published: bool) -> None:
    """Print one accuracy of cells over all samples, by horizon, with what stands beside it."""
    everything = [own for own in cells if own.stratum == ALL]
    horizons = sorted({own.seconds for own in everything})
    lines: dict[tuple[str, str], list[CellScore]] = {}
    for own in sorted(everything, key=lambda own: own.seconds):
        lines.setdefault((own.model, own.column), []).append(own)
    rows = [
        [_name_line(*line), *(_format_percent(getattr(own, figure)) for own in scores)]
        for line, scores in lines.items()
    ]
    first = next(iter(lines.values()))
    if figure == "cell":
        for name, other in (("always the commonest cell", "majority"), ("true place outside of the nine", "outside")):
            rows.append([name, *(_format_percent(getattr(own, other)) for own in first)])
    rows.append(["n", *(f"{own.n:,}" for own in first)])
    for model, shares in CELL_ACCURACY.items() if published else ():
        known = dict(zip(CELL_ACCURACY_S, shares, strict=True))
        rows.append([f"{model}, published", *(_format_percent(known.get(ahead)) for ahead in horizons)])
    _show_table(terminal, title, [f"{ahead:g} s" for ahead in horizons], rows)


def show_published(terminal: Terminal, scores: PublishedScores, *, published: bool) -> None:
    """Print the arm as published beside our forest: cells on both grids, maneuvers, errors and the learning curve."""
    counts = [f"{scores.samples[part]:,} samples of {scores.vehicles[part]:,} vehicles" for part in scores.samples]
    title = f"as published (Choi et al. 2021): 70:30 by vehicle, train {counts[0]}, eval {counts[1]}"
    terminal.print_line(title, style="bold")
    for grid, cells in scores.cells.items():
        for figure, name in CELL_ACCURACIES.items():
            _show_accuracy(terminal, f"{name}, %; rows {grid}", cells, figure, published=published)
    rows = [
        [f"forest {name}", f"{own.n:,}", *map(_format_percent, (own.accuracy, own.balanced, own.majority))]
        for name, (own, *_) in scores.maneuvers.items()
    ]
    _show_table(terminal, "maneuver right", ["n", "all %", "mean recall %", "always the commonest %"], rows)
    by_model: dict[str, list[float]] = {}
    for error in scores.errors:
        by_model.setdefault(error.model, []).append(error.mae_m)
    rows = [[model, *(format_number(own, 2) for own in mae_m)] for model, mae_m in by_model.items()]
    _show_table(terminal, "MAE, m", [f"{ahead:g} s" for ahead in V2V.scored_s], rows)
    if scores.decoder:
        epochs, best = len(scores.decoder.losses), scores.decoder.best + 1
        ended = "converged" if scores.decoder.converged else "not converged: give more --epochs"
        terminal.print_line(
            f"decoder: {epochs} epochs, the smallest loss on vehicles held back after {best}; {ended}", style="dim"
        )
    if scores.learning_curve:
        rows = [
            [f"{own.drawn:,}", _format_percent(own.train_accuracy), _format_percent(own.eval_accuracy)]
            for own in scores.learning_curve
        ]
        headings = ["train, right %", "eval, right %"]
        _show_table(terminal, "learning curve of the forest as published, examples drawn", headings, rows)
    terminal.print_line(
        f"{scores.left_out:,} samples without a vehicle behind over the whole history are left out; vehicles of both "
        "parts drive beside each other. The publication does not tell which accuracy of cells it states",
        style="dim",
    )


def _name_line(model: str, column: str) -> str:
    return model if column == "place" else f"{model} + {column}"


def _format_percent(share: float | None) -> str:
    return format_number(share, scale=100)


def _show_table(terminal: Terminal, title: str, headings: list[str], rows: list[list[Any]]) -> None:
    """Print names in the first column and figures in the others."""
    print_table(terminal, ["", *headings], [list(map(str, row)) for row in rows], title=title)
