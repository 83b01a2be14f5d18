"""The reliability plot: one panel per run, of its last horizon, three side by side."""

import polars as pl

from tracklake.quality_reports.plots.reliability import draw_reliability

LEVELS = ((0.5, 0.4), (0.9, 0.8))


def tabulate(*runs):
    rows = [
        {"run": run, "seconds": seconds, "level": level, "coverage": held - seconds / 100, "low": 0.1, "high": 0.9}
        for run in runs
        for seconds in (1.0, 5.0)
        for level, held in LEVELS
    ]
    return pl.DataFrame(rows)


def test_each_run_has_a_panel_of_its_last_horizon():
    drawing = draw_reliability(tabulate("a", "b", "c", "d"))
    chart = drawing.to_vega_lite()
    titles = [[panel["title"] for panel in line["hconcat"]] for line in chart["vconcat"]]
    assert titles == [["a, 5 s", "b, 5 s", "c, 5 s"], ["d, 5 s"]]
    first = [row for row in drawing.rows["rows"] if row["run"] == "a"]
    assert [(row["level"], round(row["coverage"], 9)) for row in first] == [(0.5, 0.35), (0.9, 0.75)]
    assert len(drawing.rows["rows"]) == 8
    assert b"<svg" in drawing.render(".svg")
