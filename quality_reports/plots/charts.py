"""Altair charts of the report: plots of rows already aggregated by SQL, as SVG text.

Every function takes rows of one or two statements of `sql/` and returns one `<svg>` element, the same bytes for the
same rows, that fetches nothing. The page's style sheet (`templates/report.css`) maps the theme's colours onto the
reader's, by their values.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import altair as alt
import vl_convert

from tracklake.schemas.chart_theme import BLUE, GREEN, INK, MUTED, ORANGE, make_config
from tracklake.schemas.start_assessments import ESTIMATORS

Row = Mapping[str, Any]

SERIES = (BLUE, ORANGE, GREEN)

CONFIG = make_config(background="transparent", padding=4, label=11, title=12, heading=13)
WIDTH = 760
LABEL_LIMIT = 190
"""Longest name of a subset beside a plot, in pixels; tables show it whole."""


def draw_assessments(positions: Sequence[Row]) -> str:
    """Draw coverage and excess of repair windows by the tracks' starts: a row of two plots per dataset.

    Args:
        positions: rows of assessed_positions.sql.
    """
    data = _data(
        {
            "dataset": row["dataset"],
            "beyond_m": row["beyond_m"],
            "estimator": name_estimator(row["estimator"]),
            "coverage": None if row["coverage"] is None else 100 * row["coverage"],
            "excess": None if row["excess"] is None else 100 * row["excess"],
        }
        for row in positions
    )
    names = [name_estimator(name) for name in ESTIMATORS]
    marks = (
        alt.Chart(data)
        .mark_line(point=alt.OverlayMarkDef(size=46, filled=True, opacity=1), strokeWidth=1.5)
        .encode(
            x=alt.X("beyond_m:Q", title="start beyond the cut-off (m)", axis=alt.Axis(tickCount=5)),
            color=alt.Color(
                "estimator:N", title=None, scale=alt.Scale(domain=names, range=[BLUE, ORANGE, MUTED, GREEN]), sort=names
            ),
            shape=alt.Shape(
                "estimator:N", title=None, scale=alt.Scale(domain=names, range=["circle", "square", "cross", "diamond"])
            ),
        )
        .properties(width=(WIDTH - 130) // 2, height=190)
    )
    chart = alt.vconcat(
        *(
            alt.hconcat(
                *(
                    marks.encode(
                        y=alt.Y(f"{figure}:Q", title=title, scale=alt.Scale(zero=zero), axis=alt.Axis(tickCount=5))
                    )
                    .transform_filter(alt.datum.dataset == dataset)
                    .properties(title=dataset)
                    for figure, title, zero in (
                        ("coverage", "covered (% of missing time)", False),
                        ("excess", "excess (% of missing time)", True),
                    )
                )
            )
            for dataset in _names(positions, "dataset")
        )
    )
    return _svg(chart, "Coverage and excess of repair windows by start position")


def name_estimator(name: str) -> str:
    """Return an estimator's name for plots and tables."""
    return name.replace("_", " ")


def draw_split(members: Sequence[Row], balance: Sequence[Row], split: str, dataset: str) -> str:
    """Draw vehicles_per_lane_s of a split's subsets by part, with each part's weighted mean and deviation.

    Args:
        members: rows of split_members.sql.
        balance: rows of split_balance.sql.
        split: the split's name.
        dataset: whose parts.
    """
    parts = ["train", "val", "eval"]
    rate = "vehicles_per_lane_s"
    stands = [row for row in members if (row["split"], row["dataset"]) == (split, dataset) and row[rate] is not None]
    weighed = [
        {
            **row,
            "from": row[f"{rate}_mean"] - (row[f"{rate}_std"] or 0),
            "to": row[f"{rate}_mean"] + (row[f"{rate}_std"] or 0),
        }
        for row in balance
        if (row["split"], row["dataset"]) == (split, dataset) and row[f"{rate}_mean"] is not None
    ]
    present = [part for part in parts if part in {row["part"] for row in [*stands, *weighed]}]
    axis = alt.Y("part:N", title=None, scale=alt.Scale(domain=present, padding=0.5))
    x_scale = alt.Scale(zero=False, nice=True, padding=12)
    subsets = (
        alt.Chart(_data(stands))
        .mark_point(filled=True, opacity=0.7, size=90)
        .encode(
            x=alt.X(f"{rate}:Q", title="vehicles per lane and second", scale=x_scale, axis=alt.Axis(tickCount=8)),
            y=axis,
            color=alt.Color("part:N", scale=alt.Scale(domain=parts, range=list(SERIES)), legend=None),
            shape=alt.Shape(
                "part:N", scale=alt.Scale(domain=parts, range=["circle", "square", "diamond"]), legend=None
            ),
        )
    )
    spread = alt.Chart(_data(weighed)).encode(y=axis)
    deviation = spread.mark_rule(color=INK, yOffset=17).encode(x=alt.X("from:Q", scale=x_scale), x2="to:Q")
    mean = spread.mark_tick(color=INK, thickness=2, size=12, yOffset=17).encode(x=f"{rate}_mean:Q")
    chart = (subsets + deviation + mean).properties(width=WIDTH, height=52 * max(1, len(present)))
    return _svg(chart, "Vehicles per lane and second of the subsets of each part")


