"""Reliability plot: how many true positions lie in predicted regions, over the regions' probability."""

import altair as alt
import polars as pl

from tracklake.schemas.chart_theme import BLUE, MUTED
from tracklake.schemas.drawings import Drawing, fix_scale, name_rows

SIZE = 220
"""Width and height of a panel, in pixels."""
COLUMNS = 3
"""Panels side by side at most."""


def draw_reliability(calibration: pl.DataFrame) -> Drawing:
    """Draw rows of `schemas.comparisons.CALIBRATION`, one panel for each run: the last horizon with its interval."""
    rows = calibration.filter(pl.col("seconds") == pl.col("seconds").max())
    runs = rows["run"].unique(maintain_order=True).to_list()
    seconds = rows["seconds"][0]
    level = alt.X("level:Q", title="probability of the region", scale=fix_scale(0, 1), axis=alt.Axis(format="%"))
    held = alt.Axis(format="%")
    panels = []
    for run in runs:
        own = name_rows("rows", f"datum.run === {run!r}")
        line = own.mark_line(color=BLUE, point=alt.OverlayMarkDef(color=BLUE, size=28)).encode(
            level, alt.Y("coverage:Q", title="true positions within", scale=fix_scale(0, 1), axis=held)
        )
        band = own.mark_area(color=BLUE, opacity=0.2).encode(level, alt.Y("low:Q", title=""), alt.Y2("high:Q"))
        ideal = name_rows("ideal").mark_line(color=MUTED, strokeDash=[6, 4]).encode(level, alt.Y("level:Q", title=""))
        panels.append(alt.layer(line, band, ideal).properties(width=SIZE, height=SIZE, title=f"{run}, {seconds:g} s"))
    lines = [alt.hconcat(*panels[first : first + COLUMNS]) for first in range(0, len(panels), COLUMNS)]
    columns = ("run", "level", "coverage", "low", "high")
    return Drawing(
        alt.vconcat(*lines), {"rows": rows.select(columns).to_dicts(), "ideal": [{"level": 0}, {"level": 1}]}
    )
