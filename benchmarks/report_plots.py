"""Plots of single findings on a subset's page: processor time of our own SVG axes and of the same plot by Altair.

    python benchmarks/report_plots.py [--repeats 20] [--lake DIR]

With a lake, its subsets' pages are rendered as well, to see which share of a page the plots take.
"""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path

import altair as alt
import polars as pl
import vl_convert

from tracklake.pipeline.lake import connect
from tracklake.quality_reports.pages.examples import PANELS, draw_example
from tracklake.quality_reports.pages.subsets import render_pages

ENTRIES = 120
"""Entries of one plot: a finding of 2 s at 10 Hz and 5 s before and after."""
FIRST, LAST = 50, 70
"""Frames of the finding."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20, help="plots drawn each way")
    parser.add_argument("--lake", type=Path, help="also render this lake's pages")
    options = parser.parse_args()
    entries = make_entries()
    for name, draw in (("own axes", draw_example), ("Altair", draw_by_altair)):
        cost = measure(lambda draw=draw: draw(entries, FIRST, LAST), options.repeats)
        print(f"{name}: {1000 * cost:.1f} ms per plot")
    if options.lake:
        with connect(options.lake) as connection:
            begun = time.process_time()
            pages = [page for _, page in render_pages(connection, {"lake": "benchmark"})]
            seconds = (time.process_time() - begun) / len(pages)
        plots = sum(page.count("Position, speed and acceleration over time") for page in pages) / len(pages)
        print(f"pages: {seconds:.2f} s each, with {plots:.1f} such plots")


def measure(draw: Callable[[], str], repeats: int) -> float:
    """Return the processor seconds of one call, after a first one that is not counted."""
    draw()
    begun = time.process_time()
    for _ in range(repeats):
        draw()
    return (time.process_time() - begun) / repeats


def make_entries() -> pl.DataFrame:
    """Make the entries of one vehicle around a finding."""
    times = [frame / 10 for frame in range(ENTRIES)]
    return pl.DataFrame(
        {
            "frame": range(ENTRIES),
            "time_s": times,
            "x_m": [25 * at for at in times],
            "speed_mps": [25 + math.sin(at) for at in times],
            "accel_mps2": [math.cos(at) for at in times],
        }
    )


def draw_by_altair(entries: pl.DataFrame, first_frame: int, last_frame: int) -> str:
    """Draw what `draw_example` draws with Altair; its arguments are the same."""
    base = alt.Chart(alt.InlineData(values=entries.to_dicts()))
    inside = (alt.datum.frame >= first_frame) & (alt.datum.frame <= last_frame)
    panels = []
    for column, title, _ in PANELS:
        x, y = alt.X("time_s:Q", title="time (s)"), alt.Y(f"{column}:Q", title=title, scale=alt.Scale(zero=False))
        line = base.mark_line().encode(x=x, y=y)
        panels.append(line + base.transform_filter(inside).mark_line(strokeWidth=2.6).encode(x=x, y=y))
    svg: str = vl_convert.vegalite_to_svg(alt.hconcat(*panels).to_dict(validate=False))
    return svg


if __name__ == "__main__":
    main()
