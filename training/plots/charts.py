"""What charts of training have in common: colours, letters, and the way from a chart to the bytes of a file.

Colours are of Okabe and Ito's palette, told apart by colour-blind readers, and never the only sign: marks differ in
shape, lines in their dashes. The same chart gives the same bytes.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import altair as alt
import vl_convert

Row = dict[str, Any]
Layers = alt.LayerChart | alt.FacetChart
"""What Altair's `layer` says it returns."""
Layout = alt.Chart | Layers | alt.HConcatChart | alt.VConcatChart

INK, MUTED, GRID, PAPER = "#1f2328", "#59636e", "#d8dee4", "#ffffff"
BLUE, ORANGE, GREEN, PURPLE, SKY, AMBER = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"

PNG_SCALE = 2
"""Pixels of a PNG per pixel of the drawing."""
SUFFIXES = (".svg", ".png")


@dataclass
class Tables:
    """The rows that a drawing's layers show, by name.

    Altair is only told the names: it would check and copy every row at every step, which takes seconds.
    """

    rows: dict[str, list[Row]] = field(default_factory=dict)

    def chart(self, name: str, rows: Iterable[Row]) -> alt.Chart:
        """A chart of rows, which are kept under a name of their own.

        Raises:
            ValueError: the name is taken.
        """
        if name in self.rows:
            raise ValueError(f"there are rows of the name `{name}` already")
        self.rows[name] = list(rows)
        return alt.Chart(alt.NamedData(name))


@dataclass(frozen=True)
class Drawing:
    """A chart, and the rows that it names."""

    layout: Layout
    tables: Tables

    def to_vega_lite(self) -> dict[str, Any]:
        """The specification, with the letters and colours that all drawings share."""
        styled = (
            self.layout.configure(font="sans-serif", background=PAPER, aria=False, padding=14)
            .configure_view(stroke=None)
            .configure_axis(
                labelColor=MUTED,
                titleColor=MUTED,
                titleFontWeight="normal",
                gridColor=GRID,
                domainColor=MUTED,
                tickColor=MUTED,
                labelFontSize=13,
                titleFontSize=13,
            )
            .configure_title(color=INK, subtitleColor=MUTED, anchor="start", fontSize=17, subtitleFontSize=13)
        )
        return {**styled.to_dict(validate=False), "datasets": self.tables.rows}

    def render(self, suffix: str) -> bytes:
        """The bytes of a file of the drawing, which fetches nothing.

        Args:
            suffix: one of SUFFIXES, in any case.

        Raises:
            ValueError: another one.
        """
        check_suffix(suffix)
        if suffix.lower() == ".png":
            png: bytes = vl_convert.vegalite_to_png(self.to_vega_lite(), scale=PNG_SCALE)
            return png
        svg: str = vl_convert.vegalite_to_svg(self.to_vega_lite())
        return _number_parts(svg).encode("utf-8")


def _number_parts(svg: str) -> str:
    """The same SVG with clip paths and gradients numbered from 0: Vega goes on counting from drawing to drawing."""
    names = dict.fromkeys(re.findall(r'<(?:clipPath|linearGradient) id="(clip\d+|gradient_\d+)"', svg))
    new = {old: f"{old.rstrip('0123456789')}{place}" for place, old in enumerate(names)}
    return re.sub(
        r'( id="|="url\(#)(clip\d+|gradient_\d+)', lambda found: f"{found[1]}{new.get(found[2], found[2])}", svg
    )


def check_suffix(suffix: str) -> None:
    """Refuse an ending of names of files that no drawing is written to.

    Raises:
        ValueError: it is none of SUFFIXES.
    """
    if suffix.lower() not in SUFFIXES:
        raise ValueError(f"expected a file whose name ends in {' or '.join(SUFFIXES)}, got `{suffix}`")
