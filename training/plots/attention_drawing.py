"""The drawing of a sample's attention: one line per head: the road as the ego sees it, and the whole matrices."""

from pathlib import Path

import altair as alt

from tracklake.training.plots.attention_rows import (
    LANES,
    AttentionMap,
    list_bands,
    list_boxes,
    list_cells,
    list_markings,
    span_road,
    tell_head,
)
from tracklake.training.plots.charts import INK, MUTED, Drawing, Tables, check_suffix

ROAD_WIDTH, MATRIX_SIZE, LANES_WIDTH = 590, 165, 48
"""Pixels."""
VEHICLE_SHADES = ("#f7fbff", "#c6dbef", "#6baed6", "#2171b5", "#08306b")
LANE_SHADES = ("#ffffff", "#fdd49e", "#fc8d59", "#b30000")
"""From no attention to the most; darker is more, also in grey."""
HALO = "#ffffff"


def draw_attention(shown: AttentionMap, path: Path) -> Path:
    """Write a drawing of a sample's attention; the same numbers give the same bytes.

    Args:
        shown: the sample.
        path: a file that ends in `.svg` or `.png`.

    Raises:
        ValueError: another ending.
    """
    check_suffix(path.suffix)
    path.write_bytes(compose_attention(shown).render(path.suffix))
    return path


def compose_attention(shown: AttentionMap) -> Drawing:
    """The drawing, not yet rendered."""
    tables, picture = Tables(), shown.picture
    lines = [_draw_head(tables, shown, head) for head in range(shown.heads)]
    title = f"What vehicle {picture.own.vehicle_id} of {picture.dataset} {picture.subset} attends to"
    title = f"{title} at {picture.time_s:.1f} s (sample {picture.sample}, {picture.part})"
    explained = [
        f"true maneuver: {picture.lateral}, {picture.longitudinal}. The road: the ego's attention in the encoder to "
        "vehicles, numbered from the nearest to the farthest, and to lanes.",
        "Matrices: every vehicle's attention (a row, which sums to 100 %) to vehicles or lanes (columns). "
        "Driven from left to right; the ego is outlined.",
    ]
    layout = alt.vconcat(*lines, title=alt.Title(title, subtitle=explained, offset=14), spacing=22)
    return Drawing(layout.resolve_scale(color="shared", fill="shared"), tables)


def _shade_vehicles(shown: AttentionMap) -> alt.Color:
    """One scale for all heads and both matrices, so that they can be compared."""
    most = max(float(weights.max(initial=0.01)) for weights in (shown.vehicles, shown.decoder))
    return alt.Color(
        "weight:Q",
        title=["attention", "to vehicles"],
        scale=alt.Scale(domain=[0, most], range=list(VEHICLE_SHADES), interpolate="rgb"),
        legend=alt.Legend(format=".0%", gradientLength=MATRIX_SIZE - 40, tickCount=4),
    )


def _shade_lanes() -> alt.Fill:
    return alt.Fill(
        "weight:Q",
        title=["attention", "to lanes"],
        scale=alt.Scale(domain=[0, 1], range=list(LANE_SHADES), interpolate="rgb"),
        legend=alt.Legend(format=".0%", gradientLength=MATRIX_SIZE - 40, tickCount=4),
    )


def _draw_head(tables: Tables, shown: AttentionMap, head: int) -> alt.HConcatChart:
    return alt.hconcat(
        _draw_road(tables, shown, head),
        _draw_matrix(tables, shown, head, "vehicles", "encoder: vehicles"),
        _draw_matrix(tables, shown, head, "to_lanes", "lanes"),
        _draw_matrix(tables, shown, head, "decoder", "decoder: vehicles"),
        spacing=14,
    )


def _draw_road(tables: Tables, shown: AttentionMap, head: int) -> alt.LayerChart:
    title = alt.Title(f"head {head + 1}: {tell_head(shown, head)}", fontSize=13, fontWeight="normal")
    layers = _layers_of_road(tables, shown, head)
    return alt.LayerChart(layer=layers, title=title).properties(width=ROAD_WIDTH, height=MATRIX_SIZE)


