"""Scores in the terminal: a line per model, then the number of samples, then published lines, marked as such."""

from collections.abc import Collection, Mapping, Sequence

import polars as pl

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.schemas.evaluations import EVERYTHING, FINDING_GROUPS
from tracklake.schemas.protocols import Headline
from tracklake.training.evaluation.evaluate import Evaluation
from tracklake.training.models.fitting import Fit

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
"""Errors that a protocol's tables show at every horizon."""
ALONG = {"rmse_m": "rmse_longitudinal_m", "mae_m": "mae_longitudinal_m"}
"""Errors that stand in for radial ones where lateral positions are lane centres."""
AT_THE_END = ("rmse_longitudinal_m", "rmse_lateral_m", "ade_m", "fde_m", "nll_nats")
"""Errors shown at the last horizon only, unless they are the headline."""
ACCURACIES = {"lateral": "lateral %", "longitudinal": "braking %"}


def show_evaluations(terminal: Terminal, one: Evaluation, table: pl.DataFrame, by: Sequence[str]) -> None:
    """Print the headline errors of all models at the protocol's seconds, and more of them at the last one.

    Published figures follow ours of the same data set; a part with several data sets has a table for each. The
    evaluations share part, split and protocol with `one`; `by` are groups of further tables: maneuver, findings,
    dataset, vehicle.
    """
    table = table.filter(pl.col("seconds").is_in([tick / one.protocol.rate_hz for tick in one.protocol.scored_ticks]))
    measured = table.filter(origin="measured")
    headline = find_headline(one.protocol.headline, {own for own in HEADINGS if measured[own].is_not_null().any()})
    terminal.print_line(
        f"{one.part} of {one.split}, protocol {one.protocol.title}: {one.samples:,} samples of "
        f"{one.vehicles:,} vehicles",
        style="bold",
    )
    everything = (pl.col("dataset") == EVERYTHING) & (pl.col("group") == EVERYTHING)
    of_samples = pl.col("average") == "samples"
    published = table.filter(origin="published")
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
            text = f"{group}: the vehicle's own findings of severity {severity} or worse in history or future"
            terminal.print_line(text, style="dim")


def find_headline(headline: Headline, known: Collection[str]) -> list[str]:
    """Find the known errors that tables show; those along the road where no other is known."""
    wanted = HEADLINE_FIGURES[headline]
    return [own for own in wanted if own in known] or [ALONG[own] for own in wanted if ALONG.get(own) in known]


def _show_horizons(
    terminal: Terminal, title: str, figure: str, rows: pl.DataFrame, published: pl.DataFrame | None = None
) -> None:
    """Print one line per model and one column per horizon, then n, then published lines if there are any."""
    seconds = rows["seconds"].unique().sort().to_list()
    lines: list[list[str]] = []
    styles: list[str] = []
    for (model,), own in rows.group_by("model", maintain_order=True):
        errors = dict(zip(own["seconds"], own[figure], strict=True))
        lines.append([str(model), *(format_number(errors[ahead]) for ahead in seconds)])
        styles.append("")
    if rows.height:
        for behind in ("n", "vehicles") if "vehicles" in rows["average"] else ("n",):
            counts = dict(zip(rows["seconds"], rows[behind], strict=True))  # of all models the same
            lines.append([behind, *(f"{counts[ahead]:,}" for ahead in seconds)])
            styles.append("italic")
    references: list[str] = []
    if published is not None:
        for (model, dataset, reference), own in published.group_by(
            "model", "dataset", "reference", maintain_order=True
        ):
            if reference not in references:
                references.append(str(reference))
            errors = dict(zip(own["seconds"], own[figure], strict=True))
            name = f"{model} on {dataset}, published [{references.index(str(reference)) + 1}]"
            lines.append([name, *(format_number(errors.get(ahead)) for ahead in seconds)])
            styles.append("dim")
    print_table(terminal, ["", *(f"{ahead:g} s" for ahead in seconds)], lines, title=title, styles=styles, fold=True)
    for number, reference in enumerate(references, start=1):
        terminal.print_line(f"[{number}] {reference}", style="dim")


def _show_last(terminal: Terminal, rows: pl.DataFrame, figures: Sequence[str]) -> None:
    """Print more figures at the last horizon, and how long a prediction takes."""
    if rows.is_empty():
        return
    last = rows.filter(pl.col("seconds") == rows["seconds"].max())
    shown = [figure for figure in figures if last[figure].is_not_null().any()]
    axes = [axis for axis in ACCURACIES if last[f"{axis}_accuracy"].is_not_null().any()]
    timed = last["latency_ms"].is_not_null().any()
    headings = [HEADINGS[figure] for figure in shown] + [ACCURACIES[axis] for axis in axes]
    headings += ["ms a moment"] if timed else []
    lines: list[list[str]] = []
    for row in last.iter_rows(named=True):
        accuracies = [format_number(row[f"{axis}_accuracy"], 1, 100.0) for axis in axes]
        latency = [f"{row['latency_ms']:.3g}"] if timed else []
        lines.append([row["model"], *(format_number(row[figure]) for figure in shown), *accuracies, *latency])
    if axes:
        shares = [format_number(last[f"majority_{axis}_share"][0], 1, 100.0) for axis in axes]
        lines.append(["always the commonest maneuver", *[""] * len(shown), *shares])
    print_table(terminal, ["", *headings], lines, title=f"at {last['seconds'][0]:g} s", fold=True)
    if timed:
        text = f"a moment: the median of {last['latency_samples'][0]:g} samples predicted at once, on one thread"
        terminal.print_line(text, style="dim")


def describe_fit(fit: Fit) -> str:
    """Describe in one line which parameters of a model were fitted, on how many samples, and which were set."""
    how = f"fitted on {fit.samples:,} samples of `train`" if fit.samples else "not fitted: `train` has no samples"
    groups = {how: set(fit.parameters).difference(fit.given), "set, not fitted": set(fit.given)}
    values = {
        name: f"{name} = {value:g}" + (" (bound of the search)" if name in fit.at_bounds else "")
        for name, value in fit.parameters.items()
    }
    shown = [
        ", ".join(text for name, text in values.items() if name in names) + f", {how}"
        for how, names in groups.items()
        if names
    ]
    return f"{fit.model}: {'; '.join(shown)}"
