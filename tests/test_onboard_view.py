"""The page of the study of on-board views: its numbers are those of the table beside it."""

from pathlib import Path

import polars as pl
from study_onboard_page import draw_costs, render_page

DOCS = Path(__file__).parents[1] / "docs"


def test_the_pages_numbers_are_those_of_the_table():
    rows = pl.read_csv(DOCS / "onboard-view.csv")
    assert (DOCS / "onboard-view.md").read_text() == render_page(rows)
    # Twenty conditions of each model: penetration, LiDAR, receiver.
    assert rows.group_by("model").len()["len"].unique().to_list() == [20]
    assert draw_costs(rows).rows["missed"][0]["missed"] == 100 * rows["missed_share"][0]
