"""Two small lakes compared: every kind of difference, against what was changed by hand, and none elsewhere."""

import copy
import re

import pytest
from page_elements import HOSTILE, drop_script, parse

from tracklake.quality_reports.pages.comparison import (
    MINUS,
    describe_sides,
    format_difference,
    format_value,
    judge_change,
    render_comparison,
    summarise,
)
from tracklake.quality_reports.pages.lake_differences import Side, compare
from tracklake.quality_reports.pages.rendering import DASH

RULES = ("negative_headway", "backward", "high_acceleration")
LOWER, UPPER = {"dataset": "highd", "subset": "01-lower"}, {"dataset": "highd", "subset": "01-upper"}
SCORES = [{"model": "constant-velocity", "part": "eval", "rows": [{"seconds": 1, "rmse_m": 0.5, "n": 40}]}]


def pair(then, now, difference=None) -> dict:
    return {"then": then, "now": now, "difference": difference}


@pytest.fixture
def tables(small_lake) -> dict[str, list[dict]]:
    """A copy of the small lake, to be changed."""
    return copy.deepcopy(small_lake)


@pytest.fixture
def against(open_lake, small_lake):
    """Compare the small lake (then) with one of other tables (now)."""

    def compare_with(tables: dict[str, list[dict]], then: dict | None = None, now: dict | None = None) -> dict:
        usual = {"facts": {"lake": "x"}, "rules": RULES, "scores": SCORES}
        return compare(
            Side(open_lake(**small_lake), **{**usual, **(then or {})}),
            Side(open_lake(**tables), **{**usual, **(now or {})}),
        )

    return compare_with


def found(compared: dict) -> dict[str, list]:
    """What differs, by part, of what holds only differences; the headline's rows that do."""
    parts = {"headline": [row for row in compared["headline"] if row["then"] != row["now"]]}
    parts["made_with"] = compared["made_with"]
    for name, part in compared.items():
        if isinstance(part, dict) and "changed" in part:
            parts |= {f"{name}.{kind}": rows for kind, rows in part.items() if kind not in ("same", "totals")}
    return {name: rows for name, rows in parts.items() if rows}


def test_equal_lakes_are_said_to_be_equal(against, tables):
    reversed_rows = {name: rows[::-1] for name, rows in tables.items()}
    compared = against(reversed_rows)
    assert compared["equal"] is True
    assert found(compared) == {}
    assert compared["subsets"]["same"] == 3
    # Three rules in three subsets; the files of the two recordings and the one that was ingested.
    assert (compared["rules"]["same"], compared["files"]["same"]) == (9, 3)
    assert (compared["samples"]["same"], compared["splits"]["same"], compared["evaluation"]["same"]) == (1, 1, 1)
    assert "Nothing differs" in render_comparison(compared)


def test_empty_lakes_are_equal_and_an_empty_one_differs(open_lake, small_lake):
    empty = Side(open_lake(), {"lake": "empty"})
    assert compare(empty, empty)["equal"] is True
    compared = compare(empty, Side(open_lake(**small_lake), {"lake": "x"}, RULES))
    assert compared["equal"] is False
    assert [row["subset"] for row in compared["subsets"]["only_now"]] == ["01-lower", "01-upper", "peachtree-north"]
    assert compared["rules"]["only_now"] == list(RULES)
    assert compared["rules"]["changed"] == [], "no subset is of both"
    parse(render_comparison(compared))


def test_findings_are_compared_per_subset_and_rule(against, tables):
    # 01-lower's headway findings: two of vehicle 1, an entry each. Now one of them is of vehicle 2, and 5 entries long.
    tables["findings"][1] |= {"vehicle_id": 2, "entries": 5}
    compared = against(tables)
    changed = {"findings": pair(2, 2, 0), "vehicles": pair(1, 2, 1), "entries": pair(2, 6, 4)}
    assert found(compared) == {
        "headline": [{"figure": "vehicles_with_errors", **pair(2, 3, 1)}],
        "rules.changed": [{"rule": "negative_headway", **LOWER, **changed}],
    }
    assert compared["equal"] is False
    assert compared["rules"]["same"] == 8
    unchanged = pair(1, 1, 0)
    assert compared["rules"]["totals"] == [
        {"rule": "negative_headway", **changed},
        {"rule": "backward", "findings": unchanged, "vehicles": unchanged, "entries": unchanged},
        {"rule": "high_acceleration", **dict.fromkeys(("findings", "vehicles", "entries"), pair(0, 0, 0))},
    ]


