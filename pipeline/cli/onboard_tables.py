"""Tables of `tracklake onboard` in a terminal: scores, maneuvers, cells and warnings, with n behind every figure."""

from collections.abc import Iterable, Sequence
from typing import Any

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.schemas.lane_forest import ALL, STRATA
from tracklake.schemas.protocols import V2V
from tracklake.schemas.published_results import CHOI_2021
from tracklake.training.onboard.samples import Parts

Row = dict[str, Any]
SHOWN_FEATURES = 8
"""Most features whose correlations are printed; the others are in the JSON."""


def show_scores(
    terminal: Terminal, parts: Parts, rows: Sequence[Row], published: Sequence[Row], *, is_synthetic: bool = False
) -> None:
    """Print errors and cell accuracies at every horizon, then the last horizon's by scenario."""
    counts = [f"{len(part):,} samples of {len(set(part.trajectory.tolist())):,} trajectories" for part in parts[:2]]
    terminal.print_line(f"protocol {V2V.name} ({V2V.digest}): train {counts[0]}, eval {counts[1]}", style="bold")
    headings = [f"{seconds:g} s" for seconds in V2V.scored_s]
    every = [row for row in rows if row["stratum"] == ALL]
    for title, figure, scale, digits in (
        ("MAE, m", "mae_m", 1, 2),
        ("RMSE, m", "rmse_m", 1, 2),
        ("NLL, nats", "nll_nats", 1, 2),
        ("right cell of nine, %", "cell", 100, 1),
        ("right cell of nine, column by the forest, %", "cell_with_forest", 100, 1),
    ):
        if all(row[figure] is None for row in every):
            continue
        lines = [line for model in _list_models(every) for line in _format_lines(every, model, figure, scale, digits)]
        styles = [*[""] * len(lines), "italic"]
        beside = [
            line for model in _list_models(published) for line in _format_lines(published, model, figure, scale, digits)
        ]
        beside = [[f"{name}, published", *cells] for name, *cells in beside if set(cells) != {"-"}]
        lines += [_count(every), *beside]
        print_table(terminal, ["", *headings], lines, title=title, styles=[*styles, *["dim"] * len(beside)], fold=True)
    if any(row["mae_m_low"] is not None for row in every):
        terminal.print_line("intervals: trajectories drawn with replacement, 1,000 times", style="dim")
    if published:
        where = "drives here are synthetic" if is_synthetic else "roads, sensors and vehicles differ"
        terminal.print_line(f"published: {CHOI_2021}. Not comparable: {where}", style="dim")
    _show_scenarios(terminal, rows)


def _list_models(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["model"] for row in rows))


def _format_lines(rows: Iterable[Row], model: str, figure: str, scale: float, digits: int) -> list[list[str]]:
    """Return the cells of a model's line, and those of the intervals below it where there are."""
    own = [row for row in rows if row["model"] == model]
    lines = [[model, *(format_number(row[figure], digits, scale) for row in own)]]
    if any(row.get(f"{figure}_low") is not None for row in own):
        ends = [[format_number(row[f"{figure}_{end}"], digits, scale) for end in ("low", "high")] for row in own]
        lines.append(["  95 % interval", *("-".join(pair) if pair[0] != "-" else "-" for pair in ends)])
    return lines


def _count(rows: Sequence[Row]) -> list[str]:
    """Return the cells of the line that counts samples; all models have the same."""
    return ["n", *(f"{row['n']:,}" for row in rows if row["model"] == rows[0]["model"])]


def _show_scenarios(terminal: Terminal, rows: Sequence[Row]) -> None:
    """Print errors and cell accuracies at the last horizon by scenario."""
    last = [row for row in rows if row["seconds"] == V2V.scored_s[-1] and row["stratum"] != ALL]
    for title, figure, scale, digits in (
        (f"MAE at {V2V.scored_s[-1]:g} s, m", "mae_m", 1, 2),
        (f"right cell at {V2V.scored_s[-1]:g} s, %", "cell", 100, 1),
    ):
        lines = [line for model in _list_models(last) for line in _format_lines(last, model, figure, scale, digits)]
        if last:
            print_table(terminal, ["", *STRATA], [*lines, _count(last)], title=title, fold=True)


def show_forest(terminal: Terminal, record: Row, *, with_confusion: bool) -> None:
    """Print maneuvers, correlations, the learning curve, and cells by model where they are wanted."""
    if record["maneuvers"]:
        rows = [
            [
                row["stratum"],
                f"{row['n']:,}",
                *map(_format_percent, (row["accuracy"], *row["recall"].values(), row["majority"])),
            ]
            for row in record["maneuvers"]
        ]
        names = [f"of {name} %" for name in record["maneuvers"][0]["recall"]]
        headings = ["", "n", "right %", *names, "always the commonest %"]
        print_table(terminal, headings, rows, title="maneuver by the forest's majority", fold=True)
        title = f"correlation with the maneuver, the strongest ({record['examples']:,} examples of the training part)"
        strongest = record["correlations"][:SHOWN_FEATURES]
        rows = [[row["feature"], *(f"{row[name]:.2f}" for name in ("keep", "left", "right"))] for row in strongest]
        print_table(terminal, ["", "keep", "left", "right"], rows, title=title)
    if record["learning_curve"]:
        rows = [
            [f"{row['drawn']:,}", _format_percent(row["train_accuracy"]), f"{row['train_n']:,}",
             _format_percent(row["eval_accuracy"]), f"{row['eval_n']:,}"]
            for row in record["learning_curve"]
        ]  # fmt: skip
        headings = ["", "train, right %", "n", "eval, right %", "n"]
        print_table(terminal, headings, rows, title="learning curve, examples drawn")
    for model, cells in record["confusion"].items() if with_confusion else ():
        names = [f"{lane} {row}" for lane in ("left", "own", "right") for row in ("behind", "middle", "ahead")]
        rows = [[name, *map(str, counts)] for name, counts in zip([*names, "outside"], cells[-1], strict=True)]
        title = f"true cell (rows) against that of {model} at {V2V.scored_s[-1]:g} s, samples"
        print_table(terminal, ["", *names, "outside"], rows, title=title, fold=True)


def show_warnings(terminal: Terminal, rows: Sequence[Row]) -> None:
    """Print what models warn of, against the truth."""
    lines = [
        [row["model"], *(f"{row[name]:,}" for name in ("n", "true", "hits", "missed", "false", "warnings")),
         *(format_number(row[name], 1) for name in ("warnings_per_hour", "median_time_s", "median_lead_s"))]
        for row in rows
    ]  # fmt: skip
    headings = ["", "n", "true", "hits", "missed", "false", "warnings", "an hour", "time s", "lead s"]
    title = f"cells overlap within {V2V.horizon_s:g} s: vehicles at a moment, every {V2V.step_s:g} s"
    print_table(terminal, headings, lines, title=title, fold=True)
    terminal.print_line(
        "warnings: runs of warned moments, and per hour that a vehicle was near; time: median predicted time to the "
        "overlap; lead: median time from a vehicle's first hit to its first overlap",
        style="dim",
    )


def _format_percent(share: float | None) -> str:
    return format_number(share, 1, 100)
