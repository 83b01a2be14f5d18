"""The drawing of a sample's attention: per head the road with the ego's weights, and the whole matrices."""

import json
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import altair as alt
import numpy.typing as npt

from tracklake.schemas.chart_theme import INK, MUTED, PAPER
from tracklake.schemas.files import write_file
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.plots.attention_maps import LANES, AttentionMap, map_attention
from tracklake.training.plots.charts import Drawing, Row
from tracklake.training.plots.forecasts import Doubles
from tracklake.training.plots.picture_rows import UNKNOWN_SIZE_M

if TYPE_CHECKING:
    from tracklake.training.models.attention import SceneAttention

ROAD_WIDTH, MATRIX_SIZE, LANES_WIDTH = 590, 165, 48
"""Width of the road, side of a matrix, and width of the matrix of lanes, in pixels."""
VEHICLE_SHADES = ("#f7fbff", "#c6dbef", "#6baed6", "#2171b5", "#08306b")
LANE_SHADES = ("#ffffff", "#fdd49e", "#fc8d59", "#b30000")
"""Colours from no attention to the most; darker is more, also in grey."""
LEAST_MARGIN_M, MARGIN_SHARE, VERGE_M = 6.0, 0.05, 2.5
"""Least margin along the road, its share of the vehicles' extent, and the margin across the road."""


def export_attention(
    folder: TensorFolder,
    network: "SceneAttention",
    samples: npt.ArrayLike,
    out_dir: Path,
) -> list[Path]:
    """Write a drawing and a JSON table per sample; files of the same names are replaced.

    Args:
        folder: tensors.
        network: a network with attention.
        samples: (B,) sample numbers.
        out_dir: folder of the files, created if missing.

    Returns:
        Drawing and table of the first sample, of the second ...

    Raises:
        IndexError: no sample has the number.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    written = []
    for shown in map_attention(folder, network, samples):
        picture = shown.picture
        name = f"{picture.subset}_{picture.own.vehicle_id}_{picture.time_s:.1f}s_attention"
        drawing, table = out_dir / f"{name}.svg", out_dir / f"{name}.json"
        write_file(drawing, draw_attention(shown).render(drawing.suffix))
        write_file(table, json.dumps(shown.to_dict(), indent=1, allow_nan=False).encode() + b"\n")
        written += [drawing, table]
    return written


def draw_attention(shown: AttentionMap) -> Drawing:
    """Draw a sample's attention, one line of charts per head."""
    picture, heads = shown.picture, range(shown.heads)
    rows = {
        "markings": list_markings(shown),
        "bands": [row for head in heads for row in list_bands(shown, head)],
        "boxes": [row for head in heads for row in list_boxes(shown, head)],
        "weights": [row for head in heads for row in list_weights(shown, head)],
    }
    title = f"Attention of vehicle {picture.own.vehicle_id} of {picture.dataset} {picture.subset}"
    title = f"{title} at {picture.time_s:.1f} s (sample {picture.sample}, {picture.part})"
    subtitle = [
        f"true maneuver: {picture.lateral}, {picture.longitudinal}. The road: the ego's attention in the encoder to "
        "vehicles, numbered from the nearest to the farthest, and to lanes.",
        "Matrices: every vehicle's attention (a row, which sums to 100 %) to vehicles or lanes (columns). "
        "Direction of travel: left to right; the ego is outlined.",
    ]
    lines = [_draw_head(shown, head) for head in heads]
    layout = alt.vconcat(*lines, title=alt.Title(title, subtitle=subtitle, offset=14), spacing=22)
    return Drawing(layout.resolve_scale(color="shared", fill="shared"), rows)


def describe_head(shown: AttentionMap, head: int) -> str:
    """Describe what the ego attends to most in a head."""

    def name_most(weights: Doubles) -> str:
        most = int(weights.argmax())
        return f"{'itself' if most == 0 else f'vehicle {most}'} ({weights[most]:.0%})"

    lanes = shown.to_lanes[head, 0]
    most = int(lanes.argmax())
    lane = f"the {LANES[most]} lane ({lanes[most]:.0%})" if lanes.sum() > 0 else "no lane, as none is known"
    encoder, decoder = name_most(shown.vehicles[head, 0]), name_most(shown.decoder[head, 0])
    return f"the ego attends most to {encoder} and {lane}; in the decoder to {decoder}"


