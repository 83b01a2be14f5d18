"""The page and the figure of docs/onboard-view.csv; every number on the page is in that file."""

from pathlib import Path

import altair as alt
import polars as pl
from study_onboard_scores import LEAST_VEHICLES

from tracklake.schemas.chart_theme import BLUE, ORANGE
from tracklake.schemas.drawings import Drawing
from tracklake.training.onboard.scores import RESAMPLES

NEAR_M = 100.0
"""Distance along the road, either way, within which vehicles are judged."""
MOST_TURN_DEG = 10.0
"""Largest turn within the horizon of an ego with a warning due; others change lanes faster than a car can."""
CONSTANTS = {"near": NEAR_M, "turn": MOST_TURN_DEG, "resamples": RESAMPLES, "least": LEAST_VEHICLES}
"""What the text states of how the study is made, by its names there."""
SPREAD, DUE = "spread over the recordings", "with a warning due"
"""Groups of egos."""
RECEIVERS = {"plain": "plain GPS", "dgps": "DGPS"}
TEXT = """# What an on-board view costs

Models that predict vehicles are trained and scored on overhead tracks, which show every vehicle exactly. A car on the
road has V2V messages of some vehicles, and a LiDAR that sees some others. This study feeds the same models, trained
once on overhead tracks, with both views of the same moments, and scores them on the same true futures.

`make onboard-study` makes it again: it generates samples, instruments cars of them ([drives.md](drives.md)), reads and
fuses their logs, and writes [onboard-view.csv](onboard-view.csv), this page and the figure. The traffic is simulated:
the figures compare views, not models with publications.

- Two groups of egos are judged, apart from each other. {spread_egos} egos are **spread over the recordings** of highD's
  format: {spread_samples} samples (a vehicle at a moment) of {spread_vehicles} vehicles. {due_egos} are egos **with a
  warning due**: {due_samples} samples of {due_vehicles} vehicles.
- A warning is due where a vehicle's true cell overlaps the ego's within {seconds:g} s: half a lane to the side, and
  closer than they approach in a second, 1 m at least. All {searched_egos} vehicles recorded for 8 s, in all recordings
  (formats of highD and NGSIM) of the two samples that egos come from, were tried as egos by the overhead truth alone.
  Of {searched_pairs} pairs of an ego and a vehicle near it, {searched_due_pairs} have a warning due; in
  {searched_overlapping_pairs} of these the bodies overlap, which is an error of the recording. The other pairs have
  {searched_egos_due} egos, of which {searched_egos_turning} turn by more than {turn:g} degrees within {seconds:g} s: in
  the recording they change lanes faster than a car can, which swings the places of all vehicles around them. The others
  were chosen, with the part of their drive from 4 s before the first to 4 s after the last moment at which a warning is
  due. As they are chosen so, they do not tell how often warnings are due.
- Vehicles within {near:g} m of the ego along the road are judged, {seconds:g} s ahead.
- Networks learned for {epochs} epochs from {training_samples} overhead samples, with a mirrored and a shifted copy of
  each: enough to compare views, too few to compare networks.
- Every vehicle's heading is off by 1 degree to either side. Penetration is the share of the other vehicles that send.
- RMSE and NLL are of the n samples that were perceived over the whole history of 2 s, from both views. Where few
  vehicles send, these are few, and others than where many do: compare overhead and perceived within a row.
- Missed vehicles are the share of true samples that were not perceived so. False vehicles are the share of perceived
  samples that are no true vehicle, or one that is perceived twice.
- Missed warnings are the share of samples with a warning due of which the model does not warn: one that is not
  perceived is missed. False warnings are the share of all other samples, false vehicles among them, of which it warns:
  of a view that perceives few vehicles these are few, too.
- Brackets hold 95 % intervals, by drawing vehicles {resamples:,} times. Where all drawn vehicles agree, both bounds
  are the same: with few vehicles that does not make the figure certain. Egos are not drawn, as they are few: intervals
  say nothing about other egos.

![Error, missed warnings and missed vehicles by penetration, with and without LiDAR, by receiver](onboard-view.svg)

Errors are shown for the egos spread over the recordings, missed warnings for those with a warning due. Bars are 95 %
intervals; the four ways to perceive stand side by side, so that no bar hides another.

## What differs

Two views of the same moments are compared, with the same vehicles drawn for both: for RMSE and NLL, the samples that
both perceived; for the other figures, all. A view is **worse** under a condition where the 95 % interval of the
difference lies above zero, **better** where it lies below, and **open** where it holds zero. Differences of fewer than
{least} vehicles are not stated. The least and the greatest difference of the counted conditions follow, those of shares
in points; each difference with its interval stands below and in [onboard-view.csv](onboard-view.csv). Where nothing
differs, about one interval in 20 excludes zero by chance.
"""
COMPARED = {
    "added": "perceived, not overhead",
    "lidar": "with LiDAR, not without",
    "dgps": "DGPS, not plain GPS",
}
"""What is compared, by the first word of the columns."""
FIGURES = {
    **{"rmse_m": "RMSE, m", "nll_nats": "NLL, nats"},
    **{"missed_warnings": "missed warnings", "false_warnings": "false warnings"},
}
VEHICLES = {"missed_share": "missed vehicles", "false_share": "false vehicles"}
MODEL = {
    **{f"{feed}_rmse_m": f"RMSE {feed}, m" for feed in ("overhead", "perceived")},
    **{f"{feed}_nll_nats": f"NLL {feed}, nats" for feed in ("overhead", "perceived")},
    **{f"{feed}_missed_warnings": f"missed warnings {feed}" for feed in ("overhead", "perceived")},
    **{f"{feed}_false_warnings": f"false warnings {feed}" for feed in ("overhead", "perceived")},
}
"""Columns with an interval, and how the page names them."""
UNITS = ("_m", "_nats")
"""Ends of the names of columns that have a unit; the others are shares, whose differences are in points (percent)."""
BESIDE = 1.2
"""Distance of one way to perceive from the next in the figure, in percent of the vehicles."""


