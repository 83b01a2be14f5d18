"""Scores as a person at a terminal reads them: a line per model, n beneath, then published lines, marked as such."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import polars as pl
from rich.markup import escape
from rich.table import Table

from schemas.evaluations import EVERYTHING, TOUCHING_SEVERITY
from schemas.protocols import Headline

if TYPE_CHECKING:
    from pipeline.terminal import Terminal
    from training.evaluate import Evaluation

HEADINGS = {
    "rmse_m": "RMSE, m",
    "rmse_longitudinal_m": "longitudinal RMSE, m",
    "rmse_lateral_m": "lateral RMSE, m",
    "mae_m": "MAE, m",
    "mae_longitudinal_m": "longitudinal MAE, m",
    "mae_lateral_m": "lateral MAE, m",
    "ade_m": "ADE, m",
    "fde_m": "FDE, m",
    "nll_nats": "NLL, nats",
}
HEADLINE_FIGURES: Mapping[Headline, tuple[str, ...]] = {
    "rmse": ("rmse_m",),
    "rmse-by-axis": ("rmse_longitudinal_m", "rmse_lateral_m"),
    "mae": ("mae_m",),
}
"""What a protocol is known by."""
AT_THE_END = ("rmse_longitudinal_m", "rmse_lateral_m", "ade_m", "fde_m", "nll_nats")
"""Shown at the last horizon, where they are no headline."""
ACCURACIES = {"lateral": "lateral %", "longitudinal": "braking %"}


def show_evaluations(terminal: "Terminal", one: "Evaluation", table: pl.DataFrame, by: Sequence[str]) -> None:
    """Print the headline errors of all models, and more of them at the last horizon.

    Args:
        terminal: where to.
        one: any of the evaluations: they share part, split and protocol.
        table: rows of `schemas.evaluations.EVALUATIONS`.
        by: further tables: maneuver, findings, dataset, vehicle.
    """
    headline = HEADLINE_FIGURES[one.protocol.headline]
    terminal.say(
        f"{one.part} of {one.split}, protocol {one.protocol.name} ({one.protocol.digest}): {one.samples:,} samples of "
        f"{one.vehicles:,} vehicles",
        style="bold",
    )
    everything = (pl.col("dataset") == EVERYTHING) & (pl.col("group") == EVERYTHING)
    of_samples, published = pl.col("average") == "samples", pl.col("origin") == "published"
    measured = table.filter(~published)
    all_samples = measured.filter(everything & of_samples)
    for figure in headline:
        beside = table.filter(published & pl.col(figure).is_not_null())
        _show_horizons(terminal, HEADINGS[figure], figure, all_samples, beside)
    _show_last(terminal, all_samples, [figure for figure in AT_THE_END if figure not in headline])
    groups = {"maneuver": ("lateral=", "longitudinal="), "findings": ("findings=",)}
    for figure in headline:
        for what in dict.fromkeys(by):
            if what == "vehicle":
                rows = measured.filter(everything & (pl.col("average") == "vehicles"))
                _show_horizons(terminal, f"{HEADINGS[figure]}, every vehicle counting the same", figure, rows)
            elif what == "dataset":
                rows = measured.filter((pl.col("group") == EVERYTHING) & (pl.col("dataset") != EVERYTHING) & of_samples)
                _show_groups(terminal, "dataset", figure, rows)
            else:
                within = pl.any_horizontal(pl.col("group").str.starts_with(start) for start in groups[what])
                rows = measured.filter((pl.col("dataset") == EVERYTHING) & within & of_samples)
                _show_groups(terminal, "group", figure, rows)
    if "findings" in by:
        told = f"touched: the vehicle's own findings of severity {TOUCHING_SEVERITY} or worse in history or future"
        terminal.say(told, style="dim")


def _show_groups(terminal: "Terminal", column: str, figure: str, rows: pl.DataFrame) -> None:
    for name in rows[column].unique(maintain_order=True):
        _show_horizons(terminal, f"{HEADINGS[figure]}, {name}", figure, rows.filter(pl.col(column) == name))


def _show_horizons(
    terminal: "Terminal", title: str, figure: str, rows: pl.DataFrame, published: pl.DataFrame | None = None
) -> None:
    """One line per model and one column per horizon; published lines, if any, beneath, and n at the end of ours."""
    seconds = rows["seconds"].unique().sort().to_list()
    table = _empty_table(title, [f"{ahead:g} s" for ahead in seconds])
    for (model,), own in rows.group_by("model", maintain_order=True):
        errors = dict(zip(own["seconds"], own[figure], strict=True))
        table.add_row(escape(str(model)), *(_number(errors[ahead]) for ahead in seconds))
    if rows.height:
        for behind in ("n", "vehicles") if "vehicles" in rows["average"] else ("n",):
            counts = dict(zip(rows["seconds"], rows[behind], strict=True))  # of all models the same
            table.add_row(behind, *(f"{counts[ahead]:,}" for ahead in seconds), style="italic")
    references: list[str] = []
    if published is not None:
        for (model, dataset, reference), own in published.group_by(
            "model", "dataset", "reference", maintain_order=True
        ):
            if reference not in references:
                references.append(str(reference))
            errors = dict(zip(own["seconds"], own[figure], strict=True))
            name = f"{model} on {dataset}, published [{references.index(str(reference)) + 1}]"
            table.add_row(escape(name), *(_number(errors.get(ahead)) for ahead in seconds), style="dim")
    _print(terminal, table)
    for number, reference in enumerate(references, start=1):
        terminal.say(f"[{number}] {reference}", style="dim")


def _show_last(terminal: "Terminal", rows: pl.DataFrame, figures: Sequence[str]) -> None:
    """More figures at the last horizon, and how long a prediction takes."""
    if rows.is_empty():
        return
    last = rows.filter(pl.col("seconds") == rows["seconds"].max())
    shown = [figure for figure in figures if last[figure].is_not_null().any()]
    said = [axis for axis in ACCURACIES if last[f"{axis}_accuracy"].is_not_null().any()]
    timed = last["latency_ms"].is_not_null().any()
    headings = [HEADINGS[figure] for figure in shown] + [ACCURACIES[axis] for axis in said]
    headings += ["ms a moment"] if timed else []
    table = _empty_table(f"at {last['seconds'][0]:g} s", headings)
    for row in last.iter_rows(named=True):
        accuracies = [_number(row[f"{axis}_accuracy"], scale=100.0, digits=1) for axis in said]
        latency = [f"{row['latency_ms']:.3g}"] if timed else []
        table.add_row(escape(row["model"]), *(_number(row[figure]) for figure in shown), *accuracies, *latency)
    if said:
        shares = [_number(last[f"majority_{axis}_share"][0], scale=100.0, digits=1) for axis in said]
        table.add_row("always the commonest maneuver", *[""] * len(shown), *shares)
    _print(terminal, table)
    if timed:
        told = f"a moment: the median of {last['latency_samples'][0]:g} samples predicted at once, on one thread"
        terminal.say(told, style="dim")


def _empty_table(title: str, headings: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=None, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("")
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def _print(terminal: "Terminal", table: Table) -> None:
    if terminal.talks:
        terminal.out.print(table)


def _number(value: float | None, *, scale: float = 1.0, digits: int = 2) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"