def _layers_of_road(tables: Tables, shown: AttentionMap, head: int) -> list[alt.Chart]:
    (first, last), (leftmost, rightmost) = span_road(shown)
    stretch = (MATRIX_SIZE / (rightmost - leftmost)) / (ROAD_WIDTH / (last - first))
    lowest = head == shown.heads - 1

    def along(field: str) -> alt.X:
        title = f"along the road from the ego (m); across it stretched {stretch:.1f} times" if lowest else None
        scale = alt.Scale(domain=[first, last], nice=False, zero=False)
        return alt.X(f"{field}:Q", title=title, scale=scale, axis=alt.Axis(grid=False, tickCount=10))

    def across(field: str) -> alt.Y:
        scale = alt.Scale(domain=[rightmost, leftmost], nice=False, zero=False)
        return alt.Y(f"{field}:Q", scale=scale, axis=None)

    bands = tables.chart(f"bands {head}", list_bands(shown, head))
    boxes = tables.chart(f"boxes {head}", list_boxes(shown, head))
    area = {"y": across("top_m"), "y2": "bottom_m:Q"}
    box = {"x": along("back_m"), "x2": "front_m:Q", **area}
    names = boxes.encode(x=along("centre_m"), y=across("top_m"), text="told:N")
    return [
        bands.mark_rect(opacity=0.6).encode(x=alt.value(0), x2=alt.value(ROAD_WIDTH), **area, fill=_shade_lanes()),
        tables.chart(f"markings {head}", list_markings(shown))
        .mark_rule(color=MUTED, strokeDash=[10, 8])
        .encode(y=across("y_m")),
        boxes.mark_rect(stroke=MUTED, strokeWidth=1, cornerRadius=2).encode(**box, color=_shade_vehicles(shown)),
        boxes.transform_filter("datum.own")
        .mark_rect(fillOpacity=0, stroke=INK, strokeWidth=2.5, cornerRadius=2)
        .encode(**box),
        bands.mark_text(align="left", color=INK, fontSize=12).encode(
            x=alt.value(ROAD_WIDTH + 6), y=across("middle_m"), text="told:N"
        ),
        names.mark_text(dy=-7, fontSize=12, clip=True, stroke=HALO, strokeWidth=3, strokeJoin="round"),
        names.mark_text(dy=-7, fontSize=12, clip=True, color=INK),
    ]


def _draw_matrix(tables: Tables, shown: AttentionMap, head: int, part: str, title: str) -> alt.Chart:
    lanes = part == "to_lanes"
    columns = list(LANES) if lanes else shown.names
    cells = list_cells(getattr(shown, part)[head], shown.names, columns)
    if lanes:
        there = {row["lane"] for row in list_bands(shown, head)}
        cells = [cell for cell in cells if cell["to"] in there]
    matrix: alt.Chart = (
        tables.chart(f"{part} {head}", cells)
        .mark_rect(stroke=HALO, strokeWidth=0.5)
        .encode(
            x=alt.X("to:N", sort=None, scale=alt.Scale(domain=columns), title=None, axis=_list_names(-90)),
            y=alt.Y("by:N", sort=None, scale=alt.Scale(domain=shown.names), title=None, axis=_list_names(0)),
        )
        .properties(
            width=LANES_WIDTH if lanes else MATRIX_SIZE,
            height=MATRIX_SIZE,
            title=alt.Title(title, fontSize=13, fontWeight="normal"),
        )
    )
    shaded: alt.Chart = matrix.encode(fill=_shade_lanes()) if lanes else matrix.encode(color=_shade_vehicles(shown))
    return shaded


def _list_names(angle: float) -> alt.Axis:
    return alt.Axis(labelAngle=angle, labelFontSize=11, labelPadding=3, ticks=False, domain=False)
