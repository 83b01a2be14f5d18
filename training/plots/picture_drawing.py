"""The drawing of a picture: the road with its vehicles and predictions, and the models' errors below."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import altair as alt

from tracklake.schemas.chart_theme import BLUE, GREEN, INK, MUTED, ORANGE, PAPER, PURPLE
from tracklake.schemas.drawings import Drawing, Layers, fix_scale, name_rows
from tracklake.schemas.errors import UsageError
from tracklake.training.plots import picture_rows
from tracklake.training.plots.picture import Picture

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
ERRORS = {
    "distance": "distance from the truth (m)",
    "along": "predicted \N{MINUS SIGN} true, along the road (m)",
    "across": "predicted \N{MINUS SIGN} true, across the road (m)",
}
"""Titles of the panels by the error's name."""


def draw_picture(picture: Picture) -> Drawing:
    """Draw a sample on the road.

    Raises:
        UsageError: no model, or more than MOST_MODELS.
    """
    models = picture.models
    if not 1 <= len(models) <= MOST_MODELS:
        raise UsageError(f"a drawing shows 1 to {MOST_MODELS} models, got {len(models)}: {', '.join(models)}")
    view = picture_rows.choose_view(picture)
    lane_m = (picture.markings_m[-1] - picture.markings_m[0]) / (len(picture.markings_m) - 1)
    height = round(min(max(LANE_HEIGHT * (view.last_y_m - view.first_y_m) / lane_m, LEAST_HEIGHT), MOST_HEIGHT))
    pixel_x_m, pixel_y_m = (view.last_x_m - view.first_x_m) / WIDTH, (view.last_y_m - view.first_y_m) / height
    rows = {
        "markings": picture_rows.list_markings(picture),
        "lanes": picture_rows.list_lanes(picture),
        "boxes": picture_rows.list_boxes(picture, view),
        "paths": picture_rows.list_paths(picture, view),
        "ellipses": picture_rows.list_ellipses(picture),
        "probabilities": picture_rows.list_probabilities(
            picture, view, step_x_m=26 * pixel_x_m, step_y_m=16 * pixel_y_m
        ),
        "errors": picture_rows.list_errors(picture),
        "zero": [{"error_m": 0}],
    }
    to = _Channels.make(view, models, stretch=pixel_x_m / pixel_y_m)
    present = [role for role in ROLES if role in {box["role"] for box in rows["boxes"]}]
    vehicles = _draw_vehicles(to, present, f"vehicle {picture.own.vehicle_id}")
    road = alt.layer(*_draw_road(to), *vehicles, *_draw_paths(to), width=WIDTH, height=height)
    maneuvers, marks = describe_maneuvers(picture), describe_marks(picture, view)
    name = f"{picture.place}, vehicle {picture.own.vehicle_id} at {picture.time_s:.1f} s"
    title = alt.Title(f"{name} (sample {picture.sample}, {picture.part})", subtitle=[*maneuvers, *marks], offset=14)
    known = ["along"] if picture.lane_centred else list(ERRORS)
    errors = alt.hconcat(*(_draw_error(to, error, picture.own.has_density) for error in known), spacing=ERROR_GAP)
    return Drawing(alt.vconcat(road, errors, title=title, spacing=18), rows)


def describe_maneuvers(picture: Picture) -> list[str]:
    """Describe the true maneuvers, and the models' probabilities of all maneuvers, one line each."""
    lines = [f"true maneuver: {picture.lateral}, {picture.longitudinal}"]
    for forecast in picture.own.forecasts:
        maneuvers = {**(forecast.lateral or {}), **(forecast.longitudinal or {})}
        if maneuvers:
            lines.append(f"{forecast.model}: " + ", ".join(f"{name} {share:.0%}" for name, share in maneuvers.items()))
    return lines


def describe_marks(picture: Picture, view: picture_rows.View) -> list[str]:
    """Describe the marks that the legend does not show, in one line; no line where there are none."""
    others, own = any(vehicle.has_density for vehicle in picture.vehicles[1:]), picture.own.has_density
    sigmas = f"{'1 and ' if own else ''}3 sigma at each second{', of others 3 at the last' if own and others else ''}"
    marks = {
        f"ellipses: {sigmas}": own or others,
        "thin lines: less probable, with probability": any(map(picture_rows.find_likely, picture.own.forecasts)),
        "outlined vehicle: size unknown": not all(box["known"] for box in picture_rows.list_boxes(picture, view)),
        "lanes of 12 ft, as no markings are known": not picture.marked,
        "lateral positions are lane centres": picture.lane_centred,
    }
    line = "; ".join(text for text, present in marks.items() if present)
    return [line] if line else []


