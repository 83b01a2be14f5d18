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

from tracklake.quality_reports.plots.rasters import VIRIDIS
from tracklake.schemas.chart_theme import BLUE, GREEN, INK, MUTED, ORANGE, make_config
from tracklake.schemas.start_assessments import ESTIMATORS

Row = Mapping[str, Any]

SERIES = (BLUE, ORANGE, GREEN)

FLOW = (
    ("flow_veh_per_h", "flow (veh/h/lane)"),
    ("density_veh_per_km", "density (veh/km)"),
    ("speed_mps", "speed (m/s)"),
)
"""Columns of subset_flow.sql and their axis titles."""

CONFIG = make_config(background="transparent", padding=4, label=11, title=12, heading=13)
WIDTH = 760
ROW_HEIGHT = 18
LABEL_LIMIT = 190
"""Longest name of a subset beside a plot, in pixels; tables show it whole."""


def draw_speed_histogram(histogram: Sequence[Row], summary: Sequence[Row]) -> str:
    """Draw the recorded speed per dataset: share of its entries by bin of 1 m/s, with median and 95 % range.

    Args:
        histogram: rows of speed_histogram.sql.
        summary: rows of speeds.sql.
    """
    speeds = [row["speed_mps"] for row in histogram]
    domain = [min(0, *speeds), max(speeds) + 1] if len(speeds) > 1 else [0, max([40, *speeds]) + 1]
    x_scale = alt.Scale(domain=domain, nice=False)
    charts = []
    for dataset in _names(histogram, "dataset"):
        bins = _data(
            {**row, "speed_to_mps": row["speed_mps"] + 1, "percent": 100 * row["share"]}
            for row in histogram
            if row["dataset"] == dataset
        )
        marks = _data(row for row in summary if row["dataset"] == dataset and row["subset"] is None)
        bars = (
            alt.Chart(bins)
            .mark_bar(color=BLUE, opacity=0.75, stroke=None, binSpacing=1)
            .encode(
                x=alt.X("speed_mps:Q", title="recorded speed (m/s)", scale=x_scale),
                x2="speed_to_mps:Q",
                y=alt.Y("percent:Q", title="share of entries (%)", axis=alt.Axis(tickCount=4)),
                y2=alt.datum(0),
            )
        )
        band = (
            alt.Chart(marks)
            .mark_rule(color=INK, strokeWidth=2)
            .encode(x=alt.X("p2_5_mps:Q"), x2="p97_5_mps:Q", y=alt.value(-5))
        )
        median = alt.Chart(marks).mark_rule(color=INK, strokeDash=[5, 3]).encode(x="median_mps:Q")
        charts.append((bars + band + median).properties(width=WIDTH, height=150, title=dataset))
    return _svg(alt.vconcat(*charts))


def draw_speed_ranges(summary: Sequence[Row]) -> str:
    """Draw the recorded speed per subset: extremes (thin), 95 % range (thick) and median (tick).

    Args:
        summary: rows of speeds.sql.
    """
    charts = []
    for dataset in _names(summary, "dataset"):
        subsets = [row for row in summary if row["dataset"] == dataset and row["subset"] is not None]
        base = alt.Chart(_data(subsets)).encode(y=_subset_axis(subsets))
        title = "recorded speed (m/s)"
        extremes = base.mark_rule(color=MUTED, strokeWidth=1).encode(
            x=alt.X("min_mps:Q", title=title, scale=alt.Scale(zero=True), axis=alt.Axis(tickCount=10)), x2="max_mps:Q"
        )
        middle = base.mark_bar(color=BLUE, height=7, opacity=0.75).encode(x=alt.X("p2_5_mps:Q"), x2="p97_5_mps:Q")
        median = base.mark_tick(color=INK, thickness=2, size=14).encode(x="median_mps:Q")
        charts.append((extremes + middle + median).properties(width=WIDTH, height=_height(subsets), title=dataset))
    return _svg(alt.vconcat(*charts).resolve_scale(x="shared"))


