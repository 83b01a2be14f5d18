"""Attention weights of samples, drawn per head: the road with the ego's weights, and the whole matrices."""

from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import altair as alt
import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats
from tracklake.schemas.chart_theme import INK, MUTED, PAPER
from tracklake.schemas.drawings import Drawing, Layers, Row, fix_scale, name_rows
from tracklake.training.data.gathers import NEAREST, find_nearest, gather_nearest
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.plots.picture import Picture, take_picture
from tracklake.training.plots.picture_rows import outline_vehicle

if TYPE_CHECKING:
    from tracklake.training.models.attention import SceneAttention

LANES = ("left", "own", "right")
"""Names of the ego's lane and its neighbors, in the order of the weights; all lanes of a carriageway have numbers."""
ROAD_WIDTH, MATRIX_SIZE, LANES_WIDTH = 590, 165, 48
"""Width of the road, side of a matrix, and width of the matrix of lanes, in pixels."""
VEHICLE_SHADES = ("#f7fbff", "#c6dbef", "#6baed6", "#2171b5", "#08306b")
LANE_SHADES = ("#ffffff", "#fdd49e", "#fc8d59", "#b30000")
"""Colours from no attention to the most; darker is more, also in grey."""
LEAST_MARGIN_M, MARGIN_SHARE, VERGE_M = 6.0, 0.05, 2.5
"""Least margin along the road, its share of the vehicles' extent, and the margin across the road."""


@dataclass(frozen=True)
class AttentionMap:
    """One sample, the n vehicles of its scene, and their attention weights. Vehicle 0 is the ego.

    Args:
        picture: the sample and its scene.
        vehicle_id: n ids, unique within the subset.
        place_m: (n, 2) front centres relative to the ego's: along the road, and across, positive to the right.
        size_m: (n, 2) length and width; 0 where unknown.
        lanes: (M, 3) per lane: the centre's offset in m, the width in m, and 1 where the lane exists.
        lane_names: M names, those of LANES or numbers from the left.
        vehicles: (heads, n, n) weights of the encoder; a row attends to the columns and sums to 1.
        to_lanes: (heads, n, M) weights of the encoder from vehicles to lanes.
        decoder: (heads, n, n) weights of the decoder.
    """

    picture: Picture
    vehicle_id: tuple[int, ...]
    place_m: Floats
    size_m: Floats
    lanes: Floats
    lane_names: tuple[str, ...]
    vehicles: Floats
    to_lanes: Floats
    decoder: Floats

    @property
    def heads(self) -> int:
        """Number of attention heads."""
        return len(self.vehicles)

    @property
    def names(self) -> list[str]:
        """Names of the vehicles: `ego`, then 1, 2, ... from the nearest to the farthest."""
        return ["ego", *map(str, range(1, len(self.vehicle_id)))]

    def to_dict(self) -> dict[str, Any]:
        """Make plain values for JSON; null where a size is unknown."""
        named = ("sample", "part", "split", "dataset", "subset", "time_s", "lateral", "longitudinal")
        return {
            **{name: getattr(self.picture, name) for name in named},
            "heads": self.heads,
            "vehicles": [
                {
                    "name": self.names[number],
                    "vehicle_id": vehicle_id,
                    "along_m": round(float(self.place_m[number, 0]), 3),
                    "across_m": round(float(self.place_m[number, 1]), 3),
                    "length_m": round(float(self.size_m[number, 0]), 3) or None,
                    "width_m": round(float(self.size_m[number, 1]), 3) or None,
                }
                for number, vehicle_id in enumerate(self.vehicle_id)
            ],
            "lanes": [
                {"name": name, "exists": exists > 0, "offset_m": round(offset_m, 3), "width_m": round(width_m, 3)}
                for name, (offset_m, width_m, exists) in zip(self.lane_names, self.lanes.tolist(), strict=True)
            ],
            "attention": {
                "encoder_vehicles": self.vehicles.round(6).tolist(),
                "encoder_lanes": self.to_lanes.round(6).tolist(),
                "decoder_vehicles": self.decoder.round(6).tolist(),
            },
        }


def map_attention(
    folder: TensorFolder, network: "SceneAttention", samples: npt.ArrayLike, *, nearest: int = NEAREST
) -> list[AttentionMap]:
    """Compute the attention of samples (B,) in one batch, of the ego and its nearest vehicles, without padding.

    Raises:
        IndexError: no sample has the number.
    """
    numbers = np.asarray(samples, dtype=np.int64)
    observed, _ = gather_nearest(folder, numbers, nearest=nearest)
    weights, lanes = network.read_attention(observed), network.choose_lanes(observed)
    names = tuple(map(str, range(1, lanes.shape[1] + 1))) if network.lanes == "all" else LANES
    ids = folder.run_vehicle_id[folder.runs_of(find_nearest(folder, numbers, nearest)[0])]
    maps = []
    for row, (sample, present) in enumerate(zip(numbers.tolist(), observed.vehicle_mask.sum(axis=1), strict=True)):
        there = slice(int(present))  # padding comes last
        maps.append(
            AttentionMap(
                picture=take_picture(folder, sample, {}),
                vehicle_id=tuple(ids[row, there].tolist()),
                place_m=observed.history[row, there, -1].astype(np.float64),
                size_m=observed.size_m[row, there].astype(np.float64),
                lanes=lanes[row].astype(np.float64),
                lane_names=names,
                vehicles=weights.vehicles[row, :, there, there].astype(np.float64),
                to_lanes=weights.lanes[row, :, there].astype(np.float64),
                decoder=weights.decoder[row, :, there, there].astype(np.float64),
            )
        )
    return maps


