"""The page and the figure of docs/onboard-view.csv; every number on the page is in that file."""

from pathlib import Path

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import BLUE, ORANGE
from tracklake.training.plots.charts import Drawing

RECEIVERS = {"plain": "plain GPS", "dgps": "DGPS"}
TEXT = """# What an on-board view costs

Models that predict vehicles are trained and scored on overhead tracks, which show every vehicle exactly. A car on the
road has V2V messages of some vehicles, and a LiDAR that sees some others. This study feeds the same models, trained
once on overhead tracks, with both views of the same moments, and scores them on the same true futures.

`make onboard-study` makes it again: it generates two samples, instruments cars of one ([drives.md](drives.md)), reads
and fuses their logs, and writes [onboard-view.csv](onboard-view.csv), this page and the figure. The traffic is
simulated: the figures compare views, not models with publications.

- Judged are vehicles within 100 m along the road of the ego, {seconds:g} s ahead: {samples} samples (a vehicle at a
  moment) of {vehicles} vehicles around {egos} egos.
- Every vehicle's heading is off by 1 degree to either side. Penetration is the share of the other vehicles that send.
- RMSE and NLL are of the vehicles that were perceived over the whole history of 2 s, from both views. Where few send,
  these are few, and others than where many do.
- Missed are true vehicles that were not perceived so, false are perceived ones that are none, or that were
  perceived twice.
- A warning is due where a vehicle's true cell touches the ego's within the horizon. Missed and false warnings count
  samples of all vehicles, also of those that are not perceived.
- Brackets hold 95 % intervals, by drawing vehicles 1,000 times.

![Error and missed vehicles by penetration, with and without LiDAR, with plain GPS and DGPS](onboard-view.svg)
"""


def write_page(table: Path) -> None:
    """Write the page and the figure beside the table of figures."""
    rows = pl.read_csv(table)
    table.with_suffix(".md").write_text(render_page(rows), encoding="utf-8")
    table.with_suffix(".svg").write_bytes(draw_costs(rows).render(".svg"))


def render_page(rows: pl.DataFrame) -> str:
    """Render the page of the table's rows."""
    counts = {name: f"{rows[name].max():,}" for name in ("samples", "vehicles", "egos")}
    parts = [TEXT.format(seconds=rows["seconds"][0], **counts)]
    if rows["warnings_due"].max() == 0:
        parts.append("No warning was due around these egos: the study shows false warnings only.\n")
    for (model,), own in rows.group_by("model", maintain_order=True):
        parts.append(f"\n## {model}\n")
        parts.append(
            "| GPS | LiDAR | penetration | n | RMSE overhead, m | RMSE perceived, m | NLL overhead | NLL perceived | "
            "missed vehicles | false vehicles | warnings due | missed: overhead, perceived | "
            "false: overhead, perceived |"
        )
        parts.append("| --- | --- " + "| ---: " * 11 + "|")
        for row in own.iter_rows(named=True):
            cells = [
                RECEIVERS[row["receiver"]],
                "yes" if row["lidar"] else "no",
                f"{row['penetration']:.0%}",
                f"{row['n']:,}",
                *(_write_interval(row, name) for name in ("overhead_rmse_m", "perceived_rmse_m")),
                *(_write_interval(row, name) for name in ("overhead_nll_nats", "perceived_nll_nats")),
                f"{row['missed_share']:.0%} [{row['missed_share_low']:.0%}, {row['missed_share_high']:.0%}]",
                f"{row['false_vehicles']:,}",
                f"{row['warnings_due']:,}",
                f"{row['overhead_missed_warnings']:,}, {row['perceived_missed_warnings']:,}",
                f"{row['overhead_false_warnings']:,}, {row['perceived_false_warnings']:,}",
            ]
            parts.append(f"| {' | '.join(cells)} |")
    return "\n".join(parts) + "\n"


def _write_interval(row: dict[str, float | None], name: str) -> str:
    mean, low, high = row[name], row[f"{name}_low"], row[f"{name}_high"]
    return "none" if mean is None else f"{mean:.2f} [{low:.2f}, {high:.2f}]"


def draw_costs(rows: pl.DataFrame) -> Drawing:
    """Draw the perceived error of each model and the share of missed vehicles over penetration."""
    view = (
        pl.when("lidar").then(pl.lit("V2V and LiDAR, ")).otherwise(pl.lit("V2V, "))
        + pl.col("receiver").replace_strict(RECEIVERS)
    ).alias("view")
    shown = rows.with_columns(view, percent=100 * pl.col("penetration"), missed=100 * pl.col("missed_share"))
    names = shown["view"].unique(maintain_order=True).to_list()
    models = shown["model"].unique(maintain_order=True).to_list()
    legend = alt.Legend(title=None, symbolType="stroke", symbolSize=500)
    colour = alt.Color(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[BLUE, BLUE, ORANGE, ORANGE]), legend=legend
    )
    dash = alt.StrokeDash(
        "view:N", sort=names, scale=alt.Scale(domain=names, range=[[6, 3], [1, 0], [6, 3], [1, 0]]), legend=legend
    )
    x = alt.X("percent:Q", title="vehicles that send (%)", scale=alt.Scale(domain=[0, 100]))
    data, panels = {}, []
    for model in models:
        own = shown.filter((pl.col("model") == model) & pl.col("perceived_rmse_m").is_not_null())
        data[model] = own.select("view", "percent", "perceived_rmse_m").to_dicts()
        seconds = rows["seconds"][0]
        y = alt.Y("perceived_rmse_m:Q", title=f"RMSE at {seconds:g} s (m)", scale=alt.Scale(zero=True))
        panels.append(_draw_panel(model, model, x, y, colour, dash))
    data["missed"] = shown.filter(pl.col("model") == models[0]).select("view", "percent", "missed").to_dicts()
    y = alt.Y("missed:Q", title="vehicles not perceived (%)", scale=alt.Scale(domain=[0, 100]))
    panels.append(_draw_panel("missed", "missed vehicles", x, y, colour, dash))
    grid = alt.vconcat(alt.hconcat(*panels[:2]), alt.hconcat(*panels[2:]))
    return Drawing(grid.properties(title="What an on-board view costs"), data)


def _draw_panel(data: str, title: str, x: alt.X, y: alt.Y, colour: alt.Color, dash: alt.StrokeDash) -> alt.Chart:
    lines = alt.Chart(alt.NamedData(data), title=title, width=360, height=220)
    return lines.mark_line(point=True, strokeWidth=2).encode(x=x, y=y, color=colour, strokeDash=dash)
