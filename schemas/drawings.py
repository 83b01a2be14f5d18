"""Charts as files: SVG or PNG, the same bytes for the same chart, without anything to fetch."""

import re
from dataclasses import dataclass
from typing import Any

import altair as alt
import vl_convert

from tracklake.schemas.chart_theme import PAPER, make_config
from tracklake.schemas.errors import UsageError

Row = dict[str, Any]
Layers = alt.LayerChart | alt.FacetChart
"""Charts that `altair.layer` makes."""

_THEME = make_config(background=PAPER, padding=14, label=13, title=13, heading=17)
_LEGENDS = {"labelLimit": 0, "layout": {"top": {"direction": "vertical", "margin": 0}}}
CONFIG = {**_THEME, "legend": {**_THEME["legend"], **_LEGENDS}}
"""The theme; legends stand below each other, with names in full length."""
PNG_SCALE = 2
"""Pixels of a PNG per pixel of the drawing."""
SUFFIXES = (".svg", ".png")


@dataclass(frozen=True)
class Drawing:
    """A chart of `altair.NamedData`, and its rows by name; Altair takes seconds to copy and check rows."""

    layout: alt.VConcatChart
    rows: dict[str, list[Row]]

    def to_vega_lite(self) -> dict[str, Any]:
        """Make the specification, with the theme and the rows."""
        return {**self.layout.to_dict(validate=False), "config": CONFIG, "datasets": self.rows}

    def render(self, suffix: str) -> bytes:
        """Make the bytes of a file; the suffix is one of SUFFIXES, in any case.

        Raises:
            UsageError: another suffix.
        """
        if suffix.lower() not in SUFFIXES:
            raise UsageError(f"expected a file whose name ends in {' or '.join(SUFFIXES)}, got `{suffix}`")
        if suffix.lower() == ".png":
            png: bytes = vl_convert.vegalite_to_png(self.to_vega_lite(), scale=PNG_SCALE)
            return png
        return _renumber(vl_convert.vegalite_to_svg(self.to_vega_lite())).encode("utf-8")


def name_rows(name: str, *conditions: str) -> alt.Chart:
    """Start a chart of the named rows that meet all conditions, Vega expressions of `datum`."""
    chart = alt.Chart(alt.NamedData(name))
    for condition in conditions:
        chart = chart.transform_filter(condition)
    return chart


def fix_scale(first: float, last: float) -> alt.Scale:
    """Make a scale of exactly this range."""
    return alt.Scale(domain=[first, last], nice=False, zero=False)


def _renumber(svg: str) -> str:
    """Number clip paths and gradients from 0; Vega goes on counting from drawing to drawing."""
    names = dict.fromkeys(re.findall(r'<(?:clipPath|linearGradient) id="(clip\d+|gradient_\d+)"', svg))
    new = {old: f"{old.rstrip('0123456789')}{number}" for number, old in enumerate(names)}
    return re.sub(r'( id="|="url\(#)(clip\d+|gradient_\d+)', lambda found: found[1] + new.get(found[2], found[2]), svg)