def write_page(table: Path) -> None:
    """Write the page and the figure beside the table of figures."""
    rows = pl.read_csv(table)
    table.with_suffix(".md").write_text(render_page(rows), encoding="utf-8")
    table.with_suffix(".svg").write_bytes(draw_costs(rows).render(".svg") + b"\n")


def render_page(rows: pl.DataFrame) -> str:
    """Render the page of the table's rows."""
    counts = {
        name: f"{rows[name][0]:,}" for name in rows.columns if name.startswith(("searched", "training", "epochs"))
    }
    for key, group in (("spread", SPREAD), ("due", DUE)):
        own = rows.filter(pl.col("group") == group)
        counts |= {f"{key}_{name}": f"{own[name].max():,}" for name in ("samples", "vehicles", "egos")}
    groups = rows.partition_by("group", maintain_order=True)
    parts = [TEXT.format(seconds=rows["seconds"][0], **CONSTANTS, **counts)]
    for of_group in groups:
        parts += [f"### What differs, egos {of_group['group'][0]}\n", *_write_differences(of_group), ""]
    for of_group in groups:
        group = str(of_group["group"][0])
        parts.append(f"\n## Egos {group}\n")
        due, vehicles = of_group["warnings_due"].max(), of_group["vehicles_due"].max()
        parts.append(f"A warning is due for {due:,} of the samples, of {vehicles:,} vehicles.\n")
        models = of_group.partition_by("model", maintain_order=True)
        parts += _write_table(models[0], VEHICLES | list_differences(VEHICLES))
        for own in models:
            parts += [f"\n### {own['model'][0]}, egos {group}\n", *_write_table(own, MODEL), ""]
            parts += _write_table(own, list_differences(FIGURES))
    return "\n".join(parts) + "\n"


def list_differences(figures: dict[str, str]) -> dict[str, str]:
    """List the columns of differences of figures, and how the page names them."""
    units = {name: "" if name.endswith(UNITS) else ", points" for name in figures}
    return {
        f"{key}_{name}": f"{figure}{units[name]}: {compared}"
        for name, figure in figures.items()
        for key, compared in COMPARED.items()
    }


def _write_differences(rows: pl.DataFrame) -> list[str]:
    """Write one line for each comparison and model, and one of the vehicles, which no model changes."""
    models = rows.partition_by("model", maintain_order=True)
    lines = [f"| compared | model | {' | '.join(FIGURES.values())} |", "| --- | --- " + "| --- " * len(FIGURES) + "|"]
    for key, title in COMPARED.items():
        for own in models:
            cells = (judge_differences(own, f"{key}_{name}") for name in FIGURES)
            lines.append(f"| {title} | {own['model'][0]} | {' | '.join(cells)} |")
    lines += ["", f"| compared | {' | '.join(VEHICLES.values())} |", "| --- " + "| --- " * len(VEHICLES) + "|"]
    for key in ("lidar", "dgps"):
        cells = (judge_differences(models[0], f"{key}_{name}") for name in VEHICLES)
        lines.append(f"| {COMPARED[key]} | {' | '.join(cells)} |")
    return lines


def judge_differences(rows: pl.DataFrame, name: str) -> str:
    """Count conditions in which a difference is worse, better or open by its interval: less is better in all."""
    known = rows.filter(pl.col(name).is_not_null())
    if known.is_empty():
        return "too few vehicles"
    worse, better = (known[f"{name}_low"] > 0).sum(), (known[f"{name}_high"] < 0).sum()
    counts = {"worse": worse, "better": better, "open": known.height - worse - better}
    said = ", ".join(f"{word} in {count}" for word, count in counts.items() if count)
    least, greatest = (_write_difference(name, bound) for bound in (known[name].min(), known[name].max()))
    return f"{said} ({least} to {greatest})"