def draw_shared(shared: Sequence[Row], splits: Sequence[str]) -> str:
    """Draw the shares of the evaluation part that are also in training, per dataset and split.

    Args:
        shared: split, dataset, what, percent.
        splits: their names, in order.
    """
    kinds = _names(shared, "what")
    bars = (
        alt.Chart(_data(shared))
        .mark_bar(height=9)
        .encode(
            x=alt.X("percent:Q", title="of the evaluation part (%)", scale=alt.Scale(domain=[0, 100])),
            y=alt.Y("split:N", title=None, sort=list(splits), axis=alt.Axis(labelLimit=LABEL_LIMIT)),
            yOffset=alt.YOffset("what:N", sort=kinds),
            color=alt.Color(
                "what:N", title=None, sort=kinds, scale=alt.Scale(domain=kinds, range=[BLUE, ORANGE, GREEN, MUTED])
            ),
        )
        .properties(width=WIDTH - LABEL_LIMIT, height=alt.Step(14))
        .facet(row=alt.Row("dataset:N", title=None, header=_ROW_HEADER))
    )
    return _svg(bars, "What of the evaluation part is in the training part")


def draw_shifts(shifts: Sequence[Row], splits: Sequence[str]) -> str:
    """Draw how far training and evaluation differ, per dataset and quantity: one mark per split.

    Args:
        shifts: rows of split_shifts.sql, of one pair of parts.
        splits: their names, in order.
    """
    marks = (
        alt.Chart(_data(shifts))
        .mark_point(filled=True, size=90, opacity=0.85)
        .encode(
            x=alt.X("shift:Q", title="greatest difference of the cumulative distributions", scale=alt.Scale(zero=True)),
            y=alt.Y("quantity:N", title=None, sort=_names(shifts, "quantity"), axis=alt.Axis(grid=True)),
            color=alt.Color(
                "split:N",
                title=None,
                sort=list(splits),
                scale=alt.Scale(domain=list(splits), range=[BLUE, GREEN, MUTED, ORANGE]),
            ),
            shape=alt.Shape(
                "split:N",
                title=None,
                sort=list(splits),
                scale=alt.Scale(domain=list(splits), range=["circle", "square", "cross", "diamond"]),
            ),
        )
        .properties(width=WIDTH - LABEL_LIMIT, height=5 * 26)
        .facet(row=alt.Row("dataset:N", title=None, header=_ROW_HEADER))
    )
    return _svg(marks, "Shifts between training and evaluation")


_ROW_HEADER = alt.Header(labelColor=INK, labelAngle=0, labelAlign="left", labelFontSize=13)


def _names(rows: Sequence[Row], column: str) -> list[str]:
    """Return the distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(row[column] for row in rows))


def _data(rows: Iterable[Row]) -> alt.InlineData:
    """Return rows as a chart's inline data, as JSON text: Altair copies data with every change of a chart."""
    return alt.InlineData(values=json.dumps(list(rows)))


def _svg(chart: alt.Chart | alt.LayerChart | alt.FacetChart | alt.HConcatChart | alt.VConcatChart, label: str) -> str:
    """Render a chart, transparent and in the report's ink; `label` describes it in plain text of our own."""
    # Rows are aggregates: a few thousand at most, but more than Altair's limit for unaggregated data.
    with alt.data_transformers.enable("default", max_rows=None):
        specification = chart.to_dict(validate=False)
    specification["config"] = alt.utils.update_nested(specification["config"], CONFIG)  # configure() copies the chart
    svg: str = vl_convert.vegalite_to_svg(specification)
    # Sizes are the style sheet's business; without a viewBox's own width and height the drawing fills its figure.
    return re.sub(r"^<svg ", f'<svg role="img" aria-label="{label}" ', svg, count=1)
