"""The page of the study of on-board views: its numbers are those of the table beside it."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from study_onboard import choose_due
from study_onboard_page import (
    FIGURES,
    MODEL,
    SPREAD,
    VEHICLES,
    draw_costs,
    judge_differences,
    list_differences,
    render_page,
)
from study_onboard_scores import Figure, bound_difference

DOCS = Path(__file__).parents[1] / "docs"
NAMES = ("rmse_m", "rmse_m_low", "rmse_m_high")


def test_the_pages_numbers_are_those_of_the_table():
    rows = pl.read_csv(DOCS / "onboard-view.csv")
    assert (DOCS / "onboard-view.md").read_text() == render_page(rows)
    # Twenty conditions of each group of egos and model: penetration, LiDAR, receiver.
    assert rows.group_by("group", "model").len()["len"].to_list() == [20] * 6
    first = draw_costs(rows).rows[f"missed: {SPREAD}"][0]
    for end in ("", "_low", "_high"):
        assert first[f"value{end}"] == 100 * rows[f"missed_share{end}"][0]


def test_every_figure_lies_within_its_interval():
    rows = pl.read_csv(DOCS / "onboard-view.csv")
    for name in (*VEHICLES, *MODEL, *list_differences(FIGURES)):
        known = rows.filter(pl.col(name).is_not_null())
        assert known.select((pl.col(f"{name}_low") <= pl.col(name)).all()).item(), name
        assert known.select((pl.col(name) <= pl.col(f"{name}_high")).all()).item(), name


def test_a_view_is_called_worse_or_better_only_where_the_interval_excludes_zero():
    rows = pl.DataFrame(
        {
            "added_rmse_m": [1.0, 2.0, -1.0, 0.5, 0.25, None],
            "added_rmse_m_low": [0.5, 0.01, -2.0, -0.1, 0.0, None],
            "added_rmse_m_high": [1.5, 3.0, -0.5, 1.0, 0.5, None],
        }
    )
    assert judge_differences(rows, "added_rmse_m") == "worse in 2, better in 1, open in 2 (-1.00 to +2.00)"
    assert judge_differences(rows[3:], "added_rmse_m") == "open in 2 (+0.25 to +0.50)"
    assert judge_differences(rows[5:], "added_rmse_m") == "too few vehicles"


def test_differences_are_of_what_both_views_have():
    vehicles = np.array([f"vehicle {number}" for number in range(8)])
    # Squared errors of samples 0 to 6 and 1 to 7: both have 1 to 6, each with 4 m2 before and 9 m2 after.
    before = Figure(np.array([100.0, *[4.0] * 6]), vehicles[:7], np.arange(7))
    after = Figure(np.array([*[9.0] * 6, 100.0]), vehicles[1:], np.arange(1, 8))
    assert bound_difference("rmse_m", before, after) == pytest.approx(dict.fromkeys(NAMES, 1.0))
    fewer = Figure(after.values[:5], after.vehicles[:5], after.at[:5])
    assert bound_difference("rmse_m", before, fewer) == dict.fromkeys(NAMES), "five vehicles are too few"


def test_an_interval_of_a_difference_draws_the_same_vehicles_for_both():
    random = np.random.default_rng(5)
    vehicles = np.repeat([f"vehicle {number}" for number in range(30)], 4)
    values = np.repeat(random.normal(0, 100, 30), 4)
    # Vehicles differ by far more than the views do: with other vehicles for each view, the interval would hold zero.
    found = bound_difference("nll_nats", Figure(values, vehicles), Figure(values + 1, vehicles))
    assert found == pytest.approx(dict.fromkeys(("nll_nats", "nll_nats_low", "nll_nats_high"), 1.0))


def test_egos_that_turn_faster_than_a_car_can_are_not_chosen():
    found = pl.DataFrame(
        {
            "dataset": ["ngsim", "highd", "highd"],
            "subset": ["us-101", "03-upper", "03-upper"],
            "vehicle_id": [97, 69, 70],
            "first_tick": [0, 10, 0],
            "last_tick": [239, 149, 149],
            "turn_deg": [34.3, 1.3, 1.3],
            "moments": [9, 4, 0],
            "first": [135, 60, None],
            "last": [160, 75, None],
        }
    )
    ego = choose_due(found, 3)
    # Of 69 alone: 40 ticks before 10 + 60, to 40 after 10 + 75.
    assert [(each.vehicle_id, each.first_tick, each.last_tick) for each in ego] == [(69, 30, 125)]
