"""What marks on a drawing mean: the colours and shapes of things, and the key that names those that are on it."""

import altair as alt

from tracklake.training.plots.charts import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, Layers, Row, Tables
from tracklake.training.plots.picture import Picture
from tracklake.training.plots.rows import View, list_alternatives, list_boxes

MODEL_COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
MODEL_SHAPES = ("circle", "square", "diamond", "triangle-up")
BOX_COLOURS = {"own": INK, "neighbor": "#8c959f", "other": "#d0d7de"}
BOX_NAMES = {"own": "vehicle {}", "neighbor": "neighbor in its grid", "other": "other vehicle"}
DASHES = [6, 4]
"""Of the truth."""

LETTER, SYMBOL, GAP, LINE = 6.3, 34, 22, 24
"""Pixels: of a letter of size 13 on average, of a symbol with its blank, between entries, from a line to the next."""


def mark_models(picture: Picture) -> dict[str, Row]:
    """The colour and shape of every model, in their order."""
    return {
        model: {"colour": colour, "shape": shape}
        for model, colour, shape in zip(picture.models, MODEL_COLOURS, MODEL_SHAPES, strict=False)
    }


def list_entries(picture: Picture, view: View) -> list[Row]:
    """What is on the drawing, one row each: its kind, colour and shape, and what it is called."""
    boxes = list_boxes(picture, view)
    present = {box["role"] for box in boxes}
    entries = [
        {"kind": "box", "colour": colour, "told": BOX_NAMES[role].format(picture.own.vehicle_id)}
        for role, colour in BOX_COLOURS.items()
        if role in present
    ]
    if not all(box["known"] for box in boxes):
        entries.append({"kind": "outline", "colour": MUTED, "told": "size unknown"})
    entries.append({"kind": "history", "colour": INK, "told": "history"})
    entries.append({"kind": "truth", "colour": INK, "told": "truth"})
    entries += [{"kind": "model", "told": model, **mark} for model, mark in mark_models(picture).items()]
    forecasts = [said for vehicle in picture.vehicles for said in vehicle.forecasts]
    if any(said.alternatives for said in picture.own.forecasts):
        alone = not any(vehicle.forecasts for vehicle in picture.vehicles[1:])
        told = f"1 and 3 sigma at each second{'' if alone else ', of others 3'}"
        entries.append({"kind": "ellipses", "colour": MUTED, "told": told})
    elif any(said.alternatives for said in forecasts):
        entries.append({"kind": "ellipse", "colour": MUTED, "told": "3 sigma at each second"})
    if list_alternatives(picture):
        entries.append({"kind": "alternative", "colour": MUTED, "told": "less probable, with probability"})
    return entries


def draw_key(tables: Tables, picture: Picture, view: View, width: int) -> Layers:
    """One symbol and name for each, in lines of a width in pixels."""
    entries = _lay_out(list_entries(picture, view), width)
    height = LINE * (1 + max(row["line"] for row in entries))
    in_pixels, downwards = alt.Scale(domain=[0, width], nice=False), alt.Scale(domain=[height, 0], nice=False)

    def across(field: str) -> alt.X:
        return alt.X(f"{field}:Q", scale=in_pixels, axis=None)

    x, middle, y = across("x"), across("middle_x"), alt.Y("y:Q", scale=downwards, axis=None)
    low = alt.Y("y_low:Q", scale=downwards, axis=None)
    colour = alt.Color("colour:N", scale=None, legend=None)
    to = {"x2": "to_x:Q", "color": colour}
    everything = tables.chart("key", entries)

    def of(*kinds: str) -> alt.Chart:
        return everything.transform_filter(alt.FieldOneOfPredicate(field="kind", oneOf=list(kinds)))

    layers = [
        of("box").mark_rect(cornerRadius=2).encode(x=x, y=low, y2="y_high:Q", **to),
        of("outline").mark_rect(cornerRadius=2, filled=False, strokeWidth=1).encode(x=x, y=low, y2="y_high:Q", **to),
        of("history", "model").mark_rule(strokeWidth=2).encode(x=x, y=y, **to),
        of("alternative").mark_rule(strokeWidth=1.2, opacity=0.6).encode(x=x, y=y, **to),
        of("truth").mark_rule(strokeWidth=2, strokeDash=DASHES).encode(x=x, y=y, **to),
        of("history").mark_point(filled=True, size=22, opacity=1).encode(x=middle, y=y, color=colour),
        of("truth").mark_point(size=60, strokeWidth=1.6, opacity=1).encode(x=middle, y=y, color=colour),
        of("model")
        .mark_point(filled=True, size=55, opacity=1)
        .encode(x=middle, y=y, color=colour, shape=alt.Shape("shape:N", scale=None, legend=None)),
        *(
            of(*kinds)
            .mark_point(filled=False, size=size, strokeWidth=1, opacity=1, fill=MUTED, fillOpacity=fill)
            .encode(x=middle, y=y, color=colour)
            for kinds, size, fill in ((("ellipses", "ellipse"), 260, 0.08), (("ellipses",), 60, 0.2))
        ),
        everything.mark_text(align="left", baseline="middle", color=INK, fontSize=13).encode(
            x=across("text_x"), y=y, text="told:N"
        ),
    ]
    return alt.layer(*layers).properties(width=width, height=height)


def _lay_out(entries: list[Row], width: int) -> list[Row]:
    """Places from left to right, a new line where one is full."""
    x, line, placed = 0.0, 0, []
    for entry in entries:
        wide = SYMBOL + LETTER * len(entry["told"])
        if x and x + wide > width:
            x, line = 0.0, line + 1
        y = LINE * (line + 0.5)
        where = {"x": x, "to_x": x + SYMBOL - 8, "middle_x": x + (SYMBOL - 8) / 2, "text_x": x + SYMBOL, "y": y}
        placed.append({**entry, **where, "line": line, "y_low": y - 6, "y_high": y + 6})
        x += wide + GAP
    return placed