def test_a_rule_that_was_not_checked_is_null_and_not_zero(against, tables):
    unchecked = tables["subset_scores"][1]["rules_unchecked"]
    tables["subset_scores"][1] |= {"rules_unchecked": ["backward"], "share_without_error": 1.0}
    compared = against(tables, then={"rules": RULES[:2]})
    assert compared["rules"]["only_now"] == ["high_acceleration"]
    rows = {(row["rule"], row["subset"]): row["entries"] for row in compared["rules"]["changed"]}
    assert rows == {
        ("backward", "01-upper"): pair(1, None),
        **{("high_acceleration", name): pair(None, 0) for name in ("01-lower", "01-upper", "peachtree-north")},
    }
    assert [(row["figure"], row["then"], row["now"]) for row in compared["subsets"]["changed"]] == [
        ("rules_unchecked", unchecked, ["backward"]),
        ("share_without_error", 0.5, 1.0),
    ]


def test_a_subset_of_one_lake_only_is_listed_and_not_compared(against, tables):
    for name, rows in tables.items():
        tables[name] = [row for row in rows if row.get("subset") != "01-lower"]
    compared = against(tables)
    assert compared["subsets"]["only_then"] == [LOWER]
    assert compared["subsets"]["only_now"] == []
    assert (compared["subsets"]["same"], compared["rules"]["same"]) == (2, 6)
    # Its rows of samples and splits are gone with it; what sums up a whole lake says so.
    assert compared["samples"]["changed"] == compared["splits"]["changed"] == compared["rules"]["changed"] == []
    drops = {(row["reason"], row["figure"]): (row["then"], row["now"]) for row in compared["sample_drops"]["changed"]}
    assert drops[("history", "entries")] == (4, None)
    head = {row["figure"]: row for row in compared["headline"]}
    assert (head["subsets"]["difference"], head["samples"]["now"], head["samples"]["difference"]) == (-1, None, None)


def test_a_changed_file_a_renamed_one_and_a_new_one(against, tables):
    tables["ingest_log"][0] |= {"sha256": "f" * 64, "rows_read": 4, "rows_kept": 2}
    for subset in tables["subsets"][:2]:
        subset["source_files"] = [{"file": "moved/01_tracks.csv", "sha256": subset["source_files"][0]["sha256"]}]
    tables["subsets"][2]["source_files"] = [
        *tables["subsets"][2]["source_files"],
        {"file": "more.csv", "sha256": "e" * 64},
    ]
    compared = against(tables)
    sha256 = {"dataset": "ngsim", "file": "peachtree.csv", "figure": "sha256"}
    files = {name.removeprefix("files."): rows for name, rows in found(compared).items() if name.startswith("files")}
    assert files == {
        "renamed": [{"dataset": "highd", "then": "01_tracks.csv", "now": "moved/01_tracks.csv"}],
        "only_now": [{"dataset": "ngsim", "file": "more.csv"}],
        "changed": [
            {**sha256, **pair("0123456789abcdef" * 4, "f" * 64)},
            {**sha256, "figure": "rows_read", **pair(3, 4, 1)},
            {**sha256, "figure": "rows_kept", **pair(1, 2, 1)},
        ],
    }


def test_samples_splits_and_what_was_announced(against, tables):
    tables["samples"] = tables["samples"][:2]
    tables["splits"] = [
        {**tables["splits"][0], "block": block, "part": part} for block, part in enumerate(("eval", "train", "eval"))
    ]
    tables["completeness"][2] |= {"found": 8, "agrees": True}
    compared = against(tables)
    # Kept: one of three vehicle-2 samples is gone (it braked), so 2 of 7 instead of 3 of 8; a neighbor per two samples.
    assert {row["figure"]: (row["then"], row["now"]) for row in compared["samples"]["changed"]} == {
        "samples": (3, 2),
        "vehicles": (2, 1),
        "kept_share": (0.375, pytest.approx(2 / 7)),
        "brake": (1, 0),
        "mean_neighbors": (pytest.approx(1 / 3), 0.5),
    }
    assert [(row["figure"], row["then"], row["now"]) for row in compared["splits"]["changed"]] == [
        ("part", "train", "train 1, eval 2"),
        ("blocks", 1, 3),
    ]
    assert [
        (row["measure"], row["figure"], row["then"], row["now"]) for row in compared["completeness"]["changed"]
    ] == [
        ("entries", "found", 6, 8),
        ("entries", "agrees", False, True),
    ]


