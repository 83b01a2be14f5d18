"""The drawing of a picture: the road with its vehicles and predictions, and the models' errors below."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import altair as alt

from tracklake.schemas.chart_theme import BLUE, GREEN, INK, MUTED, ORANGE, PAPER, PURPLE
from tracklake.schemas.errors import UsageError
from tracklake.training.plots.charts import Drawing, Layers
from tracklake.training.plots.picture import Picture
from tracklake.training.plots.picture_rows import (
    View,
    choose_view,
    list_boxes,
    list_ellipses,
    list_errors,
    list_lanes,
    list_markings,
    list_paths,
    list_probabilities,
)

MODEL_COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
MODEL_SHAPES = ("circle", "square", "diamond", "triangle-up")
MOST_MODELS = len(MODEL_COLOURS)
"""Most models in a drawing."""
ROLES = {"own": INK, "neighbor": "#8c959f", "other": "#d0d7de"}
"""Colours of vehicles by role."""
ASPHALT, LANE_LINE = "#f3f4f6", "#8c959f"
SOLID, TRUTH_DASH, LANE_DASH = [1, 0], [6, 4], [14, 12]
HALO: dict[str, Any] = {"stroke": PAPER, "strokeWidth": 4, "strokeJoin": "round"}
"""Outline of text that stands on lines."""

WIDTH = 1060
"""Width of the road, in pixels."""
LANE_HEIGHT, LEAST_HEIGHT, MOST_HEIGHT = 54, 170, 400
"""Height of a lane, and bounds of the road's height, in pixels."""
LEGEND_SYMBOL, LEGEND_LETTER = 40, 7
"""Width of a legend's symbol with its margins, and of a letter, in pixels."""
ERROR_HEIGHT, ERROR_GAP = 170, 50
"""Height of an error panel, and the space between panels, in pixels."""
ERRORS = (
    ("distance_m", None, "distance from the truth (m)"),
    ("along_m", "along_sigma_m", "predicted \N{MINUS SIGN} true, along the road (m)"),
    ("across_m", "across_sigma_m", "predicted \N{MINUS SIGN} true, across the road (m)"),
)
"""Columns of errors and of their standard deviations, and the panels' titles."""


def draw_picture(picture: Picture) -> Drawing:
    """Draw a sample.

    Raises:
        UsageError: no model, or more than MOST_MODELS.
    """
    models = picture.models
    if not 1 <= len(models) <= MOST_MODELS:
        raise UsageError(f"a drawing shows 1 to {MOST_MODELS} models, got {len(models)}: {', '.join(models)}")
    view = choose_view(picture)
    axes, series = _Axes.make(picture, view), _Series.make(models)
    rows = {
        "markings": list_markings(picture),
        "lanes": list_lanes(picture),
        "boxes": list_boxes(picture, view),
        "paths": list_paths(picture, view),
        "ellipses": list_ellipses(picture),
        "probabilities": list_probabilities(picture, view, step_x_m=26 * axes.pixel_x_m, step_y_m=16 * axes.pixel_y_m),
        "errors": list_errors(picture),
        "zero": [{"error_m": 0}],
    }
    road = alt.layer(*_draw_road(axes), *_draw_vehicles(picture, axes), *_draw_paths(axes, series))
    subtitle = [*describe_maneuvers(picture), *describe_marks(picture, view)]
    layout = alt.vconcat(
        road.properties(width=WIDTH, height=axes.height),
        alt.hconcat(*(_draw_error(picture, series, *one) for one in ERRORS), spacing=ERROR_GAP),
        title=alt.Title(name_picture(picture), subtitle=subtitle, offset=14),
        spacing=18,
    )
    return Drawing(layout, rows)


def name_picture(picture: Picture) -> str:
    """Name the vehicle, place and time: the drawing's title."""
    vehicle = f"{picture.dataset} {picture.subset}, vehicle {picture.own.vehicle_id} at {picture.time_s:.1f} s"
    return f"{vehicle} (sample {picture.sample}, {picture.part})"


def describe_maneuvers(picture: Picture) -> list[str]:
    """Describe the true maneuvers, and the models' probabilities of all maneuvers, one line each."""
    lines = [f"true maneuver: {picture.lateral}, {picture.longitudinal}"]
    for forecast in picture.own.forecasts:
        maneuvers = [*(forecast.lateral or {}).items(), *(forecast.longitudinal or {}).items()]
        if maneuvers:
            lines.append(f"{forecast.model}: " + ", ".join(f"{name} {share:.0%}" for name, share in maneuvers))
    return lines