@dataclass(frozen=True)
class _Channels:
    """Positions on the road; and colours and shapes of history, truth and models, which the errors share."""

    along: Callable[[str], alt.X]
    across: Callable[[str], alt.Y]
    stroke: alt.Stroke
    fill: alt.Fill
    shape: alt.Shape

    @classmethod
    def make(cls, view: picture_rows.View, models: tuple[str, ...], stretch: float) -> "_Channels":
        names, count = ["history", "truth", *models], len(models)
        columns = max(1, WIDTH // (LEGEND_SYMBOL + LEGEND_LETTER * max(map(len, names))))
        legend = alt.Legend(title=None, labelColor=INK, symbolSize=70, columns=columns)
        axis = partial(alt.Axis, grid=False, offset=4)

        def scale(*marks: str) -> alt.Scale:
            return alt.Scale(domain=names, range=list(marks))

        return cls(
            along=partial(
                alt.X,
                title="along the road (m), direction of travel \N{RIGHTWARDS ARROW}",
                scale=fix_scale(view.first_x_m, view.last_x_m),
                axis=axis(tickCount=10),
            ),
            across=partial(
                alt.Y,
                title=["across the road (m)", f"stretched {stretch:.1f} times"],
                scale=fix_scale(view.last_y_m, view.first_y_m),
                axis=axis(tickCount=5),
            ),
            stroke=alt.Stroke("series:N", scale=scale(INK, INK, *MODEL_COLOURS[:count]), legend=legend),
            fill=alt.Fill("series:N", scale=scale(INK, PAPER, *MODEL_COLOURS[:count]), legend=legend),
            shape=alt.Shape("series:N", scale=scale("circle", "circle", *MODEL_SHAPES[:count]), legend=legend),
        )


def _make_condition(test: str, yes: str | float | list[int], no: str | float | list[int]) -> dict[str, Any]:
    """Make the values of a channel by a Vega expression."""
    return {"condition": {"test": test, "value": yes}, "value": no}


def _draw_road(to: _Channels) -> Iterator[alt.Chart]:
    edge, markings = "datum.edge", name_rows("markings").encode(y=to.across("y_m:Q"))
    asphalt = markings.transform_filter(edge).transform_aggregate(top="min(y_m)", bottom="max(y_m)")
    yield asphalt.mark_rect(color=ASPHALT).encode(y=to.across("top:Q"), y2="bottom:Q")
    yield markings.mark_rule().encode(
        color=_make_condition(edge, MUTED, LANE_LINE),
        strokeWidth=_make_condition(edge, 2, 1.5),
        strokeDash=_make_condition(edge, SOLID, LANE_DASH),
    )
    names = name_rows("lanes").mark_text(align="left", dx=10, color=MUTED, fontSize=13)
    yield names.encode(x=alt.value(WIDTH), y=to.across("y_m:Q"), text="lane:N")


def _draw_vehicles(to: _Channels, present: list[str], own: str) -> Iterator[alt.Chart]:
    names = {"own": own, "neighbor": "neighbor in its grid", "other": "other vehicle"}
    role = alt.Color(
        "role:N",
        scale=alt.Scale(domain=present, range=[ROLES[role] for role in present]),
        legend=alt.Legend(
            title=None, labelColor=INK, symbolType="square", symbolSize=150, labelExpr=f"{names}[datum.value]"
        ),
    )
    histories = name_rows("paths", "datum.kind === 'history'").mark_line(strokeWidth=1.5, clip=True)
    yield histories.encode(x=to.along("x_m:Q"), y=to.across("y_m:Q"), color=role, detail="path:N", order="tick:Q")
    for shown, style in (("datum.known", {"stroke": PAPER, "strokeWidth": 1}), ("!datum.known", {"filled": False})):
        boxes = name_rows("boxes", shown).mark_rect(cornerRadius=2, clip=True, **style)
        boxes = boxes.encode(x=to.along("back_m:Q"), x2="front_m:Q", y=to.across("left_m:Q"), y2="right_m:Q")
        yield boxes.encode(color=role)


def _draw_paths(to: _Channels) -> Iterator[alt.Chart]:
    place = {"x": to.along("x_m:Q"), "y": to.across("y_m:Q"), "stroke": to.stroke}
    own, inner, thin = "datum.own", "datum.sigmas === 1", "datum.kind === 'alternative'"
    faint = alt.when(inner).then(alt.value(0.16)).when(own).then(alt.value(0.06)).otherwise(alt.value(0))
    ellipses = name_rows("ellipses").mark_line(interpolate="linear-closed", clip=True)
    yield ellipses.encode(
        **place,
        fill=to.fill,
        detail=["ellipse:N", "own:N", "sigmas:N"],
        order="order:Q",
        strokeWidth=_make_condition(inner, 1.2, 0.8),
        strokeOpacity=_make_condition(own, 0.9, 0.5),
        fillOpacity=faint,
    )
    futures = name_rows("paths", "datum.kind !== 'history'").mark_line(clip=True)
    yield futures.encode(
        **place,
        strokeDash=_make_condition("datum.kind === 'truth'", TRUTH_DASH, SOLID),
        detail=["path:N", "kind:N", "role:N"],
        order="tick:Q",
        strokeWidth=_make_condition(f"datum.role === 'own' && !({thin})", 2, 1.2),
        strokeOpacity=_make_condition(thin, 0.55, 1),
    )
    marked = name_rows("paths", "datum.marked").mark_point(strokeWidth=1.6, opacity=1, clip=True)
    yield marked.encode(**place, fill=to.fill, shape=to.shape, size=_make_condition("datum.kind === 'history'", 12, 50))
    labels = name_rows("probabilities").encode(x=to.along("x_m:Q"), y=to.across("y_m:Q"))
    yield labels.mark_rule(strokeWidth=0.8, opacity=0.7).encode(x2="end_x_m:Q", y2="end_y_m:Q", stroke=to.stroke)
    text = partial(labels.encode(text="label:N").mark_text, align="left", dx=3, fontSize=13)
    yield text(**HALO)
    yield text().encode(fill=to.fill)


def _draw_error(to: _Channels, error: str, has_density: bool) -> Layers:
    """Draw a panel of errors over time; errors along and across with the own vehicle's standard deviation."""
    signed = error != "distance"
    value = partial(
        alt.Y,
        title=f"{ERRORS[error]}, \N{PLUS-MINUS SIGN} sigma" if signed and has_density else ERRORS[error],
        axis=alt.Axis(tickCount=5, titleAngle=0, titleAlign="left", titleX=0, titleY=-14, titleColor=INK),
        scale=alt.Scale(zero=True),
    )
    x = alt.X(
        "seconds:Q",
        title="seconds ahead",
        axis=alt.Axis(tickMinStep=1, grid=False, labelFlush=False),
        scale=alt.Scale(domainMin=0, nice=False),
    )
    errors = name_rows("errors").transform_calculate(series="datum.model").encode(x=x, y=value(f"{error}_m:Q"))
    own = errors.transform_filter("datum.own")
    mean, sigma = f"datum.{error}_m", f"datum.{error}_sigma_m"
    band = own.transform_filter(f"isValid({sigma})")
    band = band.transform_calculate(low=f"{mean} - {sigma}", high=f"{mean} + {sigma}")
    under = [
        band.mark_area(opacity=0.15).encode(y=value("low:Q"), y2="high:Q", fill=to.fill),
        name_rows("zero").mark_rule(color=MUTED).encode(y=value("error_m:Q")),
    ]
    return alt.layer(
        *(under if signed else ()),
        errors.mark_line(clip=True).encode(
            stroke=to.stroke, detail=["vehicle_id:N", "own:N"], strokeWidth=_make_condition("datum.own", 2, 0.7)
        ),
        own.transform_filter("datum.second")
        .mark_point(opacity=1, size=45)
        .encode(stroke=to.stroke, fill=to.fill, shape=to.shape),
        width=(WIDTH - 2 * ERROR_GAP) // 3,
        height=ERROR_HEIGHT,
    )