def draw_attention(shown: AttentionMap) -> Drawing:
    """Draw a sample's attention, one line of charts per head."""
    picture, heads = shown.picture, range(shown.heads)
    rows = {
        "markings": [{"y_m": border_m} for border_m in _list_borders(shown)],
        "bands": [row for head in heads for row in list_bands(shown, head)],
        "boxes": [row for head in heads for row in list_boxes(shown, head)],
        "weights": [row for head in heads for row in list_weights(shown, head)],
    }
    title = f"Attention of vehicle {picture.own.vehicle_id} of {picture.place}"
    title = f"{title} at {picture.time_s:.1f} s (sample {picture.sample}, {picture.part})"
    subtitle = [
        f"true maneuver: {picture.lateral}, {picture.longitudinal}. The road: the ego's attention in the encoder to "
        "vehicles, numbered from the nearest to the farthest, and to lanes.",
        "Matrices: every vehicle's attention (a row, which sums to 100 %) to vehicles or lanes (columns). "
        "Direction of travel: left to right; the ego is outlined.",
    ]
    lines = [
        alt.hconcat(
            _draw_road(shown, head),
            _draw_matrix(shown, head, "vehicles", "encoder: vehicles"),
            _draw_matrix(shown, head, "lanes", "lanes"),
            _draw_matrix(shown, head, "decoder", "decoder: vehicles"),
            spacing=14,
        )
        for head in heads
    ]
    layout = alt.vconcat(*lines, title=alt.Title(title, subtitle=subtitle, offset=14), spacing=22)
    return Drawing(layout.resolve_scale(color="shared", fill="shared"), rows)


def describe_head(shown: AttentionMap, head: int) -> str:
    """Describe what the ego attends to most in a head."""

    def name_most(weights: Floats) -> str:
        most = int(weights.argmax())
        return f"{'itself' if most == 0 else f'vehicle {most}'} ({weights[most]:.0%})"

    lane, lanes = "no lane, as none is known", shown.to_lanes[head, 0]
    if lanes.sum() > 0:
        most = int(lanes.argmax())
        name = shown.lane_names[most]
        lane = f"{f'the {name} lane' if name in LANES else f'lane {name}'} ({lanes[most]:.0%})"
    encoder, decoder = name_most(shown.vehicles[head, 0]), name_most(shown.decoder[head, 0])
    return f"the ego attends most to {encoder} and {lane}; in the decoder to {decoder}"


def _list_borders(shown: AttentionMap) -> list[float]:
    """List the lanes' borders relative to the ego in m."""
    own_m = float(shown.picture.own.history_m[-1, 1])
    return [border_m - own_m for border_m in shown.picture.markings_m]


def list_bands(shown: AttentionMap, head: int) -> list[Row]:
    """List lanes that exist: borders relative to the ego in m, and the ego's attention."""
    weights = shown.to_lanes[head, 0].tolist()
    return [
        {
            "head": head,
            "lane": lane,
            "left_m": offset_m - width_m / 2,
            "right_m": offset_m + width_m / 2,
            "middle_m": offset_m,
            "weight": weight,
            "label": f"{lane} ({weight:.0%})",
        }
        for lane, (offset_m, width_m, exists), weight in zip(
            shown.lane_names, shown.lanes.tolist(), weights, strict=True
        )
        if exists
    ]


def list_boxes(shown: AttentionMap, head: int) -> list[Row]:
    """List vehicles: the box relative to the ego's front in m, the name, and the ego's attention."""
    weights, sizes_m = shown.vehicles[head, 0].tolist(), shown.size_m.tolist()
    return [
        {"head": head, "own": name == shown.names[0], "weight": weight, "label": f"{name} ({weight:.0%})"}
        | outline_vehicle(place_m, *size_m)
        for name, weight, place_m, size_m in zip(shown.names, weights, shown.place_m, sizes_m, strict=True)
    ]


