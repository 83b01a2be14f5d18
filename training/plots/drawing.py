"""The drawing of a picture: the road with everything on it, and beneath it how far models are from the truth."""

from dataclasses import dataclass

import altair as alt

from tracklake.training.plots.charts import INK, MUTED, Drawing, Layers, Row, Tables
from tracklake.training.plots.key import BOX_COLOURS, DASHES, MODEL_COLOURS, draw_key, mark_models
from tracklake.training.plots.labels import list_odds
from tracklake.training.plots.picture import Picture
from tracklake.training.plots.rows import (
    View,
    choose_view,
    list_alternatives,
    list_boxes,
    list_ellipses,
    list_errors,
    list_histories,
    list_lanes,
    list_markings,
    list_predictions,
    list_truths,
)

MOST_MODELS = len(MODEL_COLOURS)

WIDTH = 1060
"""Pixels of the road; with the labels around it the drawing is about 1200 wide."""
LANE_PIXELS = 54
LEAST_HEIGHT, MOST_HEIGHT = 170, 400
"""Of the road, in pixels."""
ERROR_HEIGHT, ERROR_GAP = 170, 50
ASPHALT, LANE_LINE, HALO = "#f3f4f6", "#8c959f", "#ffffff"

ELLIPSES = (
    ("!datum.own", 0.8, 0.5, 0.02),
    ("datum.own && datum.sigmas === 3", 0.8, 0.9, 0.06),
    ("datum.own && datum.sigmas === 1", 1.2, 0.9, 0.16),
)
"""Which they are, their outline's width and opacity, and that of what they enclose."""

_COLOUR = alt.Color("colour:N", scale=None, legend=None)
_SHAPE = alt.Shape("shape:N", scale=None, legend=None)


def draw_picture(picture: Picture) -> Drawing:
    """The whole drawing. Numbers are those of `Picture`; the same picture gives the same bytes.

    Raises:
        ValueError: more than MOST_MODELS models, or none.
    """
    models = picture.models
    if not 1 <= len(models) <= MOST_MODELS:
        raise ValueError(f"a drawing shows 1 to {MOST_MODELS} models, got {len(models)}: {', '.join(models)}")
    view, tables = choose_view(picture), Tables()
    layout = alt.vconcat(
        draw_key(tables, picture, view, WIDTH),
        draw_road(tables, picture, view),
        draw_errors(tables, picture),
        title=alt.Title(name_picture(picture), subtitle=list(tell_maneuvers(picture)), offset=14),
        spacing=18,
    )
    return Drawing(layout, tables)


def name_picture(picture: Picture) -> str:
    """The drawing's title: which vehicle, where and when."""
    of = f"{picture.dataset} {picture.subset}, vehicle {picture.own.vehicle_id} at {picture.time_s:.1f} s"
    return f"{of} (sample {picture.sample}, {picture.part})"


def tell_maneuvers(picture: Picture) -> tuple[str, ...]:
    """The lines beneath the title: the true maneuvers, and how probable models find them."""
    lines = [f"true maneuver: {picture.lateral}, {picture.longitudinal}"]
    for said in picture.own.forecasts:
        odds = [*(said.lateral or {}).items(), *(said.longitudinal or {}).items()]
        if odds:
            lines.append(f"{said.model}: " + ", ".join(f"{name} {share:.0%}" for name, share in odds))
    return tuple(lines)


@dataclass(frozen=True)
class _Axes:
    """The road's: along it from left to right, across it downwards.

    Args:
        view: what they span.
        height: of the road in pixels; its width is WIDTH.
        title: of the axis across.
    """

    view: View
    height: int
    title: list[str]

    def pixels_x_m(self, pixels: float) -> float:
        """How far that is along the road."""
        return (self.view.last_x_m - self.view.first_x_m) * pixels / WIDTH

    def pixels_y_m(self, pixels: float) -> float:
        """How far that is across it."""
        return (self.view.last_y_m - self.view.first_y_m) * pixels / self.height

    def along(self, field: str = "x_m") -> alt.X:
        """Places along the road."""
        return alt.X(
            f"{field}:Q",
            title="along the road (m)",
            scale=alt.Scale(domain=[self.view.first_x_m, self.view.last_x_m], nice=False, zero=False),
            axis=alt.Axis(grid=False, tickCount=10, offset=4),
        )

    def across(self, field: str = "y_m") -> alt.Y:
        """Places across the road."""
        return alt.Y(
            f"{field}:Q",
            title=self.title,
            scale=alt.Scale(domain=[self.view.last_y_m, self.view.first_y_m], nice=False, zero=False),
            axis=alt.Axis(grid=False, tickCount=5, offset=4),
        )


