"""Figures of the study: errors over the horizon, prices of leakage and defects, and losses by epoch."""

from collections.abc import Mapping, Sequence

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import AMBER, BLUE, GREEN, INK, ORANGE, PURPLE, SKY
from tracklake.schemas.drawings import Drawing

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


def draw_prices(rows: Sequence[Mapping[str, object]]) -> Drawing:
    """Draw prices with their 95 % intervals, a panel for leakage and one for defects; orange where one excludes zero.

    Args:
        rows: those of `Results.list_prices`.
    """
    titles = {
        "leakage": "Leakage: RMSE at 5 s, trained under csp-2018 minus trained under time-blocks, on the same samples",
        "defects": "Defects and the share of the vehicles that have them: RMSE at 5 s, minus that without",
    }
    panels = []
    for price, title in titles.items():
        shown = [row for row in rows if row["price"] == price]
        if shown:
            heading = alt.Title(title, anchor="start", frame="group", fontSize=13)
            base = alt.Chart(alt.NamedData("prices"), title=heading)
            base = base.transform_filter(f"datum.price == '{price}'").encode(
                y=alt.Y("what:N", title=None, sort=[row["what"] for row in shown], axis=alt.Axis(labelLimit=320)),
                color=alt.condition("datum.low > 0 || datum.high < 0", alt.value(ORANGE), alt.value(BLUE)),
            )
            interval = base.mark_rule(strokeWidth=2).encode(x=alt.X("low:Q", title="m"), x2="high:Q")
            point = base.mark_point(filled=True, size=60, opacity=1).encode(x=alt.X("difference:Q", title="m"))
            zero = alt.Chart(alt.NamedData("prices")).mark_rule(color=INK, strokeDash=[4, 3]).encode(x=alt.datum(0))
            panels.append((zero + interval + point).properties(width=560, height=24 * len(shown)))
    heading = alt.Title(
        "The price of a split that leaks, and of defects", subtitle="points and 95 % intervals, m", offset=10
    )
    return Drawing(alt.vconcat(*panels, title=heading), {"prices": [dict(row) for row in rows]})


def draw_curves(rows: pl.DataFrame) -> Drawing:
    """Draw losses by epoch, a panel per model and phase: validation in orange, training in blue, a line per seed.

    Args:
        rows: `curves` of the study's tables.
    """
    panel = pl.format("{}: {}", "model", "phase").alias("panel")
    drawn = rows.select(panel, pl.format("{} {}", "lake", "seed").alias("run"), "epoch", "loss", "validation_loss")
    order = drawn["panel"].unique(maintain_order=True).to_list()
    base = alt.Chart().encode(x=alt.X("epoch:Q", title="epoch"), detail="run:N")
    training = base.mark_line(strokeWidth=1, color=BLUE).encode(y=alt.Y("loss:Q", title="loss").scale(zero=False))
    validation = base.mark_line(strokeWidth=1.5, color=ORANGE).encode(y=alt.Y("validation_loss:Q").scale(zero=False))
    panels = alt.layer(training, validation, data=alt.NamedData("curves"), width=260, height=160)
    header = alt.Header(title=None, labelFontSize=13, labelFontWeight="bold", labelColor=INK, labelAnchor="start")
    text = "orange: validation, blue: training; a line per seed; mse in m2, nll in nats"
    chart = (
        panels.facet(alt.Facet("panel:N", sort=order, header=header), columns=3)
        .resolve_scale(x="independent", y="independent")
        .properties(title=alt.Title("Losses by epoch", subtitle=text, offset=10))
    )
    return Drawing(chart, {"curves": drawn.to_dicts()})
