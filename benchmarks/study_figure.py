"""The figure of errors over the horizon: RMSE and its growth from step to step, one column per data set."""

from functools import partial

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import AMBER, BLUE, GREEN, INK, ORANGE, PURPLE, SKY
from tracklake.training.plots.charts import Drawing

KEY = ("model", "dataset", "seed", "seconds")
COLUMNS = {
    "model": pl.String(),
    "dataset": pl.String(),
    "seed": pl.Int64(),
    "seconds": pl.Float64(),
    "rmse_m": pl.Float64(),
}
"""Columns of the table that is drawn."""

PALETTE = (BLUE, ORANGE, GREEN, PURPLE, AMBER, SKY, INK)
DASHES: tuple[list[int], ...] = ([1, 0], [8, 4], [2, 3])
"""Colours of models; after the last one they repeat with the next dashes."""
MOST_MODELS = len(PALETTE) * len(DASHES)

FIGURE_WIDTH, HEIGHT, GAP, AXIS = 1060, 230, 30, 52
"""Width of the figure, height of a panel, space between panels, and width of the vertical axis, in pixels."""


def draw_error_growth(table: pl.DataFrame) -> Drawing:
    """Draw RMSE over time, and its change from each time to the next: means over seeds, in bands of all seeds.

    The first change is from 0 m at the sample's own tick. Models and data sets keep their order in the table.

    Args:
        table: COLUMNS, one row per KEY; every data set is a column of the figure. The times of a run (model, data set
            and seed) are 1, 2, ... steps; all runs have the same step, each its own last time.

    Raises:
        ValueError: a column is missing or of another dtype, a value is null, not finite or negative, a key repeats,
            times are not such steps, or there are more than MOST_MODELS models.
    """
    _check_errors(table)
    models, datasets = (table[name].unique(maintain_order=True).to_list() for name in ("model", "dataset"))
    seeds = table.group_by("model", "dataset").agg(pl.col("seed").n_unique())["seed"].unique().sort().to_list()
    many = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    bands = f"means of {many} seeds, in bands from the least to the greatest"
    heading = alt.Title("Errors over the horizon", subtitle="of one seed" if seeds == [1] else bands, offset=10)
    growth = f"change of RMSE per {min(table['seconds'].to_list()):g} s (m)"
    figures = (
        _draw_figure(models, datasets, "rmse", "RMSE (m)", named=True),
        _draw_figure(models, datasets, "growth", growth, named=False),
    )
    return Drawing(alt.vconcat(*figures, spacing=24, title=heading), {"errors": summarise_seeds(table).to_dicts()})


def _check_errors(table: pl.DataFrame) -> None:
    """Refuse a table that cannot be drawn, or would be drawn wrongly, as `draw_error_growth` says."""
    what = "errors to draw: expected"
    for name, dtype in COLUMNS.items():
        if table.schema.get(name) != dtype:
            raise ValueError(f"{what} a column `{name}` of {dtype}, got {table.schema.get(name)}")
    if table.is_empty():
        raise ValueError(f"{what} rows, got none")
    drawn, seconds, rmse_m = table.select(*COLUMNS), pl.col("seconds"), pl.col("rmse_m")
    missing = pl.any_horizontal(pl.all().is_null())
    uneven_s = (seconds - seconds.min() * pl.int_range(1, pl.len() + 1).over(KEY[:3])).abs()
    problems = {
        "finite times, and RMSE of 0 or more, got": drawn.filter(
            missing | ~(rmse_m.is_finite() & (rmse_m >= 0) & seconds.is_finite())
        ),
        f"one row per {', '.join(KEY)}, got two such:": drawn.filter(drawn.select(KEY).is_duplicated()),
        "times 1, 2, ... steps ahead, the same step for all, got": drawn.sort("seconds", maintain_order=True).filter(
            (seconds.min() <= 0) | (uneven_s > 1e-6)
        ),
    }
    for expected, wrong in problems.items():
        if wrong.height:
            raise ValueError(f"{what} {expected} {wrong.row(0, named=True)}")
    if drawn["model"].n_unique() > MOST_MODELS:
        raise ValueError(f"{what} at most {MOST_MODELS} models, got {drawn['model'].n_unique()}")


def summarise_seeds(table: pl.DataFrame) -> pl.DataFrame:
    """Compute mean, least and greatest over seeds, of RMSE and of its change since the time before.

    Returns:
        model, dataset, seconds, and columns as `rmse_mean_m`, `growth_low_m` ...; by model and data set in their order
        in the table, then by time.
    """
    before = pl.col("rmse_m").shift(1, fill_value=0.0).over(KEY[:3])
    grown = table.sort("seconds").with_columns(growth_m=pl.col("rmse_m") - before)
    figures = [
        figure.alias(f"{name}_{what}_m")
        for name, column in (("rmse", pl.col("rmse_m")), ("growth", pl.col("growth_m")))
        for what, figure in (("mean", column.mean()), ("low", column.min()), ("high", column.max()))
    ]
    over_seeds = grown.group_by("model", "dataset", "seconds").agg(figures).sort("seconds")
    order = table.select("model", "dataset").unique(maintain_order=True)
    return order.join(over_seeds, on=["model", "dataset"], maintain_order="left_right")


def _draw_figure(models: list[str], datasets: list[str], figure: str, title: str, *, named: bool) -> alt.FacetChart:
    """Draw one figure in a panel per data set; `named`: with the data sets' names above."""
    sign = partial(alt.Legend, symbolType="stroke", symbolSize=600, symbolStrokeWidth=2.5, symbolOpacity=1)
    legend = sign(title=None, columns=6, labelColor=INK, labelLimit=170)
    value = partial(alt.Y, title=title, axis=alt.Axis(tickCount=5, minExtent=AXIS, maxExtent=AXIS))
    numbers = range(len(models))
    colours = alt.Scale(domain=models, range=[PALETTE[number % len(PALETTE)] for number in numbers])
    dashes = alt.Scale(domain=models, range=[DASHES[number // len(PALETTE)] for number in numbers])
    base = alt.Chart().encode(
        x=alt.X(
            "seconds:Q",
            title="seconds ahead",
            scale=alt.Scale(zero=True, nice=False),
            axis=alt.Axis(grid=False, tickMinStep=1, format="d", labelFlush=False),
        ),
        color=alt.Color("model:N", sort=models, scale=colours, legend=legend),
    )
    band = base.mark_area(opacity=0.15).encode(y=value(f"{figure}_low_m:Q"), y2=f"{figure}_high_m:Q")
    line = base.mark_line(strokeWidth=2).encode(
        y=value(f"{figure}_mean_m:Q"),
        strokeDash=alt.StrokeDash("model:N", sort=models, scale=dashes, legend=legend),
    )
    bold = partial(alt.Header, labelFontSize=15, labelFontWeight="bold", labelColor=INK, labelAnchor="start")
    width = (FIGURE_WIDTH - GAP * (len(datasets) - 1)) // len(datasets)
    panels = alt.layer(band, line, data=alt.NamedData("errors"), width=width, height=HEIGHT)
    return panels.facet(
        column=alt.Column("dataset:N", sort=datasets, header=bold(title=None, labels=named)), spacing=GAP
    )
