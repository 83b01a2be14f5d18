"""How good the repair windows are, as the report shows it: sums over subsets and positions, by hand."""

import re

import pytest

from tracklake.quality_reports.pages.assessments import tabulate_assessments
from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.plots import charts as plots
from tracklake.schemas.start_assessments import ESTIMATORS

LOWER = {"dataset": "highd", "subset": "01-lower"}
UPPER = {"dataset": "highd", "subset": "01-upper"}
NGSIM = {"dataset": "ngsim", "subset": "peachtree-north"}
FIGURES = ("starts", "starts_covered", "frames_missing", "frames_covered", "frames_excess", "error_mean_s")


def assessed(where, beyond_m, estimator, *figures):
    """A row of `start_assessments`; the shares per row are not what the report adds up."""
    return {**where, "estimator": estimator, "beyond_m": beyond_m, **dict(zip(FIGURES, figures, strict=True))}


@pytest.fixture(scope="module")
def assessed_report(open_lake, small_lake):
    """Frames at 25 Hz of the two carriageways (250 missing are 10 s), and at 10 Hz of another subset (100: 10 s)."""
    rows = [
        assessed(LOWER, 20.0, "regression", 4, 3, 150, 125, 50, 0.5),
        assessed(LOWER, 40.0, "regression", 2, 1, 100, 75, 25, -1.0),
        assessed(UPPER, 20.0, "regression", 1, 1, 250, 250, 0, 2.0),
        assessed(NGSIM, 20.0, "regression", 3, 0, 100, 50, 40, 0.0),
        assessed(LOWER, 20.0, "no_margin", 4, 0, 150, 75, 0, 0.5),
    ]
    # Every estimator is measured on the same cut tracks.
    rows += [{**row, "estimator": name} for name in ("mean_speed", "local_regression") for row in rows[:4]]
    rows += [{**row, "estimator": "no_margin"} for row in rows[1:4]]
    return build_report(open_lake(**small_lake, start_assessments=rows), {})


def only(rows, **wanted):
    (row,) = (row for row in rows if all(row[key] == value for key, value in wanted.items()))
    return row


def test_sums_over_positions_subsets_and_data_sets(assessed_report):
    rows = assessed_report.quality["starts"]["assessed"]["subsets"]
    assert len(rows) == 4 * (3 + 2 + 1)
    lower = only(rows, subset="01-lower", estimator="regression")
    assert (lower["starts"], lower["missing_s"]) == (6, 10.0)
    assert lower["starts_covered_share"] == pytest.approx(4 / 6)
    assert (lower["coverage"], lower["excess"]) == (0.8, 0.3)
    assert lower["mean_excess_s"] == 0.5
    assert lower["mean_error_s"] == 0
    of_highd = only(rows, dataset="highd", subset=None, estimator="regression")
    assert (of_highd["starts"], of_highd["missing_s"], of_highd["coverage"]) == (7, 20.0, 0.9)
    assert (of_highd["excess"], of_highd["mean_error_s"]) == (0.15, pytest.approx(2 / 7, rel=1e-9))
    everything = only(rows, dataset=None, estimator="regression")
    assert everything["missing_s"] == 30.0, "seconds, whatever the rate"
    assert everything["coverage"] == pytest.approx((8 + 10 + 5) / 30)
    assert everything["excess"] == pytest.approx((3 + 0 + 4) / 30)
    assert only(rows, subset="01-lower", estimator="no_margin")["coverage"] == pytest.approx((75 + 75) / 250)
    assert [row["estimator"] for row in rows[:4]] == list(ESTIMATORS)


def test_sums_per_start_position(assessed_report):
    rows = assessed_report.quality["starts"]["assessed"]["positions"]
    assert [(row["dataset"], row["beyond_m"]) for row in rows[::4]] == [("highd", 20), ("highd", 40), ("ngsim", 20)]
    near = only(rows, dataset="highd", beyond_m=20.0, estimator="regression")
    assert (near["starts"], near["missing_s"], near["coverage"]) == (5, 16.0, 375 / 400)
    assert near["excess"] == 50 / 400
    assert near["mean_error_s"] == pytest.approx((4 * 0.5 + 2.0) / 5)


def test_the_page_shows_them_side_by_side(assessed_report):
    section = re.search(r'<section id="starts">.*?</section>', assessed_report.html, flags=re.DOTALL).group()
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r"<svg.*?</svg>", "", section, flags=re.DOTALL)))
    assert "On 10 cut tracks the windows cover 76.67 % of the missing time" in text
    assert "exclude 23.33 % of it, 0.70 s per start" in text
    assert "The estimate is 0.20 s too long on average" in text
    assert "01-lower 6 10.0 80.00 % 30.00 % 80.00 % 30.00 % 60.00 % 10.00 % 80.00 % 30.00 %" in text
    assert "all of highd 7 20.0 90.00 % 15.00 %" in text
    assert "40 highd 2 4.0 75.00 % 25.00 %" in text
    for title in ("start beyond the cut-off (m)", "covered (% of missing time)", "excess (% of missing time)"):
        assert title in section
    style = re.search(r"<style>(.*?)</style>", assessed_report.html, flags=re.DOTALL).group(1)
    drawing = plots.draw_assessments(assessed_report.quality["starts"]["assessed"]["positions"])
    used = set(re.findall(r"(?:fill|stroke)=\"([^\"]+)\"", drawing)) - {"none", "transparent"}
    assert {plots.BLUE, plots.ORANGE, plots.GREEN, plots.MUTED} <= used
    assert all(f'[fill="{colour}"]' in style for colour in used), "the same on light and dark"
    assert drawing.count(">highd<") == drawing.count(">ngsim<") == 2


def test_one_position_can_be_drawn_and_nothing_missing_too():
    row = {"dataset": "highd", "beyond_m": 20.0, "estimator": "regression", "coverage": None, "excess": None}
    assert plots.draw_assessments([row]).startswith("<svg")


def test_estimators_stand_beside_one_another(assessed_report):
    tables = tabulate_assessments(assessed_report.quality["starts"]["assessed"])
    assert [row["subset"] for row in tables["subsets"]] == ["01-lower", "01-upper", None, "peachtree-north", None]
    assert all(list(row["estimators"]) == list(ESTIMATORS) for row in tables["subsets"] + tables["positions"])
    assert tables["overall"]["regression"]["missing_s"] == 30.0


def test_without_an_assessment_the_page_says_how_to_get_one(report):
    assert report.quality["starts"]["assessed"] == {"subsets": [], "positions": []}
    assert "<code>tracklake repair --assess</code> has not been run" in report.html