def test_settings_versions_and_scores(against, tables):
    made = {"validate": {"thresholds": {"a_m": 1.0, "b_m": 2.0}}, "ingest": {"tracklake": "0.1.0"}}
    later = {"validate": {"thresholds": {"a_m": 1.5, "b_m": 2.0}}, "ingest": {"tracklake": "0.1.0", "new": True}}
    rows = [{"seconds": 1, "rmse_m": 0.25, "n": 40}, {"seconds": 2, "rmse_m": None, "n": 0}]
    compared = against(tables, {"made_with": made}, {"made_with": later, "scores": [{**SCORES[0], "rows": rows}]})
    model = {"model": "constant-velocity", "part": "eval"}
    assert found(compared) == {
        "made_with": [
            {"name": "validate.thresholds.a_m", "then": 1.0, "now": 1.5},
            {"name": "ingest.new", "then": None, "now": True},
        ],
        "evaluation.changed": [
            {**model, "seconds": 1, "figure": "rmse_m", **pair(0.5, 0.25, -0.25)},
            {**model, "seconds": 2, "figure": "n", **pair(None, 0)},
        ],
    }


def test_what_differs_in_the_last_digits_only_is_the_same(against, tables):
    nearly = [{**SCORES[0], "rows": [{"seconds": 1, "rmse_m": 0.5 * (1 + 1e-9), "n": 40}]}]
    assert against(tables, now={"scores": nearly})["equal"] is True
    more = [{**SCORES[0], "rows": [{"seconds": 1, "rmse_m": 0.5 * (1 + 1e-7), "n": 40}]}]
    assert against(tables, now={"scores": more})["equal"] is False


def test_the_other_way_round_every_difference_has_the_other_sign(open_lake, small_lake, tables):
    tables["findings"][1] |= {"vehicle_id": 2, "entries": 5}
    tables["samples"] = tables["samples"][:2]
    tables["ingest_log"][0] |= {"file": "other.csv", "sha256": "f" * 64}
    one, other = (Side(open_lake(**each), {"lake": "x"}, RULES) for each in (small_lake, tables))
    there, back = compare(one, other), compare(other, one)
    for name in ("subsets", "files", "samples", "splits", "split_balance"):
        turned = [
            {**row, "then": row["now"], "now": row["then"], "difference": row["difference"] and -row["difference"]}
            for row in back[name]["changed"]
        ]
        assert there[name]["changed"] == turned, name
    assert there["samples"]["changed"]
    assert there["files"]["only_then"] == back["files"]["only_now"] == [{"dataset": "ngsim", "file": "peachtree.csv"}]
    (row,), (turned,) = there["rules"]["changed"], back["rules"]["changed"]
    assert (row["entries"], turned["entries"]) == (pair(2, 6, 4), pair(6, 2, -4))


def test_the_page_shows_every_change_and_fetches_nothing(against, tables):
    tables["findings"][1] |= {"vehicle_id": 2, "entries": 1234}
    tables["subsets"][0]["vehicles"] = 1
    html = render_comparison(against(tables, now={"facts": {"lake": "new"}}), report="index.html")
    page = parse(html).elements
    assert "<title>What changed: new against x · tracklake</title>" in html
    changed = '<td class="n">2</td><td class="n">1,235</td><td class="n worse" title="worse">+1,233</td>'
    assert changed in html, "more findings"
    assert html.index('<section id="summary">') < html.index('<section id="figures">')
    assert "<code>vehicles</code></td>" in html
    links = [value for _, attributes in page for name, value in attributes.items() if name in ("src", "href")]
    assert [link for link in links if not link.startswith("#")] == ["index.html"]
    anchors = {attributes["id"] for _, attributes in page if "id" in attributes}
    assert {link[1:] for link in links if link.startswith("#")} <= anchors
    assert not re.search(r"@import|url\(|<script", drop_script(html))


