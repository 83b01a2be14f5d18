"""Plot of the verdicts: the share of entries with an error of every subset, on a logarithmic scale."""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from tracklake.quality_reports.plots.axes import Scale, draw_text, wrap_svg
from tracklake.quality_reports.plots.distributions import draw_heading
from tracklake.quality_reports.verdicts import BAD, BAD_ERROR_SHARE, CARE, CARE_ERROR_SHARE, GOOD, UNKNOWN
from tracklake.schemas.chart_theme import GREEN, GRID, MUTED, ORANGE

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1112, 170, 64, 118, 34, 14
"""Size of the plot's axes and the margins around them, in pixels; WIDTH includes the margins."""
RED = "#b3261e"
"""Colour of subsets that are not usable."""
LEAST_SHARE = 1e-4
"""Least share of entries on the logarithmic scale; a share of zero or less than it is drawn at the bottom."""
COLOURS = {GOOD: GREEN, CARE: ORANGE, BAD: RED, UNKNOWN: MUTED}
SHAPES = {GOOD: "m-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0", CARE: "m0-6l6 6-6 6-6-6z", BAD: "m-5-5h10v10h-10z"}
"""Paths of marks around their middle; others are a ring."""


def draw_verdicts(verdicts: Sequence[Mapping[str, Any]], pages: Mapping[tuple[str, str], str]) -> str:
    """Draw a mark for every subset, side by side, which leads to the subset's page.

    Args:
        verdicts: rows of `schemas.quality_tracks.Verdict`; those of datasets are left out.
        pages: addresses of the subsets' pages, by (dataset, subset).
    """
    subsets = [row for row in verdicts if row["subset"] is not None]
    x = Scale(-0.5, max(1, len(subsets)) - 0.5, LEFT, WIDTH - RIGHT)
    y = Scale(math.log10(LEAST_SHARE) - 0.5, 0, TOP + HEIGHT, TOP)
    drawn = []
    for share in (1.0, 0.1, 0.01, 0.001, LEAST_SHARE):
        height = y.to_pixels(math.log10(share))
        drawn.append(f'<path d="M{LEFT} {height:.1f}H{WIDTH - RIGHT}" stroke="{GRID}" fill="none"/>')
        drawn.append(draw_text(LEFT - 8, f"{height + 4:.1f}", f"{100 * share:g} %", anchor="end"))
    drawn.append(draw_text(LEFT - 8, f"{y.start:.1f}", "0 %", anchor="end"))
    drawn.append(draw_text(LEFT - 56, TOP - 18, "entries with an error, by subset"))
    for share, text in ((BAD_ERROR_SHARE, "not usable"), (CARE_ERROR_SHARE, "with care")):
        height = y.to_pixels(math.log10(share))
        line = f"M{LEFT} {height:.1f}H{WIDTH - RIGHT}"
        drawn.append(f'<path d="{line}" stroke="{MUTED}" stroke-dasharray="5 4" fill="none"/>')
        drawn.append(draw_text(WIDTH - RIGHT + 8, f"{height - 4:.1f}", f"{text} from {share:.0%}"))
    for number, row in enumerate(subsets):
        if number == 0 or row["dataset"] != subsets[number - 1]["dataset"]:
            at = x.to_pixels(number - 0.5)
            drawn.append(f'<path d="M{at:.1f} {TOP}V{y.start}" stroke="{MUTED}" fill="none"/>')
            drawn.append(draw_heading(round(at + 6), TOP - 3, row["dataset"]))
        share = row["error_share"] or 0.0
        height = y.to_pixels(math.log10(share)) if share >= LEAST_SHARE else y.start
        drawn.append(_draw_mark(row, x.to_pixels(number), height, pages.get((row["dataset"], row["subset"]))))
    return wrap_svg(WIDTH, TOP + HEIGHT + BOTTOM, "Share of entries with an error of every subset", "".join(drawn))


def _draw_mark(row: Mapping[str, Any], x: float, y: float, page: str | None) -> str:
    """Return the mark of a subset with its name as a tooltip, and a link where it has a page."""
    colour, share = COLOURS[row["verdict"]], row["error_share"]
    errors = "not checked" if share is None else f"{share:.2%} of the entries with an error"
    path = f'd="M{x:.1f} {y:.1f}{SHAPES.get(row["verdict"], SHAPES[GOOD])}"'
    filled = f'fill="{colour}"' if row["verdict"] in SHAPES else f'fill="none" stroke="{colour}"'
    title = html.escape(f"{row['subset']}: {row['verdict']}, {errors}")
    mark = f"<path {path} {filled}><title>{title}</title></path>"
    return f'<a href="{html.escape(page)}" aria-label="{title}">{mark}</a>' if page else mark
