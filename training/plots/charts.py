"""Charts of training as files: SVG or PNG, the same bytes for the same chart, without anything to fetch."""

import re
from dataclasses import dataclass
from typing import Any

import altair as alt
import vl_convert

from tracklake.schemas.chart_theme import PAPER, make_config
from tracklake.schemas.errors import UsageError

Row = dict[str, Any]
Layers = alt.LayerChart | alt.FacetChart
"""What `altair.layer` returns."""
Layout = alt.Chart | Layers | alt.HConcatChart | alt.VConcatChart

_THEME = make_config(background=PAPER, padding=14, label=13, title=13, heading=17)
_LEGENDS = {"labelLimit": 0, "layout": {"top": {"direction": "vertical", "margin": 0}}}
CONFIG = {**_THEME, "legend": {**_THEME["legend"], **_LEGENDS}}
"""The theme; legends stand below each other, with names in full length."""
PNG_SCALE = 2
"""Pixels of a PNG per pixel of the drawing."""
SUFFIXES = (".svg", ".png")


@dataclass(frozen=True)
class Drawing:
    """A chart and its rows.

    Args:
        layout: charts of `altair.NamedData`; Altair would copy and check rows at every step, which takes seconds.
        rows: the data, by name.
    """

    layout: Layout
    rows: dict[str, list[Row]]

    def to_vega_lite(self) -> dict[str, Any]:
        """Make the specification, with the theme and the rows."""
        return {**self.layout.to_dict(validate=False), "config": CONFIG, "datasets": self.rows}

    def render(self, suffix: str) -> bytes:
        """Make the bytes of a file.

        Args:
            suffix: one of SUFFIXES, in any case.

        Raises:
            UsageError: another suffix.
        """
        if suffix.lower() not in SUFFIXES:
            raise UsageError(f"expected a file whose name ends in {' or '.join(SUFFIXES)}, got `{suffix}`")
        if suffix.lower() == ".png":
            png: bytes = vl_convert.vegalite_to_png(self.to_vega_lite(), scale=PNG_SCALE)
            return png
        svg: str = vl_convert.vegalite_to_svg(self.to_vega_lite())
        return _renumber(svg).encode("utf-8")


def _renumber(svg: str) -> str:
    """Number clip paths and gradients from 0; Vega goes on counting from drawing to drawing."""
    names = dict.fromkeys(re.findall(r'<(?:clipPath|linearGradient) id="(clip\d+|gradient_\d+)"', svg))
    new = {old: f"{old.rstrip('0123456789')}{number}" for number, old in enumerate(names)}
    return re.sub(r'( id="|="url\(#)(clip\d+|gradient_\d+)', lambda found: found[1] + new.get(found[2], found[2]), svg)
