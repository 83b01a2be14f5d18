"""The figure of docs/drives.md: how far a heading error moves a vehicle sideways, by its distance.

python benchmarks/heading_error.py [--out docs/heading-error.svg]
"""

import argparse
import math
from pathlib import Path

import altair as alt

from tracklake.schemas.chart_theme import BLUE, GREEN, ORANGE
from tracklake.schemas.drawings import Drawing, Row, fix_scale

ERRORS_DEG = (0.5, 1.0, 2.0)
"""Heading errors that are drawn, in degrees."""
DASHES: tuple[list[int], ...] = ([1, 0], [8, 4], [2, 3])
"""Dashes of the lines, in the same order."""
FARTHEST_M = 100
"""End of the axis of distances, in m."""
SHARE_OF_LANE_M = 1.75
"""Half a lane's width, in m: a vehicle that is farther off seems to drive in another lane."""


def compute_lateral_error(distance_m: float, error_deg: float) -> float:
    """Return how far sideways a point straight ahead seems to lie, in m."""
    return distance_m * math.sin(math.radians(error_deg))


def draw_heading_error() -> Drawing:
    """Draw the lateral error over the distance, a line per heading error, and half a lane's width."""
    lines: list[Row] = [
        {"distance_m": distance, "lateral_m": compute_lateral_error(distance, error), "error": f"{error:g} degrees"}
        for error in ERRORS_DEG
        for distance in (0, FARTHEST_M)
    ]
    names = [f"{error:g} degrees" for error in ERRORS_DEG]
    marked = compute_lateral_error(50, 1.0)
    marks: list[Row] = [{"distance_m": 50, "lateral_m": marked, "text": f"{marked:.2f} m"}]
    legend = alt.Legend(title="heading error", direction="horizontal", symbolType="stroke", symbolSize=600)
    x = alt.X("distance_m:Q", title="distance ahead (m)", scale=fix_scale(0, FARTHEST_M), axis=alt.Axis(tickCount=10))
    y = alt.Y("lateral_m:Q", title="lateral error (m)", scale=fix_scale(0, 3.6))
    line = (
        alt.Chart(alt.NamedData("lines"))
        .mark_line(strokeWidth=2.5)
        .encode(
            x=x,
            y=y,
            color=alt.Color(
                "error:N", sort=names, scale=alt.Scale(domain=names, range=[BLUE, ORANGE, GREEN]), legend=legend
            ),
            strokeDash=alt.StrokeDash(
                "error:N", sort=names, scale=alt.Scale(domain=names, range=DASHES), legend=legend
            ),
        )
    )
    lane = alt.Chart(alt.NamedData("lane")).mark_rule(strokeDash=[2, 3]).encode(y=y)
    named = (
        alt.Chart(alt.NamedData("lane")).mark_text(align="left", dx=4, dy=-7).encode(y=y, x=alt.value(0), text="text:N")
    )
    point = alt.Chart(alt.NamedData("marks")).mark_point(filled=True, size=70, color=ORANGE).encode(x=x, y=y)
    figure = alt.Chart(alt.NamedData("marks")).mark_text(align="left", dx=8, dy=10).encode(x=x, y=y, text="text:N")
    panel = alt.layer(lane, named, line, point, figure, width=640, height=260)
    rows = {"lines": lines, "marks": marks, "lane": [{"lateral_m": SHARE_OF_LANE_M, "text": "half a lane"}]}
    return Drawing(alt.vconcat(panel, title="A heading error moves far vehicles sideways"), rows)


def main() -> None:
    """Write the figure and print the lateral error at 50 m."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs/heading-error.svg")
    out: Path = parser.parse_args().out
    out.write_bytes(draw_heading_error().render(out.suffix))
    for error in ERRORS_DEG:
        print(f"{error:g} degrees at 50 m: {compute_lateral_error(50, error):.2f} m")


if __name__ == "__main__":
    main()
