"""Colours, fonts and axes that charts of the reports and of training share, as plain values for Altair.

Colours are of Okabe and Ito's palette, which colour-blind readers can distinguish. They are never the only sign: marks
differ in shape, lines in their dashes.
"""

from typing import Any

INK, MUTED, GRID, PAPER = "#1f2328", "#59636e", "#d8dee4", "#ffffff"
"""Colours of marks and titles, of labels and axes, of grid lines, and of the background."""
BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"
"""Colours of the first three series of a chart."""
PURPLE, SKY, AMBER = "#cc79a7", "#56b4e9", "#e69f00"
"""Colours of further series."""


def make_config(*, background: str, padding: int, label: int, title: int, heading: int) -> dict[str, Any]:
    """Make the configuration of a chart, as `altair.Chart.configure` takes it; padding and letters are in pixels."""
    letters = {
        "labelColor": MUTED,
        "titleColor": MUTED,
        "titleFontWeight": "normal",
        "labelFontSize": label,
        "titleFontSize": title,
    }
    return {
        "font": "sans-serif",
        "background": background,
        "aria": False,
        "padding": padding,
        "view": {"stroke": None},
        "axis": {**letters, "gridColor": GRID, "domainColor": MUTED, "tickColor": MUTED},
        "legend": {**letters, "orient": "top", "columnPadding": 18, "padding": 8},
        "title": {
            "color": INK,
            "subtitleColor": MUTED,
            "anchor": "start",
            "offset": 12,
            "fontSize": heading,
            "subtitleFontSize": label,
        },
    }