def draw_road(tables: Tables, picture: Picture, view: View) -> Layers:
    """The road seen from above, driven from left to right, the driver's right at the bottom."""
    across_m = view.last_y_m - view.first_y_m
    lanes = len(picture.markings_m) - 1
    height = min(
        max(LANE_PIXELS * lanes * across_m / (picture.markings_m[-1] - picture.markings_m[0]), LEAST_HEIGHT),
        MOST_HEIGHT,
    )
    stretch = (height / across_m) / (WIDTH / (view.last_x_m - view.first_x_m))
    axes = _Axes(view, round(height), ["across the road (m)", f"stretched {stretch:.1f} times"])
    layers = [
        *_layers_of_road(tables, picture, axes),
        *_layers_of_vehicles(tables, picture, axes),
        *_layers_of_predictions(tables, picture, axes),
    ]
    return alt.layer(*layers).properties(width=WIDTH, height=axes.height)


def _layers_of_road(tables: Tables, picture: Picture, axes: _Axes) -> list[alt.Chart]:
    past, x, y = WIDTH - 6, axes.along(), axes.across()
    ends = {"x_m": axes.view.first_x_m, "to_x_m": axes.view.last_x_m}
    edges = {"y_m": picture.markings_m[0], "to_y_m": picture.markings_m[-1]}
    markings = tables.chart("markings", list_markings(picture)).encode(y=y)
    arrow = tables.chart("travel", [{"told": "direction of travel"}])
    lanes = "" if picture.marked else "lanes of 12 ft, as no markings are known"
    return [
        tables.chart("road", [{**ends, **edges}])
        .mark_rect(color=ASPHALT)
        .encode(x=x, x2="to_x_m:Q", y=y, y2="to_y_m:Q"),
        markings.transform_filter("datum.edge").mark_rule(color=MUTED, strokeWidth=2),
        markings.transform_filter("!datum.edge").mark_rule(color=LANE_LINE, strokeWidth=1.5, strokeDash=[14, 12]),
        tables.chart("lanes", list_lanes(picture))
        .mark_text(align="left", dx=10, color=MUTED, fontSize=13)
        .encode(x=alt.value(WIDTH), y=y, text="lane:N"),
        arrow.mark_text(align="right", dx=-44, color=MUTED, fontSize=13).encode(
            x=alt.value(past), y=alt.value(-9), text="told:N"
        ),
        arrow.mark_rule(color=MUTED, strokeWidth=1.5).encode(
            x=alt.value(past - 36), x2=alt.value(past), y=alt.value(-9)
        ),
        arrow.mark_point(shape="triangle-right", filled=True, color=MUTED, size=70, opacity=1).encode(
            x=alt.value(past), y=alt.value(-9)
        ),
        tables.chart("nominal", [{"told": lanes}])
        .mark_text(align="left", color=MUTED, fontSize=13)
        .encode(x=alt.value(0), y=alt.value(-9), text="told:N"),
    ]


def _layers_of_vehicles(tables: Tables, picture: Picture, axes: _Axes) -> list[alt.Chart]:
    x, y = axes.along(), axes.across()
    paths = [{**row, "colour": BOX_COLOURS[row["role"]]} for row in list_histories(picture, axes.view)]
    boxes = [{**row, "colour": BOX_COLOURS[row["role"]]} for row in list_boxes(picture, axes.view)]
    for box in boxes:
        box["fill"], box["edge"] = (box["colour"], HALO) if box["known"] else ("transparent", box["colour"])
    histories = tables.chart("histories", paths).encode(x=x, y=y, color=_COLOUR)
    return [
        histories.mark_line(strokeWidth=1.5, clip=True).encode(detail="vehicle_id:N", order="tick:Q"),
        tables.chart("boxes", boxes)
        .mark_rect(strokeWidth=1, cornerRadius=2, clip=True)
        .encode(
            x=axes.along("back_m"),
            x2="front_m:Q",
            y=axes.across("left_m"),
            y2="right_m:Q",
            fill=alt.Fill("fill:N", scale=None, legend=None),
            stroke=alt.Stroke("edge:N", scale=None, legend=None),
        ),
        histories.transform_filter("datum.role === 'own'").mark_point(filled=True, size=22, opacity=1, clip=True),
    ]


