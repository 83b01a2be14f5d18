"""The page and the figure of docs/onboard-view.csv; every number on the page is in that file."""

from pathlib import Path

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import BLUE, ORANGE
from tracklake.training.plots.charts import Drawing

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
  {searched_overlapping_pairs} of these the bodies overlap, which is an error of the recording. By the other pairs, the
  egos with the most moments at which a warning is due were chosen, with the part of their drive from 4 s before the
  first to 4 s after the last. As they are chosen so, they do not tell how often warnings are due.
- Vehicles within 100 m of the ego along the road are judged, {seconds:g} s ahead.
- Networks learned for {epochs} epochs from {training_samples} overhead samples, with a mirrored and a shifted copy of
  each: enough to compare views, too few to compare networks.
- Every vehicle's heading is off by 1 degree to either side. Penetration is the share of the other vehicles that send.
- RMSE and NLL are of the n samples that were perceived over the whole history of 2 s, from both views. Where few
  vehicles send, these are few, and others than where many do: compare overhead and perceived within a row.
- Missed vehicles are the share of true samples that were not perceived so. False vehicles are the share of perceived
  samples that are no true vehicle, or one that is perceived twice.
- Missed warnings are the share of samples with a warning due of which the model does not warn: one that is not
  perceived is missed. False warnings are the share of all other samples, false vehicles among them, of which it warns.
- Brackets hold 95 % intervals, by drawing vehicles 1,000 times. Where all drawn vehicles agree, both bounds are the
  same: with few vehicles that does not make the figure certain.

![Error, missed warnings and missed vehicles by penetration, with and without LiDAR, by receiver](onboard-view.svg)

Errors are shown for the egos spread over the recordings, missed warnings for those with a warning due.
"""
VEHICLES = {"missed_share": "missed vehicles", "false_share": "false vehicles"}
MODEL = {
    **{f"{feed}_rmse_m": f"RMSE {feed}, m" for feed in ("overhead", "perceived")},
    **{f"{feed}_nll_nats": f"NLL {feed}, nats" for feed in ("overhead", "perceived")},
    **{f"{feed}_missed_warnings": f"missed warnings {feed}" for feed in ("overhead", "perceived")},
    **{f"{feed}_false_warnings": f"false warnings {feed}" for feed in ("overhead", "perceived")},
}
"""Columns with an interval, and how the page names them."""


def write_page(table: Path) -> None:
    """Write the page and the figure beside the table of figures."""
    rows = pl.read_csv(table)
    table.with_suffix(".md").write_text(render_page(rows), encoding="utf-8")
    table.with_suffix(".svg").write_bytes(draw_costs(rows).render(".svg"))


def render_page(rows: pl.DataFrame) -> str:
    """Render the page of the table's rows."""
    counts = {
        name: f"{rows[name][0]:,}" for name in rows.columns if name.startswith(("searched", "training", "epochs"))
    }
    for key, group in (("spread", SPREAD), ("due", DUE)):
        own = rows.filter(pl.col("group") == group)
        counts |= {f"{key}_{name}": f"{own[name].max():,}" for name in ("samples", "vehicles", "egos")}
    parts = [TEXT.format(seconds=rows["seconds"][0], **counts)]
    for of_group in rows.partition_by("group", maintain_order=True):
        group = str(of_group["group"][0])
        parts.append(f"\n## Egos {group}\n")
        due, vehicles = of_group["warnings_due"].max(), of_group["vehicles_due"].max()
        parts.append(f"A warning is due for {due:,} of the samples, of {vehicles:,} vehicles.\n")
        models = of_group.partition_by("model", maintain_order=True)
        parts += _write_table(models[0], VEHICLES)
        for own in models:
            parts += [f"\n### {own['model'][0]}, egos {group}\n", *_write_table(own, MODEL)]
    return "\n".join(parts) + "\n"


def _write_table(rows: pl.DataFrame, columns: dict[str, str]) -> list[str]:
    """Write one line per condition; columns without any figure are left out."""
    shown = {name: title for name, title in columns.items() if rows[name].is_not_null().any()}
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
    mean, low, high = row[name], row[f"{name}_low"], row[f"{name}_high"]
    style = ".2f" if name.endswith(("_m", "_nats")) else ".1%"
    return "none" if mean is None else f"{mean:{style}} [{low:{style}}, {high:{style}}]"


def draw_costs(rows: pl.DataFrame) -> Drawing:
    """Draw each model's perceived error and missed warnings, and the share of missed vehicles, over penetration."""
    view = (
        pl.when("lidar").then(pl.lit("V2V and LiDAR, ")).otherwise(pl.lit("V2V, "))
        + pl.col("receiver").replace_strict(RECEIVERS)
    ).alias("view")
    shown = rows.with_columns(
        view,
        percent=100 * pl.col("penetration"),
        missed=100 * pl.col("missed_share"),
        unwarned=100 * pl.col("perceived_missed_warnings"),
    )
    names = shown["view"].unique(maintain_order=True).to_list()
    models = shown["model"].unique(maintain_order=True).to_list()
    legend = alt.Legend(title=None, symbolType="stroke", symbolSize=500)
    colour = alt.Color(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[BLUE, BLUE, ORANGE, ORANGE]), legend=legend
    )
    dash = alt.StrokeDash(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[[6, 3], [1, 0], [6, 3], [1, 0]]), legend=legend
    )
    x = alt.X(
        "percent:Q",
        title="vehicles that send (%)",
        scale=alt.Scale(domain=[0, 100]),
        axis=alt.Axis(values=[0, 10, 30, 60, 100]),
    )
    seconds = rows["seconds"][0]
    data: dict[str, list[dict[str, object]]] = {}

    def draw(name: str, title: str, column: str, unit: str, group: str, model: str) -> alt.Chart:
        own = shown.filter((pl.col("group") == group) & (pl.col("model") == model) & pl.col(column).is_not_null())
        data[name] = own.select("view", "percent", column).to_dicts()
        scale = alt.Scale(zero=True) if column.endswith("_m") else alt.Scale(domain=[0, 100])
        y = alt.Y(f"{column}:Q", title=unit, scale=scale)
        lines = alt.Chart(alt.NamedData(name), title=title, width=300, height=200).mark_line(point=True, strokeWidth=2)
        panel: alt.Chart = lines.encode(x=x, y=y, color=colour, strokeDash=dash)
        return panel

    error, unwarned, unseen = f"RMSE at {seconds:g} s (m)", "warnings missed (%)", "samples not perceived (%)"
    rows_of_panels = [
        [draw(f"error-{each}", f"{each}: error", "perceived_rmse_m", error, SPREAD, each) for each in models],
        [draw(f"unwarned-{each}", f"{each}: missed warnings", "unwarned", unwarned, DUE, each) for each in models],
        [draw(f"missed-{group}", f"missed: {group}", "missed", unseen, group, models[0]) for group in (SPREAD, DUE)],
    ]
    grid = alt.vconcat(*(alt.hconcat(*panels) for panels in rows_of_panels))
    return Drawing(grid.properties(title="What an on-board view costs"), data)