def list_markings(shown: AttentionMap) -> list[Row]:
    """List lane borders: y_m relative to the ego."""
    own_m = float(shown.picture.own.history_m[-1, 1])
    return [{"y_m": border - own_m} for border in shown.picture.markings_m]


def list_bands(shown: AttentionMap, head: int) -> list[Row]:
    """List lanes that exist: borders relative to the ego in m, and the ego's attention."""
    weights = shown.to_lanes[head, 0].tolist()
    return [
        {
            "head": head,
            "lane": lane,
            "top_m": offset_m - width_m / 2,
            "bottom_m": offset_m + width_m / 2,
            "middle_m": offset_m,
            "weight": weight,
            "label": f"{lane} ({weight:.0%})",
        }
        for lane, (offset_m, width_m, exists), weight in zip(LANES, shown.lanes.tolist(), weights, strict=True)
        if exists
    ]


def list_boxes(shown: AttentionMap, head: int) -> list[Row]:
    """List vehicles: the box relative to the ego's front in m, the name, and the ego's attention."""
    rows = []
    weights, places, sizes = (array.tolist() for array in (shown.vehicles[head, 0], shown.place_m, shown.size_m))
    for name, weight, (front_m, middle_m), size_m in zip(shown.names, weights, places, sizes, strict=True):
        length_m, width_m = size_m if all(size_m) else UNKNOWN_SIZE_M
        rows.append(
            {
                "head": head,
                "own": name == shown.names[0],
                "back_m": front_m - length_m,
                "front_m": front_m,
                "centre_m": front_m - length_m / 2,
                "top_m": middle_m - width_m / 2,
                "bottom_m": middle_m + width_m / 2,
                "weight": weight,
                "label": f"{name} ({weight:.0%})",
            }
        )
    return rows


def list_weights(shown: AttentionMap, head: int) -> list[Row]:
    """List the weights of a head's three matrices, with the names of row and column; only of lanes that exist."""
    vehicles, lanes = [*enumerate(shown.names)], [lane for lane in enumerate(LANES) if shown.lanes[lane[0], 2]]
    matrices = (
        ("vehicles", shown.vehicles, vehicles),
        ("lanes", shown.to_lanes, lanes),
        ("decoder", shown.decoder, vehicles),
    )
    return [
        {"head": head, "matrix": matrix, "by": by, "to": to, "weight": float(weights[head, row, column])}
        for matrix, weights, columns in matrices
        for (row, by), (column, to) in product(vehicles, columns)
    ]


def choose_extent(shown: AttentionMap) -> tuple[tuple[float, float], tuple[float, float]]:
    """Choose the road that is drawn, in m from the ego: (first, last) along it, (leftmost, rightmost) across it."""
    boxes, borders = list_boxes(shown, 0), [row["y_m"] for row in list_markings(shown)]
    first, last = min(box["back_m"] for box in boxes), max(box["front_m"] for box in boxes)
    margin = max(LEAST_MARGIN_M, MARGIN_SHARE * (last - first))
    top, bottom = [box["top_m"] for box in boxes], [box["bottom_m"] for box in boxes]
    return (first - margin, last + margin), (min([*top, *borders]) - VERGE_M, max([*bottom, *borders]) + VERGE_M)


def _draw_head(shown: AttentionMap, head: int) -> alt.HConcatChart:
    road = alt.layer(*_draw_road(shown, head))
    return alt.hconcat(
        road.properties(
            width=ROAD_WIDTH, height=MATRIX_SIZE, title=_title(f"head {head + 1}: {describe_head(shown, head)}")
        ),
        _draw_matrix(shown, head, "vehicles", "encoder: vehicles"),
        _draw_matrix(shown, head, "lanes", "lanes"),
        _draw_matrix(shown, head, "decoder", "decoder: vehicles"),
        spacing=14,
    )


def _title(text: str) -> alt.Title:
    return alt.Title(text, fontSize=13, fontWeight="normal")


def _chart(name: str, head: int) -> alt.Chart:
    return alt.Chart(alt.NamedData(name)).transform_filter(f"datum.head === {head}")