def _layers_of_predictions(tables: Tables, picture: Picture, axes: _Axes) -> list[alt.Chart]:
    marks, x, y = mark_models(picture), axes.along(), axes.across()

    def of(name: str, rows: list[Row]) -> alt.Chart:
        return tables.chart(name, ({**row, **marks[row["model"]]} for row in rows)).encode(x=x, y=y, color=_COLOUR)

    ellipses = of("ellipses", list_ellipses(picture)).encode(
        detail="ellipse:N", order="order:Q", fill=alt.Fill("colour:N", scale=None, legend=None)
    )
    truths = tables.chart("truths", list_truths(picture)).encode(x=x, y=y)
    predictions = of("predictions", list_predictions(picture))
    odds = of("odds", list_odds(picture, axes.view, step_x_m=axes.pixels_x_m(26), step_y_m=axes.pixels_y_m(16)))
    label = odds.encode(text="told:N")
    thinner = alt.condition("datum.own", alt.value(2), alt.value(1.2))
    return [
        *(
            ellipses.transform_filter(shown).mark_line(
                interpolate="linear-closed", strokeWidth=stroke, strokeOpacity=opacity, fillOpacity=fill, clip=True
            )
            for shown, stroke, opacity, fill in ELLIPSES
        ),
        truths.mark_line(color=INK, strokeDash=DASHES, clip=True).encode(
            detail="vehicle_id:N", order="tick:Q", strokeWidth=thinner
        ),
        truths.transform_filter("datum.own && datum.second").mark_point(
            color=INK, filled=False, size=60, strokeWidth=1.6, opacity=1, clip=True
        ),
        of("alternatives", list_alternatives(picture))
        .mark_line(strokeWidth=1.4, opacity=0.55, clip=True)
        .encode(detail=["model:N", "number:Q"], order="tick:Q"),
        predictions.mark_line(clip=True).encode(
            detail=["model:N", "vehicle_id:N"], order="tick:Q", strokeWidth=thinner
        ),
        predictions.transform_filter("datum.own && datum.second")
        .mark_point(filled=True, size=55, opacity=1, clip=True)
        .encode(shape=_SHAPE),
        odds.mark_rule(strokeWidth=0.8, opacity=0.7).encode(x2="end_x_m:Q", y2="end_y_m:Q"),
        label.mark_text(align="left", dx=3, fontSize=13, stroke=HALO, strokeWidth=4, strokeJoin="round"),
        label.mark_text(align="left", dx=3, fontSize=13),
    ]


ERRORS = (
    ("distance_m", "distance from the truth (m)"),
    ("along_m", "predicted \N{MINUS SIGN} true, along the road (m)"),
    ("across_m", "predicted \N{MINUS SIGN} true, across the road (m)"),
)
"""What is drawn of errors, and its title."""


def draw_errors(tables: Tables, picture: Picture) -> alt.HConcatChart:
    """Errors over time: distances, and along and across the road with the deviation that the model itself gives."""
    marks = mark_models(picture)
    rows = [{**row, **marks[row["model"]], "stroke": 2 if row["own"] else 0.7} for row in list_errors(picture)]
    everything = tables.chart("errors", rows)
    banded = {row["model"] for row in rows if row["along_sigma_m"] is not None}
    return alt.hconcat(*(_draw_error(everything, *one, bool(banded)) for one in ERRORS), spacing=ERROR_GAP)


def _draw_error(everything: alt.Chart, of: str, title: str, banded: bool) -> Layers:
    x = alt.X(
        "seconds:Q",
        title="seconds ahead",
        axis=alt.Axis(tickMinStep=1, grid=False, labelFlush=False),
        scale=alt.Scale(domainMin=0, nice=False),
    )
    axis = alt.Axis(tickCount=5, grid=True)

    def value(field: str) -> alt.Y:
        return alt.Y(f"{field}:Q", title=None, axis=axis, scale=alt.Scale(zero=True))

    base, once = everything.encode(x=x, y=value(of), color=_COLOUR), alt.Chart(alt.NamedData("road"))
    layers = [
        base.mark_line(clip=True).encode(
            detail=["model:N", "vehicle_id:N"],
            strokeWidth=alt.StrokeWidth("stroke:Q", scale=None, legend=None),
            order="seconds:Q",
        ),
        base.transform_filter("datum.own && abs(datum.seconds - round(datum.seconds)) < 1e-6")
        .mark_point(filled=True, size=45, opacity=1)
        .encode(shape=_SHAPE),
    ]
    if of != "distance_m":
        layers.insert(0, once.mark_rule(color=MUTED).encode(y=alt.YDatum(0, title=None, axis=axis)))
    if of != "distance_m" and banded:
        sigma = of.removesuffix("_m") + "_sigma_m"
        band = (
            base.transform_filter(f"datum.own && isValid(datum.{sigma})")
            .transform_calculate(low=f"datum.{of} - datum.{sigma}", high=f"datum.{of} + datum.{sigma}")
            .mark_area(opacity=0.15)
            .encode(y=value("low"), y2="high:Q", detail="model:N")
        )
        layers.insert(0, band)
        title += ", \N{PLUS-MINUS SIGN} sigma"
    layers.append(
        once.mark_text(align="left", text=title, color=INK, fontSize=13).encode(x=alt.value(0), y=alt.value(-14))
    )
    return alt.layer(*layers).properties(width=(WIDTH - 2 * ERROR_GAP) // 3, height=ERROR_HEIGHT)
