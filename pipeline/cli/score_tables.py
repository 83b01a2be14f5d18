"""Scores as a person at a terminal reads them: a line per model, n beneath, then published lines, marked as such."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING

import polars as pl
from rich.markup import escape
from rich.table import Table

from tracklake.schemas.evaluations import EVERYTHING, FINDING_GROUPS
from tracklake.schemas.protocols import Headline

if TYPE_CHECKING:
    from tracklake.pipeline.cli.console import Terminal
    from tracklake.training.evaluation.evaluate import Evaluation

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
LEAST_WIDTH = 12
"""Of the column of names, in characters: on narrower terminals lines are longer than those."""
ACCURACIES = {"lateral": "lateral %", "longitudinal": "braking %"}


def show_evaluations(terminal: "Terminal", one: "Evaluation", table: pl.DataFrame, by: Sequence[str]) -> None:
    """Print the headline errors of all models at the protocol's seconds, and more of them at the last one.

    Published figures stand beneath ours of the same data set: where the part has several, in a table for each.

    Args:
        terminal: where to.
        one: any of the evaluations: they share part, split and protocol.
        table: rows of `schemas.evaluations.EVALUATIONS`, of any horizons.
        by: further tables: maneuver, findings, dataset, vehicle.
    """
    table = table.filter(pl.col("seconds").is_in([tick / one.protocol.rate_hz for tick in one.protocol.scored_ticks]))
    headline = HEADLINE_FIGURES[one.protocol.headline]
    terminal.say(
        f"{one.part} of {one.split}, protocol {one.protocol.name} ({one.protocol.digest}): {one.samples:,} samples of "
        f"{one.vehicles:,} vehicles",
        style="bold",
    )
    everything = (pl.col("dataset") == EVERYTHING) & (pl.col("group") == EVERYTHING)
    of_samples = pl.col("average") == "samples"
    measured, published = table.filter(origin="measured"), table.filter(origin="published")
    all_samples = measured.filter(everything & of_samples)
    datasets = measured.filter(pl.col("dataset") != EVERYTHING)["dataset"].unique().sort().to_list()
    apart = datasets if len(datasets) > 1 or "dataset" in by else []
    for figure in headline:
        beside = published.filter(pl.col(figure).is_not_null())
        _show_horizons(terminal, HEADINGS[figure], figure, all_samples, beside.filter(~pl.col("dataset").is_in(apart)))
        for dataset in apart:
            rows = measured.filter((pl.col("group") == EVERYTHING) & of_samples, dataset=dataset)
            _show_horizons(terminal, f"{HEADINGS[figure]}, {dataset}", figure, rows, beside.filter(dataset=dataset))
    _show_last(terminal, all_samples, [figure for figure in AT_THE_END if figure not in headline])
    groups = {"maneuver": ("lateral=", "longitudinal="), "findings": ("findings=",)}
    for figure in headline:
        for what in dict.fromkeys(by):
            if what == "vehicle":
                rows = measured.filter(everything & (pl.col("average") == "vehicles"))
                _show_horizons(terminal, f"{HEADINGS[figure]}, every vehicle counting the same", figure, rows)
            elif what != "dataset":
                within = pl.any_horizontal(pl.col("group").str.starts_with(start) for start in groups[what])
                rows = measured.filter((pl.col("dataset") == EVERYTHING) & within & of_samples)
                for group in rows["group"].unique(maintain_order=True):
                    _show_horizons(terminal, f"{HEADINGS[figure]}, {group}", figure, rows.filter(group=group))
    if "findings" in by:
        for severity, (group, _) in FINDING_GROUPS.items():
            told = f"{group}: the vehicle's own findings of severity {severity} or worse in history or future"
            terminal.say(told, style="dim")


def _show_horizons(
    terminal: "Terminal", title: str, figure: str, rows: pl.DataFrame, published: pl.DataFrame | None = None
) -> None:
    """One line per model and one column per horizon; published lines, if any, beneath, and n at the end of ours."""
    seconds = rows["seconds"].unique().sort().to_list()
    table = _Lines(title, [f"{ahead:g} s" for ahead in seconds])
    for (model,), own in rows.group_by("model", maintain_order=True):
        errors = dict(zip(own["seconds"], own[figure], strict=True))
        table.add(str(model), [_number(errors[ahead]) for ahead in seconds])
    if rows.height:
        for behind in ("n", "vehicles") if "vehicles" in rows["average"] else ("n",):
            counts = dict(zip(rows["seconds"], rows[behind], strict=True))  # of all models the same
            table.add(behind, [f"{counts[ahead]:,}" for ahead in seconds], style="italic")
    references: list[str] = []
    if published is not None:
        for (model, dataset, reference), own in published.group_by(
            "model", "dataset", "reference", maintain_order=True
        ):
            if reference not in references:
                references.append(str(reference))
            errors = dict(zip(own["seconds"], own[figure], strict=True))
            name = f"{model} on {dataset}, published [{references.index(str(reference)) + 1}]"
            table.add(name, [_number(errors.get(ahead)) for ahead in seconds], style="dim")
    table.print(terminal)
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
    table = _Lines(f"at {last['seconds'][0]:g} s", headings)
    for row in last.iter_rows(named=True):
        accuracies = [_number(row[f"{axis}_accuracy"], scale=100.0, digits=1) for axis in said]
        latency = [f"{row['latency_ms']:.3g}"] if timed else []
        table.add(row["model"], [*(_number(row[figure]) for figure in shown), *accuracies, *latency])
    if said:
        shares = [_number(last[f"majority_{axis}_share"][0], scale=100.0, digits=1) for axis in said]
        table.add("always the commonest maneuver", [""] * len(shown) + shares)
    table.print(terminal)
    if timed:
        told = f"a moment: the median of {last['latency_samples'][0]:g} samples predicted at once, on one thread"
        terminal.say(told, style="dim")


class _Lines:
    """A table of names and figures, of which nothing is cut off.

    Where the terminal is too narrow, headings are broken at every space; names, which may be long, into as many lines
    as it takes.
    """

    def __init__(self, title: str, headings: Sequence[str]) -> None:
        self._title, self._headings = title, headings
        self._lines: list[tuple[Sequence[str], str | None]] = []

    def add(self, name: str, figures: Sequence[str], *, style: str | None = None) -> None:
        """One line; figures from the first heading on."""
        self._lines.append(([name, *figures], style))

    def print(self, terminal: "Terminal") -> None:
        """Print it to people."""
        if not terminal.talks:
            return
        cells = [["", *self._headings], *(line for line, _ in self._lines)]
        widths = (max(map(len, column)) for column in zip_longest(*cells, fillvalue=""))
        narrow = sum(width + 2 for width in widths) > terminal.out.width
        table = Table(
            title=self._title,
            title_justify="left",
            box=None,
            header_style="bold",
            padding=(0, 1 if narrow else 2, 0, 0),
        )
        table.add_column("", overflow="fold", min_width=LEAST_WIDTH)
        for heading in self._headings:
            table.add_column(heading.replace(" ", "\n") if narrow else heading, justify="right", no_wrap=True)
        for line, style in self._lines:
            table.add_row(*map(escape, line), style=style)
        terminal.out.print(table)


def _number(value: float | None, *, scale: float = 1.0, digits: int = 2) -> str:
    return "-" if value is None else f"{scale * value:.{digits}f}"