def _shade_vehicles(shown: AttentionMap) -> alt.Color:
    """Make one scale for all heads and both matrices."""
    most = max(float(weights.max(initial=0.01)) for weights in (shown.vehicles, shown.decoder))
    scale = alt.Scale(domain=[0, most], range=list(VEHICLE_SHADES), interpolate="rgb")
    return alt.Color("weight:Q", title=["attention", "to vehicles"], scale=scale, legend=_LEGEND)


def _shade_lanes() -> alt.Fill:
    scale = alt.Scale(domain=[0, 1], range=list(LANE_SHADES), interpolate="rgb")
    return alt.Fill("weight:Q", title=["attention", "to lanes"], scale=scale, legend=_LEGEND)


_LEGEND = alt.Legend(orient="right", format=".0%", gradientLength=MATRIX_SIZE - 40, tickCount=4)


def _draw_road(shown: AttentionMap, head: int) -> Iterator[alt.Chart]:
    (first, last), (leftmost, rightmost) = choose_extent(shown)
    stretch = (MATRIX_SIZE / (rightmost - leftmost)) / (ROAD_WIDTH / (last - first))
    title = f"along the road from the ego (m); across it stretched {stretch:.1f} times"

    def along(field: str) -> alt.X:
        scale = alt.Scale(domain=[first, last], nice=False, zero=False)
        axis = alt.Axis(grid=False, tickCount=10)
        return alt.X(f"{field}:Q", title=title if head == shown.heads - 1 else None, scale=scale, axis=axis)

    def across(field: str) -> alt.Y:
        scale = alt.Scale(domain=[rightmost, leftmost], nice=False, zero=False)
        return alt.Y(f"{field}:Q", scale=scale, axis=None)

    bands, boxes = _chart("bands", head), _chart("boxes", head)
    area = {"y": across("top_m"), "y2": "bottom_m:Q"}
    box = {"x": along("back_m"), "x2": "front_m:Q", **area}
    names = boxes.encode(x=along("centre_m"), y=across("top_m"), text="label:N")
    yield bands.mark_rect(opacity=0.6).encode(x=alt.value(0), x2=alt.value(ROAD_WIDTH), **area, fill=_shade_lanes())
    yield alt.Chart(alt.NamedData("markings")).mark_rule(color=MUTED, strokeDash=[10, 8]).encode(y=across("y_m"))
    yield boxes.mark_rect(stroke=MUTED, strokeWidth=1, cornerRadius=2).encode(**box, color=_shade_vehicles(shown))
    ego = boxes.transform_filter("datum.own")
    yield ego.mark_rect(fillOpacity=0, stroke=INK, strokeWidth=2.5, cornerRadius=2).encode(**box)
    beside = bands.mark_text(align="left", color=INK, fontSize=12)
    yield beside.encode(x=alt.value(ROAD_WIDTH + 6), y=across("middle_m"), text="label:N")
    yield names.mark_text(dy=-7, fontSize=12, clip=True, stroke=PAPER, strokeWidth=3, strokeJoin="round")
    yield names.mark_text(dy=-7, fontSize=12, clip=True, color=INK)


def _draw_matrix(shown: AttentionMap, head: int, matrix: str, title: str) -> alt.Chart:
    lanes = matrix == "lanes"
    columns = alt.Scale(domain=list(LANES) if lanes else shown.names)
    chart: alt.Chart = (
        _chart("weights", head)
        .transform_filter(f"datum.matrix === '{matrix}'")
        .mark_rect(stroke=PAPER, strokeWidth=0.5)
        .encode(
            x=alt.X("to:N", scale=columns, axis=_name_axis(-90), sort=None, title=None),
            y=alt.Y("by:N", scale=alt.Scale(domain=shown.names), axis=_name_axis(0), sort=None, title=None),
        )
        .properties(width=LANES_WIDTH if lanes else MATRIX_SIZE, height=MATRIX_SIZE, title=_title(title))
    )
    shaded: alt.Chart = chart.encode(fill=_shade_lanes()) if lanes else chart.encode(color=_shade_vehicles(shown))
    return shaded


def _name_axis(angle: float) -> alt.Axis:
    return alt.Axis(labelAngle=angle, labelFontSize=11, labelPadding=3, ticks=False, domain=False)
