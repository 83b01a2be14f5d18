"""The figure of errors over the horizon: a panel per arm, a line per model."""

from collections.abc import Mapping

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import AMBER, BLUE, GREEN, INK, ORANGE, PURPLE, SKY
from tracklake.training.plots.charts import Drawing

PALETTE = (INK, AMBER, BLUE, ORANGE, GREEN, PURPLE, SKY)
DASHES: tuple[list[int], ...] = ([1, 0], [8, 4], [2, 3])
"""Colours and dashes of models in their order; after the last colour they repeat with the next dashes."""
WIDTH, HEIGHT = 480, 260
"""Size of a panel, in pixels."""


def draw_errors(rows: pl.DataFrame, figures: Mapping[str, str]) -> Drawing:
    """Draw RMSE over time: means over seeds, in bands from the least to the greatest.

    Where the recording has no lateral positions, it is the RMSE along the road.

    Args:
        rows: `seeds` of the study's tables, of all samples.
        figures: titles of columns.
    """
    error = pl.coalesce("rmse_m", "rmse_longitudinal_m")
    seeds = rows.group_by("arm", "model", "seconds", maintain_order=True).agg(
        error.mean().alias("mean_m"), error.min().alias("low_m"), error.max().alias("high_m")
    )
    models, arms = (seeds[name].unique(maintain_order=True).to_list() for name in ("model", "arm"))
    colours = [PALETTE[number % len(PALETTE)] for number in range(len(models))]
    dashes = [DASHES[number // len(PALETTE) % len(DASHES)] for number in range(len(models))]
    symbol = {"symbolType": "stroke", "symbolSize": 500, "symbolStrokeWidth": 2.5, "symbolOpacity": 1}
    legend = alt.Legend(title=None, columns=4, labelColor=INK, labelLimit=190, orient="bottom", **symbol)
    base = alt.Chart().encode(
        x=alt.X("seconds:Q", title="seconds ahead", axis=alt.Axis(grid=False, tickMinStep=1, format="d")),
        color=alt.Color("model:N", sort=models, scale=alt.Scale(domain=models, range=colours), legend=legend),
    )
    title = figures["rmse_m"]
    band = base.mark_area(opacity=0.15).encode(y=alt.Y("low_m:Q", title=title), y2="high_m:Q")
    line = base.mark_line(strokeWidth=2).encode(
        y=alt.Y("mean_m:Q", title=title),
        strokeDash=alt.StrokeDash("model:N", sort=models, scale=alt.Scale(domain=models, range=dashes), legend=legend),
    )
    panels = alt.layer(band, line, data=alt.NamedData("errors"), width=WIDTH, height=HEIGHT)
    header = alt.Header(title=None, labelFontSize=15, labelFontWeight="bold", labelColor=INK, labelAnchor="start")
    heading = alt.Title("Errors over the horizon", subtitle="means over seeds, in bands of all of them", offset=10)
    chart = panels.facet(alt.Facet("arm:N", sort=arms, header=header), columns=2).properties(title=heading)
    return Drawing(chart, {"errors": seeds.to_dicts()})