def test_no_name_can_inject_markup(against, tables):
    for subset in tables["subsets"]:
        subset |= {"site": HOSTILE, "source_files": [{"file": HOSTILE, "sha256": HOSTILE}]}
    tables["ingest_log"][0]["file"] = HOSTILE
    facts = {"lake": HOSTILE, "lake_id": HOSTILE, "compared": HOSTILE}
    made = {"made_with": {HOSTILE: HOSTILE}, "facts": facts, "rules": [*RULES, HOSTILE]}
    html = render_comparison(against(tables, now=made), report="index.html")
    names = [name for name, _ in parse(html).elements]
    assert {"script", "img"} & set(names) == set()
    assert "\u202e" not in html


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, DASH),
        (True, "yes"),
        (12345, "12,345"),
        (-3, f"{MINUS}3"),
        (-0.5, f"{MINUS}0.5"),
        (1234.5678, "1,234.57"),
        (2289800.4, "2,289,800"),
        (["a", "b"], "a, b"),
    ],
)
def test_a_figure_of_any_kind_is_put_into_words(value, text):
    assert format_value(value) == text


@pytest.mark.parametrize(("difference", "text"), [(3, "+3"), (-3, f"{MINUS}3"), (0, ""), (None, ""), (0.25, "+0.25")])
def test_a_difference_has_a_sign(difference, text):
    assert format_difference({"difference": difference}) == text


@pytest.mark.parametrize(
    ("figure", "difference", "verdict"),
    [
        ("rmse_m", -0.1, "better"),
        ("rmse_m", 0.1, "worse"),
        ("findings", 2, "worse"),
        ("share_without_error", 0.1, "better"),
        ("samples", -1, "worse"),
        ("vehicles", 5, ""),
        ("rmse_m", None, ""),
        ("rmse_m", 0, ""),
    ],
)
def test_a_change_is_for_the_better_or_the_worse_where_a_side_is_better(figure, difference, verdict):
    assert judge_change({"difference": difference}, figure) == verdict


def test_the_summary_counts_the_differences_of_every_part(against, tables):
    tables["findings"][1] |= {"vehicle_id": 2, "entries": 5}
    tables["samples"] = tables["samples"][:2]
    rows = {row["name"]: row for row in summarise(against(tables))}
    # Findings: 2 entries became 6. Samples: fewer of them and a smaller share kept are worse; vehicles, braking and
    # neighbors have no better side.
    assert rows["findings"] == {
        "name": "findings", "anchor": "rules", "changed": 1, "only": 0, "better": 0, "worse": 1,
    }  # fmt: skip
    assert (rows["samples"]["changed"], rows["samples"]["worse"], rows["samples"]["better"]) == (5, 2, 0)


@pytest.mark.parametrize(
    ("now", "then", "banner"),
    [
        (None, None, None),
        ("No figures of highD.", "No figures of highD.", "No figures of highD."),
        ("Synthetic data: A.", None, "Now: Synthetic data: A."),
        ("Synthetic data: A.", "Synthetic data: B.", "Now: Synthetic data: A. Then: Synthetic data: B."),
    ],
)
def test_what_is_synthetic_on_both_sides_is_said_once_in_the_same_letters(now, then, banner):
    sides = {"now": {"synthetic": now}, "then": {"synthetic": then}}
    assert describe_sides(sides) == banner


def test_the_summary_names_other_settings_although_no_figure_differs(against, tables):
    compared = against(tables)
    compared["made_with"] = [{"name": "validate.thresholds.high_jerk_mps3", "then": 15.0, "now": 14.0}]
    assert summarise(compared)[0]["name"] == "settings and versions"
    assert summarise(compared)[0]["changed"] == 1


def test_speeds_stand_in_km_per_hour_beside_metres_per_second(against, tables):
    compared = against(tables)
    row = {"dataset": "highd", "subset": "01-upper", "figure": "mean_speed_mps", **pair(10.0, 12.5, 2.5)}
    compared["subsets"]["changed"] = [row]
    html = render_comparison(compared)
    assert '<td class="n">10 <small>36 km/h</small></td><td class="n">12.5 <small>45 km/h</small></td>' in html
    assert ">+2.5 <small>9 km/h</small></td>" in html