def _write_difference(name: str, value: float) -> str:
    return f"{value:+.2f}" if name.endswith(UNITS) else f"{100 * value:+.1f}"


def _write_table(rows: pl.DataFrame, columns: dict[str, str]) -> list[str]:
    """Write one line per condition; columns without any figure are left out."""
    shown = {name: title for name, title in columns.items() if name in rows and rows[name].is_not_null().any()}
    lines = [f"| GPS | LiDAR | penetration | n | {' | '.join(shown.values())} |"]
    lines.append("| --- | --- | ---: | ---: " + "| ---: " * len(shown) + "|")
    for row in rows.iter_rows(named=True):
        about = (
            RECEIVERS[row["receiver"]],
            "yes" if row["lidar"] else "no",
            f"{row['penetration']:.0%}",
            f"{row['n']:,}",
        )
        lines.append(f"| {' | '.join((*about, *(_write_interval(row, name) for name in shown)))} |")
    return lines


def _write_interval(row: dict[str, float | None], name: str) -> str:
    if row[name] is None:
        return "none"
    if name.startswith(tuple(COMPARED)):
        mean, low, high = (_write_difference(name, row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    else:
        style = ".2f" if name.endswith(UNITS) else ".1%"
        mean, low, high = (f"{row[f'{name}{end}']:{style}}" for end in ("", "_low", "_high"))
    return f"{mean} [{low}, {high}]"


def draw_costs(rows: pl.DataFrame) -> Drawing:
    """Draw each model's perceived error and missed warnings, and the share of missed vehicles, over penetration."""
    view = (
        pl.when("lidar").then(pl.lit("V2V and LiDAR, ")).otherwise(pl.lit("V2V, "))
        + pl.col("receiver").replace_strict(RECEIVERS)
    ).alias("view")
    shown = rows.with_columns(view)
    names = shown["view"].unique(maintain_order=True).to_list()
    beside = pl.col("view").replace_strict({name: BESIDE * (at - 1.5) for at, name in enumerate(names)})
    shown = shown.with_columns(beside=100 * pl.col("penetration") + beside)
    models = shown["model"].unique(maintain_order=True).to_list()
    legend = alt.Legend(title=None, symbolType="stroke", symbolSize=500)
    colour = alt.Color(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[BLUE, BLUE, ORANGE, ORANGE]), legend=legend
    )
    dash = alt.StrokeDash(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[[6, 3], [1, 0], [6, 3], [1, 0]]), legend=legend
    )
    x = alt.X(
        "beside:Q",
        title="vehicles that send (%)",
        scale=alt.Scale(domain=[-4, 104], nice=False),
        axis=alt.Axis(values=[0, 10, 30, 60, 100]),
    )
    seconds = rows["seconds"][0]
    data: dict[str, list[dict[str, object]]] = {}

    def draw(title: str, column: str, unit: str, group: str, model: str) -> alt.LayerChart:
        own = shown.filter((pl.col("group") == group) & (pl.col("model") == model) & pl.col(column).is_not_null())
        times, scale = (1, alt.Scale(zero=True)) if column.endswith("_m") else (100, alt.Scale(domain=[0, 100]))
        values = ((times * pl.col(f"{column}{end}")).alias(f"value{end}") for end in ("", "_low", "_high"))
        data[title] = own.select("view", "beside", *values).to_dicts()
        base = alt.Chart(alt.NamedData(title), title=title, width=300, height=200).encode(x=x, color=colour)
        y, low = (alt.Y(f"{name}:Q", title=unit, scale=scale) for name in ("value", "value_low"))
        lines = base.mark_line(point=True, strokeWidth=2).encode(y=y, strokeDash=dash)
        bars = base.mark_rule(strokeWidth=1.5).encode(y=low, y2="value_high:Q")
        return alt.layer(bars, lines)

    error, unwarned, unseen = f"RMSE at {seconds:g} s (m)", "warnings missed (%)", "not perceived (%)"
    rows_of_panels = [
        [draw(f"{each}: error", "perceived_rmse_m", error, SPREAD, each) for each in models],
        [draw(f"{each}: missed warnings", "perceived_missed_warnings", unwarned, DUE, each) for each in models],
        [draw(f"missed: {group}", "missed_share", unseen, group, models[0]) for group in (SPREAD, DUE)],
    ]
    grid = alt.vconcat(*(alt.hconcat(*panels) for panels in rows_of_panels))
    title = alt.Title("What an on-board view costs", subtitle="bars: 95 % intervals, by drawing vehicles")
    return Drawing(grid.properties(title=title), data)
