"""The page of the study of on-board views: its numbers are those of the table beside it."""

from pathlib import Path

import polars as pl
from study_onboard_page import MODEL, SPREAD, VEHICLES, draw_costs, render_page

DOCS = Path(__file__).parents[1] / "docs"


def test_the_pages_numbers_are_those_of_the_table():
    rows = pl.read_csv(DOCS / "onboard-view.csv")
    assert (DOCS / "onboard-view.md").read_text() == render_page(rows)
    # Twenty conditions of each group of egos and model: penetration, LiDAR, receiver.
    assert rows.group_by("group", "model").len()["len"].to_list() == [20] * 6
    assert draw_costs(rows).rows[f"missed-{SPREAD}"][0]["missed"] == 100 * rows["missed_share"][0]


def test_every_figure_lies_within_its_interval():
    rows = pl.read_csv(DOCS / "onboard-view.csv")
    for name in (*VEHICLES, *MODEL):
        known = rows.filter(pl.col(name).is_not_null())
        assert known.select((pl.col(f"{name}_low") <= pl.col(name)).all()).item(), name
        assert known.select((pl.col(name) <= pl.col(f"{name}_high")).all()).item(), name
