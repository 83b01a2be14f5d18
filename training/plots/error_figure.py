"""A figure of errors over the horizon: RMSE, and how much it grows from step to step, one column per data set."""

import altair as alt
import polars as pl

from tracklake.training.plots.charts import AMBER, BLUE, GREEN, INK, ORANGE, PURPLE, SKY, Drawing, Layers, Tables

KEY = ("model", "dataset", "seed", "seconds")
COLUMNS = {
    "model": pl.String(),
    "dataset": pl.String(),
    "seed": pl.Int64(),
    "seconds": pl.Float64(),
    "rmse_m": pl.Float64(),
}
"""Of the table that is drawn."""

PALETTE = (BLUE, ORANGE, GREEN, PURPLE, AMBER, SKY, INK)
DASHES: tuple[list[int], ...] = ([1, 0], [8, 4], [2, 3])
"""Colours; where all are used, the same again with the next dashes."""
MOST_MODELS = len(PALETTE) * len(DASHES)

FIGURE_WIDTH, HEIGHT, GAP, AXIS = 1060, 230, 30, 52
"""Pixels; the last for the numbers and title beside a panel, so that all stand in line."""


def draw_error_growth(table: pl.DataFrame) -> Drawing:
    """Lines of the mean over seeds, in a band from the least to the greatest; models in their order in the table.

    The upper row is RMSE over time; the lower one is its change from each time to the next, the first from 0 m at the
    sample's own moment.

    Args:
        table: COLUMNS, one row per KEY; `dataset` is what a column of the figure is called. The times of a run (model,
            data set and seed) are 1, 2, ... steps; the step is that of all, the last time its own.

    Raises:
        ValueError: a column is missing or of another dtype, a value is null, not finite or negative, a key comes twice,
            times are not such steps, or there are more than MOST_MODELS models.
    """
    check_errors(table)
    models, datasets = (table[name].unique(maintain_order=True).to_list() for name in ("model", "dataset"))
    panels = (("rmse", "RMSE (m)"), ("growth", f"change of RMSE per {min(table['seconds'].to_list()):g} s (m)"))
    tables = Tables()
    everything = tables.chart("errors", summarise_seeds(table).to_dicts())
    width = (FIGURE_WIDTH - GAP * (len(datasets) - 1)) // len(datasets)
    rows = (
        alt.hconcat(
            *(
                _draw_panel(everything, models, dataset, figure, title if column == 0 else None).properties(
                    width=width,
                    height=HEIGHT,
                    title=alt.Title(dataset, fontSize=15, frame="group", offset=12) if figure == "rmse" else "",
                )
                for column, dataset in enumerate(datasets)
            ),
            spacing=GAP,
        ).resolve_scale(y="shared")
        for figure, title in panels
    )
    heading = alt.Title("Errors over the horizon", subtitle=_tell_seeds(table), offset=10)
    return Drawing(alt.vconcat(*rows, spacing=24, title=heading), tables)


def _tell_seeds(table: pl.DataFrame) -> str:
    """What lines and bands are."""
    seeds = table.group_by("model", "dataset").agg(pl.col("seed").n_unique())["seed"].unique().sort().to_list()
    if seeds == [1]:
        return "of one seed"
    many = f"{seeds[0]}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    return f"means of {many} seeds, in bands from the least to the greatest"