def list_weights(shown: AttentionMap, head: int) -> list[Row]:
    """List the weights of a head's three matrices, with the names of row and column; only of lanes that exist."""
    vehicles = [*enumerate(shown.names)]
    lanes = [(number, name) for number, name in enumerate(shown.lane_names) if shown.lanes[number, 2]]
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
    boxes, borders = list_boxes(shown, 0), _list_borders(shown)
    first, last = min(box["back_m"] for box in boxes), max(box["front_m"] for box in boxes)
    margin = max(LEAST_MARGIN_M, MARGIN_SHARE * (last - first))
    leftmost = min([*borders, *(box["left_m"] for box in boxes)])
    rightmost = max([*borders, *(box["right_m"] for box in boxes)])
    return (first - margin, last + margin), (leftmost - VERGE_M, rightmost + VERGE_M)


def _draw_road(shown: AttentionMap, head: int) -> Layers:
    """Draw lanes and vehicles, shaded by the ego's attention."""
    (first, last), (leftmost, rightmost) = choose_extent(shown)
    stretch = (MATRIX_SIZE / (rightmost - leftmost)) / (ROAD_WIDTH / (last - first))
    title = f"along the road from the ego (m); across it stretched {stretch:.1f} times"
    along = partial(
        alt.X,
        title=title if head == shown.heads - 1 else None,
        scale=fix_scale(first, last),
        axis=alt.Axis(grid=False, tickCount=10),
    )
    across = partial(alt.Y, scale=fix_scale(rightmost, leftmost), axis=None)
    bands, boxes = (name_rows(name, f"datum.head === {head}") for name in ("bands", "boxes"))
    ego = boxes.transform_filter("datum.own")
    area = {"y": across("left_m:Q"), "y2": "right_m:Q"}
    box = {"x": along("back_m:Q"), "x2": "front_m:Q", **area}
    middles = boxes.transform_calculate(centre_m="(datum.back_m + datum.front_m) / 2")
    names = middles.encode(x=along("centre_m:Q"), y=across("left_m:Q"), text="label:N")
    name = partial(names.mark_text, dy=-7, fontSize=12, clip=True)
    return alt.layer(
        bands.mark_rect(opacity=0.6).encode(
            x=alt.value(0), x2=alt.value(ROAD_WIDTH), **area, **_shade(shown, lanes=True)
        ),
        name_rows("markings").mark_rule(color=MUTED, strokeDash=[10, 8]).encode(y=across("y_m:Q")),
        boxes.mark_rect(stroke=MUTED, strokeWidth=1, cornerRadius=2).encode(**box, **_shade(shown, lanes=False)),
        ego.mark_rect(fillOpacity=0, stroke=INK, strokeWidth=2.5, cornerRadius=2).encode(**box),
        bands.mark_text(align="left", color=INK, fontSize=12).encode(
            x=alt.value(ROAD_WIDTH + 6), y=across("middle_m:Q"), text="label:N"
        ),
        name(stroke=PAPER, strokeWidth=3, strokeJoin="round"),
        name(color=INK),
        title=_make_title(f"head {head + 1}: {describe_head(shown, head)}"),
        width=ROAD_WIDTH,
        height=MATRIX_SIZE,
    )


def _draw_matrix(shown: AttentionMap, head: int, matrix: str, title: str) -> alt.Chart:
    lanes = matrix == "lanes"
    axis = partial(alt.Axis, labelFontSize=11, labelPadding=3, ticks=False, domain=False)
    columns = alt.Scale(domain=list(shown.lane_names) if lanes else shown.names)
    chart: alt.Chart = (
        name_rows("weights", f"datum.head === {head}", f"datum.matrix === '{matrix}'")
        .mark_rect(stroke=PAPER, strokeWidth=0.5)
        .encode(
            x=alt.X("to:N", scale=columns, axis=axis(labelAngle=-90), sort=None, title=None),
            y=alt.Y("by:N", scale=alt.Scale(domain=shown.names), axis=axis(labelAngle=0), sort=None, title=None),
            **_shade(shown, lanes=lanes),
        )
        .properties(width=LANES_WIDTH if lanes else MATRIX_SIZE, height=MATRIX_SIZE, title=_make_title(title))
    )
    return chart


def _make_title(text: str) -> alt.Title:
    return alt.Title(text, fontSize=13, fontWeight="normal")


def _shade(shown: AttentionMap, *, lanes: bool) -> dict[str, alt.Fill | alt.Color]:
    """Make the channel of weights, with one scale for all heads and matrices."""
    most = 1 if lanes else max(float(weights.max(initial=0.01)) for weights in (shown.vehicles, shown.decoder))
    shades = LANE_SHADES if lanes else VEHICLE_SHADES
    how: Row = {
        "title": ["attention", "to lanes" if lanes else "to vehicles"],
        "scale": alt.Scale(domain=[0, most], range=list(shades), interpolate="rgb"),
        "legend": alt.Legend(orient="right", format=".0%", gradientLength=MATRIX_SIZE - 40, tickCount=4),
    }
    return {"fill": alt.Fill("weight:Q", **how)} if lanes else {"color": alt.Color("weight:Q", **how)}