def describe_marks(picture: Picture, view: View) -> list[str]:
    """Describe the marks that the legend does not show, in one line; no line where there are none."""
    others, own = any(vehicle.has_density for vehicle in picture.vehicles[1:]), picture.own.has_density
    sigmas = f"{'1 and ' if own else ''}3 sigma at each second{', of others 3' if own and others else ''}"
    paths = list_paths(picture, view)
    marks = {
        f"ellipses: {sigmas}": own or others,
        "thin lines: less probable, with probability": any(row["kind"] == "alternative" for row in paths),
        "outlined vehicle: size unknown": not all(box["known"] for box in list_boxes(picture, view)),
        "lanes of 12 ft, as no markings are known": not picture.marked,
    }
    line = "; ".join(name for name, present in marks.items() if present)
    return [line] if line else []


@dataclass(frozen=True)
class _Axes:
    """The road's axes: along it from left to right, across it downwards; `height` in pixels."""

    view: View
    height: int

    @classmethod
    def make(cls, picture: Picture, view: View) -> "_Axes":
        lane_m = (picture.markings_m[-1] - picture.markings_m[0]) / (len(picture.markings_m) - 1)
        height = LANE_HEIGHT * (view.last_y_m - view.first_y_m) / lane_m
        return cls(view, round(min(max(height, LEAST_HEIGHT), MOST_HEIGHT)))

    @property
    def pixel_x_m(self) -> float:
        """Length of a pixel along the road."""
        return (self.view.last_x_m - self.view.first_x_m) / WIDTH

    @property
    def pixel_y_m(self) -> float:
        """Length of a pixel across the road."""
        return (self.view.last_y_m - self.view.first_y_m) / self.height

    def along(self, field: str = "x_m") -> alt.X:
        """Positions along the road."""
        title = "along the road (m), direction of travel \N{RIGHTWARDS ARROW}"
        scale = alt.Scale(domain=[self.view.first_x_m, self.view.last_x_m], nice=False, zero=False)
        return alt.X(f"{field}:Q", title=title, scale=scale, axis=alt.Axis(grid=False, tickCount=10, offset=4))

    def across(self, field: str = "y_m") -> alt.Y:
        """Positions across the road."""
        title = ["across the road (m)", f"stretched {self.pixel_x_m / self.pixel_y_m:.1f} times"]
        scale = alt.Scale(domain=[self.view.last_y_m, self.view.first_y_m], nice=False, zero=False)
        return alt.Y(f"{field}:Q", title=title, scale=scale, axis=alt.Axis(grid=False, tickCount=5, offset=4))


