"""Evidence that `tracklake evaluate` shows beside the scores: differences, calibration and feasibility."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.score_tables import HEADINGS, find_headline
from tracklake.pipeline.cli.tables import UNBROKEN, format_number, print_table
from tracklake.schemas.comparisons import ALL_DENSITIES, ANY_RULE, DENSITY_CLASSES, FEASIBILITY_RULES
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_output
from tracklake.training.comparison.arms import compare_arms
from tracklake.training.comparison.feasibility import measure_feasibility
from tracklake.training.comparison.record import SampleRecord
from tracklake.training.comparison.traffic_states import measure_densities
from tracklake.training.comparison.uncertainty import calibrate, find_radii, score_by_density
from tracklake.training.data.gathers import NEAREST
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import Evaluation
from tracklake.training.runs.forecasters import Forecaster

Tables = dict[str, pl.DataFrame]
"""Tables of `schemas.comparisons` by their names."""
SHOWN_LEVELS = (0.5, 0.9, 0.95)
"""Probabilities of the regions whose coverage is printed."""
SHOWN_RADIUS = 0.9
"""Share of true positions of the radius that is printed."""
LINES = {"": "difference", "  lower bound": "low", "  upper bound": "high"}
"""Lines of a compared pair, and the columns that they show."""


def show_evidence(
    terminal: Terminal,
    folder: TensorFolder,
    found: Sequence[Evaluation],
    records: Mapping[str, SampleRecord],
    joint: Sequence[Forecaster],
    *,
    compare: bool,
    out: Path | None,
) -> Tables:
    """Show what was asked for of models that have been scored, and write it to `out`.

    Args:
        terminal: terminal of the command.
        folder: the tensors.
        found: evaluations of the models.
        records: of each model by name, where calibration is asked for; else empty.
        joint: the models, where the feasibility of jointly predicted scenes is asked for; else empty.
        compare: whether models are compared.
        out: folder of the tables and plots; None: they are not written.
    """
    tables: Tables = {}
    if compare:
        tables["comparisons"] = show_comparisons(terminal, found)
    if records and found:
        tables |= show_uncertainty(terminal, folder, {own.model: records[own.model] for own in found})
    if joint:
        tables["feasibility"] = show_feasibility(terminal, folder, found, joint)
    if out is not None:
        write_evidence(terminal, out, tables)
    return tables


def show_comparisons(terminal: Terminal, evaluations: Sequence[Evaluation]) -> pl.DataFrame:
    """Compare the first model with every other one, and print the differences of the headline errors and of NLL."""
    table = compare_arms(evaluations)
    seconds = table["seconds"].unique().sort().to_list()
    for figure in (*find_headline(evaluations[0].protocol.headline, set(table["figure"])), "nll_nats"):
        rows = table.filter(figure=figure)
        lines = [
            [name or f"{a} - {b}", *map(_format_difference, own[column])]
            for (a, b), own in rows.group_by("a", "b", maintain_order=True)
            for name, column in LINES.items()
        ]
        if lines:
            title = f"difference of {HEADINGS[figure]}"
            print_table(terminal, ["", *(f"{ahead:g} s" for ahead in seconds)], lines, title=title, fold=True)
    vehicles = int(table["vehicles"].to_numpy().max())
    terminal.print_line(
        f"below 0 the first is better; bounds: 95 % interval over {vehicles:,} vehicles, and seeds where there are "
        "several (docs/training.md); with 0 between the bounds, no difference is shown",
        style="dim",
    )
    single = [name for name, of in (("a", "a_seeds"), ("b", "b_seeds")) for name in table.filter(pl.col(of) == 1)[name]]
    drawn = [own.model for own in evaluations if own.run.get("recipe") and own.model in single]
    if drawn:
        terminal.print_line(f"note: {', '.join(drawn)}: one seed; another one may change the difference", style="dim")
    return table


def _format_difference(value: float) -> str:
    """Write a difference or its bound with three decimals, or more where its sign would be lost: 0 is 0 alone."""
    digits = next((own for own in range(3, 7) if round(value, own)), 3)
    return format_number(value, digits)


def show_uncertainty(terminal: Terminal, folder: TensorFolder, records: Mapping[str, SampleRecord]) -> Tables:
    """Print how far predicted regions hold the truth, sigma beside the error by traffic density, and radii."""
    (one, *_) = records.values()
    density = measure_densities(folder, one.samples)
    ordered = sorted(records.items())
    tables = {
        "calibration": pl.concat(calibrate(run, own) for run, own in ordered),
        "density_errors": pl.concat(score_by_density(run, own, density) for run, own in ordered),
        "conformal_radii": pl.concat(find_radii(run, own, density) for run, own in ordered),
    }
    rows = tables["calibration"].filter(pl.col("level").is_in(SHOWN_LEVELS))
    lines = [
        [f"{run}, {level:.0%}{UNBROKEN}region", *(f"{share:.1%}" for share in own["coverage"])]
        for (run, level), own in rows.group_by("run", "level", maintain_order=True)
    ]
    seconds = [f"{ahead:g} s" for ahead in one.seconds]
    if lines:
        print_table(terminal, ["", *seconds], sorted(lines), title="true positions in predicted regions", fold=True)
    without = [run for run in records if run not in set(rows["run"])]
    if without:
        why = "no density is predicted, or lateral positions are lane centres"
        terminal.print_line(f"no coverage of {', '.join(without)}: {why}", style="dim")
    _show_densities(terminal, tables, one.seconds[-1])
    return tables


def _show_densities(terminal: Terminal, tables: Tables, seconds: float) -> None:
    """Print errors, sigma and radii by traffic density at one horizon."""
    joined = tables["density_errors"].join(
        tables["conformal_radii"].filter(level=SHOWN_RADIUS), on=("run", "density", "seconds"), how="left"
    )
    order = {name: number for number, name in enumerate((ALL_DENSITIES, *DENSITY_CLASSES))}
    rows = joined.filter(seconds=seconds).sort("run", pl.col("density").replace_strict(order), maintain_order=True)
    figures = ("rmse_longitudinal_m", "sigma_longitudinal_m", "rmse_lateral_m", "sigma_lateral_m", "radius_m")
    lines = [
        [
            f"{row['run']}, {row['density'].replace(' ', UNBROKEN)}",
            f"{row['n']:,}",
            *(format_number(row[name]) for name in figures),
            format_number(row["coverage"], 1, 100.0),
        ]
        for row in rows.iter_rows(named=True)
    ]
    headings = ["", "n", "longitudinal RMSE, m", "sigma, m", "lateral RMSE, m", "sigma, m", "radius, m", "held %"]
    title = f"at {seconds:g} s, by vehicles per km of lane"
    print_table(terminal, headings, lines, title=title, fold=True)
    terminal.print_line(
        f"radius: of half of the vehicles, to hold {SHOWN_RADIUS:.0%} of true positions; held: by the other half's",
        style="dim",
    )


def show_feasibility(
    terminal: Terminal, folder: TensorFolder, found: Sequence[Evaluation], models: Sequence[Forecaster]
) -> pl.DataFrame:
    """Print how many predictions and scenes break rules within the horizon, beside the error and the true futures."""
    nearest = {own.model: NEAREST if own.nearest is None else own.nearest for own in found}
    ordered = sorted(models, key=lambda own: own.name)
    table = pl.concat(measure_feasibility(own, folder, found[0].part, nearest[own.name]) for own in ordered)
    last = table.filter(pl.col("seconds") == pl.col("seconds").max())
    rules = [rule for rule in (ANY_RULE, *FEASIBILITY_RULES) if rule in set(last["rule"])]
    for title, share, floor in (
        ("predictions that break a rule", "share", "true_share"),
        ("scenes with a prediction that breaks a rule", "scene_share", "true_scene_share"),
    ):
        lines = []
        for (run,), own in last.group_by("run", maintain_order=True):
            values = dict(zip(own["rule"], own[share], strict=True))
            lines.append([str(run), format_number(own["rmse_m"][0]), *(f"{values[rule]:.1%}" for rule in rules)])
        values = dict(zip(last["rule"], last[floor], strict=True))  # of all models the same
        lines.append(["true futures", "", *(f"{values[rule]:.1%}" for rule in rules)])
        headings = ["", "RMSE, m", *(rule.replace("_", " ") for rule in rules)]
        print_table(terminal, headings, lines, title=title, fold=True)
    terminal.print_line(
        f"rules: docs/tables.md (feasibility); within {last['seconds'][0]:g} s, {last['n'][0]:,} predictions in "
        f"{last['scenes'][0]:,} scenes",
        style="dim",
    )
    return table


def write_evidence(terminal: Terminal, folder: Path, tables: Tables) -> None:
    """Write each table as a CSV file, and the reliability plot, into a folder."""
    for name, table in tables.items():
        write_output(folder / f"{name}.csv", table.write_csv().encode())
    if not tables.get("calibration", pl.DataFrame()).is_empty():
        require_extras("the reliability plot", "report")
        from tracklake.quality_reports.plots.reliability import draw_reliability  # Altair takes a second to import

        write_output(folder / "reliability.svg", draw_reliability(tables["calibration"]).render(".svg"))
    terminal.print_line(f"evidence {folder}: {', '.join(sorted(own.name for own in folder.iterdir()))}", style="dim")