def check_errors(table: pl.DataFrame) -> None:
    """Refuse a table that cannot be drawn, or would be drawn wrongly; see `draw_error_growth`."""
    what = "errors to draw: expected"
    for name, dtype in COLUMNS.items():
        if table.schema.get(name) != dtype:
            raise ValueError(f"{what} a column `{name}` of {dtype}, got {table.schema.get(name)}")
    drawn = table.select(*COLUMNS)
    if drawn.is_empty():
        raise ValueError(f"{what} rows, got none")
    wrong = drawn.filter(
        pl.any_horizontal(pl.all().is_null())
        | ~(pl.col("rmse_m").is_finite() & (pl.col("rmse_m") >= 0) & pl.col("seconds").is_finite())
    )
    if wrong.height:
        raise ValueError(f"{what} finite times, and RMSE of 0 or more, got {wrong.row(0, named=True)}")
    twice = drawn.filter(drawn.select(KEY).is_duplicated())
    if twice.height:
        raise ValueError(f"{what} one row per {', '.join(KEY)}, got two such: {twice.row(0, named=True)}")
    step = pl.col("seconds").min()
    uneven = drawn.sort("seconds", maintain_order=True).filter(
        (step <= 0) | ((pl.col("seconds") - step * pl.int_range(1, pl.len() + 1).over(KEY[:3])).abs() > 1e-6)
    )
    if uneven.height:
        raise ValueError(f"{what} times 1, 2, ... steps ahead, the same step for all, got {uneven.row(0, named=True)}")
    if drawn["model"].n_unique() > MOST_MODELS:
        raise ValueError(f"{what} at most {MOST_MODELS} models, got {drawn['model'].n_unique()}")


def summarise_seeds(table: pl.DataFrame) -> pl.DataFrame:
    """Mean, least and greatest over seeds, of RMSE and of its change since the time before.

    Args:
        table: as `draw_error_growth` takes it.

    Returns:
        model, dataset, seconds; mean, low and high of each, as `rmse_mean_m`, `growth_low_m` ...; by model and data set
        in their order in the table, then by time.
    """
    before = pl.col("rmse_m").shift(1, fill_value=0.0).over(KEY[:3])
    grown = table.sort("seconds").with_columns(growth_m=pl.col("rmse_m") - before)
    figures = [
        figure
        for name in ("rmse", "growth")
        for figure in (
            pl.col(f"{name}_m").mean().alias(f"{name}_mean_m"),
            pl.col(f"{name}_m").min().alias(f"{name}_low_m"),
            pl.col(f"{name}_m").max().alias(f"{name}_high_m"),
        )
    ]
    over_seeds = grown.group_by("model", "dataset", "seconds").agg(figures).sort("seconds")
    order = table.select("model", "dataset").unique(maintain_order=True)
    return order.join(over_seeds, on=["model", "dataset"], maintain_order="left_right")


def _draw_panel(everything: alt.Chart, models: list[str], dataset: str, figure: str, title: str | None) -> Layers:
    """One figure of one data set."""
    colours = [PALETTE[number % len(PALETTE)] for number in range(len(models))]
    dashes = [DASHES[number // len(PALETTE)] for number in range(len(models))]
    legend = alt.Legend(
        title=None,
        orient="top",
        columns=6,
        symbolType="stroke",
        symbolSize=600,
        symbolStrokeWidth=2.5,
        symbolOpacity=1,
        columnPadding=20,
        rowPadding=4,
        labelFontSize=13,
        labelColor=INK,
        labelLimit=170,
    )
    axis = alt.Axis(grid=False, tickMinStep=1, format="d", labelFlush=False)
    base = everything.transform_filter(alt.FieldEqualPredicate(field="dataset", equal=dataset)).encode(
        x=alt.X("seconds:Q", title="seconds ahead", scale=alt.Scale(zero=True, nice=False), axis=axis),
        color=alt.Color("model:N", sort=models, scale=alt.Scale(domain=models, range=colours), legend=legend),
    )

    def value(what: str) -> alt.Y:
        axis = alt.Axis(tickCount=5, minExtent=AXIS, maxExtent=AXIS)
        return alt.Y(f"{figure}_{what}_m:Q", title=title, axis=axis)

    band = base.mark_area(opacity=0.15).encode(y=value("low"), y2=f"{figure}_high_m:Q")
    line = base.mark_line(strokeWidth=2).encode(
        y=value("mean"),
        strokeDash=alt.StrokeDash("model:N", sort=models, scale=alt.Scale(domain=models, range=dashes), legend=legend),
    )
    return alt.layer(band, line)
