"""The page of the splits: what it says of a split that shares frames and of one that does not."""

import re

import pytest

from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.pages.splits import SPLITS_PAGE, compare_splits, name_shifts

CSP, BALANCED = "csp-2018", "flow-balanced"
PAIR = {"dataset": "highd", "part": "train", "other_part": "eval"}


def recipe(split, *, trains, claims):
    return {"split": split, "meaning": f"how {split} <divides>", "claims_no_leakage": claims, "trains": trains,
            "window_s": 8.0, "digest": "abc", "parameters": '{"name": "x", "seed": 3}'}  # fmt: skip


def part_of(split, part, **values):
    known = {"split": split, "dataset": "highd", "part": part}
    return {**known, "subsets": 1, "vehicles": 2, "vehicle_share": 0.5, "samples": 3, "vehicles_per_lane_s_mean": 0.1,
            "vehicles_per_lane_s_std": 0.0, "relaxed": False, **values}  # fmt: skip


@pytest.fixture
def tables(small_lake):
    """flow-balanced shares nothing; csp-2018 shares 3 of 4 frames and 1 of 2 scenes, and cuts 5 + 1 of 8 neighbors."""
    nothing = {"vehicles_shared": 0, "frames_shared": 0, "scenes_shared": 0, "context_shared": 0}
    held = {"vehicles": 5, "frames": 4, "scenes": 2, "context": 20}
    shift = {"mean": 0.1, "other_mean": 0.2, "std": 0.01, "other_std": 0.02}
    counted = {"split": "flow-balanced", "dataset": "highd", "part": "eval", "samples": 9, "neighbors": 8}
    row = small_lake["splits"][0]
    return {
        **small_lake,
        "splits": [row, {**row, "split": "csp-2018", "first_vehicle_id": 1, "last_vehicle_id": 1}],
        "split_balance": [part_of(split, part) for split in (CSP, BALANCED) for part in ("train", "eval")],
        "split_recipes": [
            recipe("csp-2018", trains=False, claims=False),
            recipe("flow-balanced", trains=True, claims=True),
        ],
        "split_leakage": [
            {"split": "flow-balanced", **PAIR, **nothing, **held},
            {"split": "csp-2018", **PAIR, **nothing, **held, "frames_shared": 3, "scenes_shared": 1, "nearest_s": 0.0},
            {"split": "csp-2018", **PAIR, "other_part": "val", **nothing, **held, "frames_shared": 4, "nearest_s": 0.0},
        ],
        "split_context": [
            {**counted, "neighbors_elsewhere": 0, "neighbors_left_out": 0},
            {**counted, "split": "csp-2018", "neighbors_elsewhere": 5, "neighbors_left_out": 1},
        ],
        "split_shifts": [
            {"split": split, **PAIR, "quantity": quantity, **shift, "shift": value}
            for split, values in ((CSP, (0.01, 0.02, 0.03, 0.04, 0.05)), (BALANCED, (0.1, 0.2, 0.3, 0.25, 0.5)))
            for quantity, value in zip(("vehicles_per_lane_s", "speed", "left", "right", "brake"), values, strict=True)
        ],
        "split_left_out": [
            {"split": "csp-2018", "dataset": "highd", "subset": "01-lower", "vehicle_id": vehicle, "entries": 100}
            for vehicle in (1, 2)
        ],
    }  # fmt: skip


def test_side_by_side_stands_evaluation_beside_training(open_lake, tables):
    splits = build_report(open_lake(**tables), {}).quality["splits"]
    balanced, csp = compare_splits(splits)
    assert (balanced["split"], csp["split"]) == ("flow-balanced", "csp-2018"), "the one that is trained on comes first"
    assert (csp["frames_share"], csp["scenes_share"], csp["vehicles_share"]) == (0.75, 0.5, 0.0)
    assert (csp["cut_share"], balanced["cut_share"]) == (0.75, 0.0)
    assert (csp["left_out"], balanced["left_out"]) == (2, 0)
    assert splits["left_out"] == [{"split": "csp-2018", "dataset": "highd", "vehicles": 2, "entries": 200}]
    # Of lane changes to the left and to the right the greater.
    assert [row["lane_change_shift"] for row in (balanced, csp)] == [0.3, 0.04]
    assert [row["brake_shift"] for row in (balanced, csp)] == [0.5, 0.05]
    assert [row["nearest_s"] for row in (balanced, csp)] == [None, 0.0]


def test_the_page_says_why_one_flatters_and_the_other_does_not(open_lake, tables):
    html = build_report(open_lake(**tables), {}).others[SPLITS_PAGE]
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", html))
    assert "csp-2018 of highd: in 75.00 % of the evaluation\u2019s frames training vehicles drive as well" in text
    assert "and 50.00 % of its moments give training samples, too; 75.00 % of its neighbors are cut off." in text
    assert "flow-balanced of highd shares no vehicle, frame, scene or neighbor." in text
    assert "flow-balanced of highd: in" not in text
    assert "2 vehicles of highd have entries in two parts; 200 entries of theirs" in text
    assert "how csp-2018 &lt;divides&gt;. It does not claim to be free of leakage." in text
    assert "recordings that follow one another in clock time are not compared" in text
    assert "Recipe abc: seed 3" in text
    assert html.count("<svg") == 4, "two that compare, and the flows of each split"


def test_a_recipe_without_parameters_says_so(open_lake, tables):
    bare = [{**row, "parameters": '{"name": "x"}'} for row in tables["split_recipes"]]
    html = build_report(open_lake(**{**tables, "split_recipes": bare}), {}).others[SPLITS_PAGE]
    assert html.count("Recipe <code>abc</code>, without parameters</p>") == 2


def test_the_overview_leads_there_and_shows_the_split_that_trains(open_lake, tables):
    report = build_report(open_lake(**tables), {})
    assert f'<a href="{SPLITS_PAGE}">' in report.html
    assert '<a href="index.html#splits">' in report.others[SPLITS_PAGE]
    section = report.html[report.html.index('<section id="splits">') :]
    assert "<h3>flow-balanced, highd</h3>" in section
    assert "<h3>csp-2018, highd</h3>" not in section


def test_no_splits_have_no_page(open_lake, small_lake):
    report = build_report(open_lake(**{**small_lake, "splits": [], "split_balance": []}), {})
    assert report.others.get(SPLITS_PAGE) is None
    assert SPLITS_PAGE not in report.html


def test_a_split_of_one_part_says_so(open_lake, tables):
    alone = {**tables, "split_leakage": [], "split_context": [], "split_shifts": [], "split_left_out": []}
    html = build_report(open_lake(**alone), {}).others[SPLITS_PAGE]
    assert "No split of this lake has both a training and an evaluation part." in html
    assert html.count("It has one part only.") == 2
    assert html.count("<svg") == 2


def test_the_speeds_of_the_parts_stand_in_both_units():
    row = {"quantity": "speed", "mean": 10.0, "other_mean": None, "std": 2.0, "other_std": 0.5, "shift": 0.25}
    brake = {**row, "quantity": "brake", "mean": 0.125}
    assert name_shifts([row, brake]) == [
        {**row, "quantity": "speed, m/s"},
        {**row, "quantity": "speed, km/h", "mean": 36.0, "std": 7.2, "other_std": 1.8},
        {**brake, "quantity": "share of samples that brake"},
    ]