@dataclass(frozen=True)
class _Series:
    """Colours and shapes of history, truth and models: the same channels on the road, in errors and in the legend."""

    stroke: alt.Stroke
    fill: alt.Fill
    shape: alt.Shape

    @classmethod
    def make(cls, models: tuple[str, ...]) -> "_Series":
        names, count = ["history", "truth", *models], len(models)
        columns = max(1, WIDTH // (LEGEND_SYMBOL + LEGEND_LETTER * max(map(len, names))))
        legend = alt.Legend(title=None, labelColor=INK, symbolSize=70, columns=columns)

        def scale(*marks: str) -> alt.Scale:
            return alt.Scale(domain=names, range=list(marks))

        return cls(
            alt.Stroke("series:N", scale=scale(INK, INK, *MODEL_COLOURS[:count]), legend=legend),
            alt.Fill("series:N", scale=scale(INK, PAPER, *MODEL_COLOURS[:count]), legend=legend),
            alt.Shape("series:N", scale=scale("circle", "circle", *MODEL_SHAPES[:count]), legend=legend),
        )


def _chart(name: str) -> alt.Chart:
    return alt.Chart(alt.NamedData(name))


def _draw_road(axes: _Axes) -> Iterator[alt.Chart]:
    markings = _chart("markings").encode(y=axes.across())
    edge = "datum.edge"
    yield (
        markings.transform_filter(edge)
        .transform_aggregate(top="min(y_m)", bottom="max(y_m)")
        .mark_rect(color=ASPHALT)
        .encode(y=axes.across("top"), y2="bottom:Q")
    )
    yield markings.mark_rule().encode(
        color=alt.condition(edge, alt.value(MUTED), alt.value(LANE_LINE)),
        strokeWidth=alt.condition(edge, alt.value(2), alt.value(1.5)),
        strokeDash=alt.condition(edge, alt.value(SOLID), alt.value(LANE_DASH)),
    )
    names = _chart("lanes").mark_text(align="left", dx=10, color=MUTED, fontSize=13)
    yield names.encode(x=alt.value(WIDTH), y=axes.across(), text="lane:N")


def _draw_vehicles(picture: Picture, axes: _Axes) -> Iterator[alt.Chart]:
    present = {box["role"] for box in list_boxes(picture, axes.view)}
    roles = {role: colour for role, colour in ROLES.items() if role in present}
    names = {"own": f"vehicle {picture.own.vehicle_id}", "neighbor": "neighbor in its grid", "other": "other vehicle"}
    role = alt.Color(
        "role:N",
        scale=alt.Scale(domain=list(roles), range=list(roles.values())),
        legend=alt.Legend(
            title=None, labelColor=INK, symbolType="square", symbolSize=150, labelExpr=f"{names}[datum.value]"
        ),
    )
    histories = _chart("paths").transform_filter("datum.kind === 'history'")
    yield histories.mark_line(strokeWidth=1.5, clip=True).encode(
        x=axes.along(), y=axes.across(), color=role, detail="path:N", order="tick:Q"
    )
    for shown, style in (("datum.known", {"stroke": PAPER, "strokeWidth": 1}), ("!datum.known", {"filled": False})):
        boxes = _chart("boxes").transform_filter(shown)
        yield boxes.mark_rect(cornerRadius=2, clip=True, **style).encode(
            x=axes.along("back_m"), x2="front_m:Q", y=axes.across("left_m"), y2="right_m:Q", color=role
        )


def _draw_paths(axes: _Axes, series: _Series) -> Iterator[alt.Chart]:
    place = {"x": axes.along(), "y": axes.across(), "stroke": series.stroke}
    own, inner = "datum.own", "datum.sigmas === 1"
    yield (
        _chart("ellipses")
        .mark_line(interpolate="linear-closed", clip=True)
        .encode(
            **place,
            fill=series.fill,
            detail=["ellipse:N", "own:N", "sigmas:N"],
            order="order:Q",
            strokeWidth=alt.condition(inner, alt.value(1.2), alt.value(0.8)),
            strokeOpacity=alt.condition(own, alt.value(0.9), alt.value(0.5)),
            fillOpacity=alt.when(inner)
            .then(alt.value(0.16))
            .when(own)
            .then(alt.value(0.06))
            .otherwise(alt.value(0.02)),
        )
    )
    paths = _chart("paths")
    yield (
        paths.transform_filter("datum.kind !== 'history'")
        .mark_line(clip=True)
        .encode(
            **place,
            strokeDash=alt.condition("datum.kind === 'truth'", alt.value(TRUTH_DASH), alt.value(SOLID)),
            detail=["path:N", "kind:N", "role:N"],
            order="tick:Q",
            strokeWidth=alt.condition(
                "datum.role === 'own' && datum.kind !== 'alternative'", alt.value(2), alt.value(1.2)
            ),
            strokeOpacity=alt.condition("datum.kind === 'alternative'", alt.value(0.55), alt.value(1)),
        )
    )
    yield (
        paths.transform_filter("datum.marked")
        .mark_point(strokeWidth=1.6, opacity=1, clip=True)
        .encode(
            **place,
            fill=series.fill,
            shape=series.shape,
            size=alt.condition("datum.kind === 'history'", alt.value(12), alt.value(50)),
        )
    )
    labels = _chart("probabilities").encode(x=axes.along(), y=axes.across())
    yield labels.mark_rule(strokeWidth=0.8, opacity=0.7).encode(x2="end_x_m:Q", y2="end_y_m:Q", stroke=series.stroke)
    yield labels.mark_text(align="left", dx=3, fontSize=13, **HALO).encode(text="label:N")
    yield labels.mark_text(align="left", dx=3, fontSize=13).encode(text="label:N", fill=series.fill)


def _draw_error(picture: Picture, series: _Series, column: str, sigma: str | None, title: str) -> Layers:
    """Draw a panel of errors over time; errors of the own vehicle with the model's own standard deviation."""
    title = f"{title}, \N{PLUS-MINUS SIGN} sigma" if sigma and picture.own.has_density else title
    axis = alt.Axis(tickCount=5, titleAngle=0, titleAlign="left", titleX=0, titleY=-14, titleColor=INK)

    def value(field: str) -> alt.Y:
        return alt.Y(f"{field}:Q", title=title, axis=axis, scale=alt.Scale(zero=True))

    x = alt.X(
        "seconds:Q",
        title="seconds ahead",
        axis=alt.Axis(tickMinStep=1, grid=False, labelFlush=False),
        scale=alt.Scale(domainMin=0, nice=False),
    )
    errors = _chart("errors").transform_calculate(series="datum.model").encode(x=x, y=value(column))
    own = errors.transform_filter("datum.own")
    layers = [
        errors.mark_line(clip=True).encode(
            stroke=series.stroke,
            detail=["vehicle_id:N", "own:N"],
            strokeWidth=alt.condition("datum.own", alt.value(2), alt.value(0.7)),
        ),
        own.transform_filter("datum.second")
        .mark_point(opacity=1, size=45)
        .encode(stroke=series.stroke, fill=series.fill, shape=series.shape),
    ]
    if sigma:
        band = (
            own.transform_filter(f"isValid(datum.{sigma})")
            .transform_calculate(low=f"datum.{column} - datum.{sigma}", high=f"datum.{column} + datum.{sigma}")
            .mark_area(opacity=0.15)
            .encode(y=value("low"), y2="high:Q", fill=series.fill)
        )
        layers = [band, _chart("zero").mark_rule(color=MUTED).encode(y=value("error_m")), *layers]
    return alt.layer(*layers).properties(width=(WIDTH - 2 * ERROR_GAP) // 3, height=ERROR_HEIGHT)