def draw_start_positions(positions: Sequence[Row], starts: Sequence[Row]) -> str:
    """Draw where tracks begin in each freeway subset: a mark per 2 m, sized by vehicles, and a tick at the cut-off.

    Args:
        positions: rows of start_positions.sql.
        starts: rows of starts.sql.
    """
    judged = ["on time", "late", "not judged"]
    charts = []
    for dataset in _names(positions, "dataset"):
        rows = [{**row, "middle_m": row["start_x_m"] + 1} for row in positions if row["dataset"] == dataset]
        cutoffs = [row for row in starts if row["dataset"] == dataset and row["cutoff_m"] is not None]
        marks = (
            alt.Chart(_data(rows))
            .mark_point(filled=True, opacity=0.85)
            .encode(
                y=_subset_axis(rows),
                x=alt.X("middle_m:Q", title="x of the first entry (m)", scale=alt.Scale(padding=12, nice=False)),
                size=alt.Size(
                    "vehicles:Q",
                    title="vehicles in 2 m",
                    scale=alt.Scale(range=[36, 400], zero=False),
                    legend=alt.Legend(symbolFillColor=MUTED, symbolStrokeColor=MUTED),
                ),
                color=alt.Color(
                    "judged:N", title="start", scale=alt.Scale(domain=judged, range=[BLUE, ORANGE, MUTED]), sort=judged
                ),
                shape=alt.Shape(
                    "judged:N", title="start", scale=alt.Scale(domain=judged, range=["circle", "diamond", "cross"])
                ),
            )
        )
        ticks = (
            alt.Chart(_data(cutoffs))
            .mark_tick(color=INK, thickness=2, size=ROW_HEIGHT)
            .encode(x=alt.X("cutoff_m:Q"), y=_subset_axis(rows))
        )
        charts.append((marks + ticks).properties(width=WIDTH, height=_height(rows), title=dataset))
    return _svg(alt.vconcat(*charts))


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
    return _svg(
        alt.vconcat(
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
    )


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
    return _svg((subsets + deviation + mean).properties(width=WIDTH, height=52 * max(1, len(present))))


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
    return _svg(bars)


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
    return _svg(marks)


_ROW_HEADER = alt.Header(labelColor=INK, labelAngle=0, labelAlign="left", labelFontSize=13)


def draw_fundamental(intervals: Sequence[Row]) -> str:
    """Draw the fundamental diagram, flow against density: a plot per lane, a mark per interval, coloured by speed.

    Args:
        intervals: rows of subset_flow.sql.
    """
    data = _data({**row, "lane": name_lane(row["lane"])} for row in intervals if row["entries"])
    lanes = _names([{"lane": name_lane(row["lane"])} for row in intervals], "lane")
    marks = (
        alt.Chart(data)
        .mark_point(filled=True, size=42, stroke=MUTED, strokeWidth=0.5, opacity=1)
        .encode(
            x=alt.X("density_veh_per_km:Q", title="density (veh/km)", axis=alt.Axis(tickCount=4)),
            y=alt.Y("flow_veh_per_h:Q", title="flow (veh/h/lane)", axis=alt.Axis(tickCount=4)),
            color=alt.Color(
                "speed_mps:Q",
                title="speed (m/s)",
                scale=alt.Scale(range=[f"#{colour}" for colour in VIRIDIS], zero=True),
                legend=alt.Legend(gradientLength=260, gradientThickness=10),
            ),
        )
        .properties(width=205, height=150)
        .facet(facet=alt.Facet("lane:N", title=None, sort=lanes, header=alt.Header(labelColor=INK)), columns=4)
    )
    return _svg(marks)


def name_lane(lane: int | None) -> str:
    """Return a lane's name for plots."""
    return "no lane" if lane is None else f"lane {lane}"


def _names(rows: Sequence[Row], column: str) -> list[str]:
    """Return the distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(row[column] for row in rows))


def _data(rows: Iterable[Row]) -> alt.InlineData:
    """Return rows as a chart's inline data, as JSON text: Altair copies data with every change of a chart."""
    return alt.InlineData(values=json.dumps(list(rows)))


def _subset_axis(rows: Sequence[Row]) -> alt.Y:
    """Return the vertical axis of plots with one line per subset, in the table's order."""
    return alt.Y("subset:N", title=None, sort=_names(rows, "subset"), axis=alt.Axis(labelLimit=LABEL_LIMIT, grid=True))


def _height(rows: Sequence[Row]) -> int:
    """Return the height for one line per subset, in pixels."""
    return ROW_HEIGHT * max(2, len(_names(rows, "subset")))


def _svg(chart: alt.Chart | alt.LayerChart | alt.FacetChart | alt.HConcatChart | alt.VConcatChart) -> str:
    """Render a chart, transparent and in the report's ink."""
    styled = chart.configure(**CONFIG)
    # Rows are aggregates: a few thousand at most, but more than Altair's limit for unaggregated data.
    with alt.data_transformers.enable("default", max_rows=None):
        svg: str = vl_convert.vegalite_to_svg(styled.to_dict(validate=False))
    # Sizes are the style sheet's business; without a viewBox's own width and height the drawing fills its figure.
    return re.sub(r"^<svg ", '<svg role="img" ', svg, count=1)
