"""Verdicts on subsets and datasets: levels and reasons, by hand."""

import re

import pytest

from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.verdicts import BAD, CARE, GOOD, UNKNOWN, judge, rank_rules, rank_verdicts

WHERE = {"dataset": "highd", "subset": "01-lower"}
SUBSET = {**WHERE, "recording": "01", "entries": 100, "excluded": False, "excluded_reason": None}


def a_rule(name, severity, share):
    found = {**WHERE, "entries": round(100 * share), "entry_share": share}
    return {"name": name, "severity": severity, "subsets": [found], "total": found}


def counted(measure, found, expected):
    return {**WHERE, "recording": "01", "measure": measure, "found": found, "expected": expected} | {
        "found_share": found / expected if expected else None
    }


def judge_one(*, errors=0.0, rules=(), completeness=(), **subset):
    verdict, dataset = judge(
        [{**SUBSET, **subset}], [{**WHERE, "share_without_error": 1 - errors}], rules, completeness
    )
    assert (verdict["subset"], dataset["subset"], dataset["verdict"]) == ("01-lower", None, verdict["verdict"])
    return verdict["verdict"], verdict["reasons"]


def test_errors_decide():
    assert judge_one(errors=0.0099) == (GOOD, [])
    rules = [a_rule("overlap", "error", 0.02), a_rule("backward", "error", 0.03)]
    reason = "5.0% of the entries have an error (backward 3.0%, overlap 2.0%)"
    assert judge_one(errors=0.05, rules=rules) == (CARE, [reason])
    assert judge_one(errors=0.1)[0] == BAD


def test_warnings_ask_for_care_and_info_never_counts():
    assert judge_one(rules=[a_rule("jerk_flicker", "info", 0.95)]) == (GOOD, [])
    assert judge_one(rules=[a_rule("high_jerk", "warning", 0.09)]) == (GOOD, [])
    assert judge_one(rules=[a_rule("high_jerk", "warning", 0.9)]) == (CARE, ["90.0% of the entries break high_jerk"])


def test_what_is_missing_asks_for_care():
    whole = [counted("vehicles", 100, 100), counted("entries", 999, 1000), counted("vehicles_incomplete", 2, 1)]
    assert judge_one(completeness=whole) == (GOOD, [])
    excerpt = [*whole, counted("vehicles", 290, 2169)]
    assert judge_one(completeness=excerpt) == (CARE, ["290 of 2,169 announced vehicles are there"])
    assert judge_one(completeness=[counted("entries", 5, 0)]) == (GOOD, []), "nothing is announced"


def test_an_excluded_subset_is_not_usable_and_the_gravest_reason_comes_first():
    verdict, reasons = judge_one(errors=0.05, excluded=True, excluded_reason="3 of 9 vehicles reverse")
    assert (verdict, reasons[0]) == (BAD, "excluded: 3 of 9 vehicles reverse")
    assert len(reasons) == 2


def test_nothing_is_said_of_a_subset_before_validation():
    verdict, dataset = judge([{**SUBSET, "excluded": None}], [], [], [])
    assert (verdict["verdict"], verdict["error_share"]) == (UNKNOWN, None)
    assert verdict["reasons"] == ["validation has not run"]
    assert dataset["verdict"] == UNKNOWN


def test_a_dataset_sums_up_its_subsets():
    upper = {**SUBSET, "subset": "01-upper", "entries": 300}
    scores = [{**WHERE, "share_without_error": 0.96}, {**upper, "share_without_error": 1.0}]
    *subsets, dataset = judge([SUBSET, upper], scores, [], [])
    assert [row["verdict"] for row in subsets] == [CARE, GOOD]
    assert dataset == {
        "dataset": "highd",
        "subset": None,
        "verdict": CARE,
        "entries": 400,
        "error_share": pytest.approx(4 / 400),
        "reasons": ["1 of 2 subsets is usable", "1 of 2 subsets is usable with care"],
    }
    assert [row["subset"] for row in rank_verdicts([*subsets, dataset])] == ["01-lower", "01-upper"]


def test_rules_stand_by_severity_and_then_by_entries():
    shares = (("a", "info", 0.9), ("b", "warning", 0.1), ("c", "error", 0.01), ("d", "error", 0.02))
    rules = [a_rule(*rule) for rule in shares]
    assert [rule["name"] for rule in rank_rules(rules)] == ["d", "c", "b", "a"]


def test_the_first_screen_answers_and_every_figure_leads_on(report):
    html = report.html
    first = html[: html.index("<main>")]
    assert re.search(r'<strong>highd</strong> <span class="tag [a-z]+">not usable</span>', first)
    assert "2 of 2 subsets are not usable" in first
    # A mark for every subset leads to its page.
    marks = re.findall(r'<a href="subsets/([^"]+)" aria-label="([^"]+)">', first)
    assert [(page, title.split(",")[0]) for page, title in marks] == [
        ("01-lower.html", "01-lower: not usable"),
        ("01-upper.html", "01-upper: not usable"),
        ("peachtree-north.html", "peachtree-north: not usable"),
    ]
    figures = re.search(r'<dl class="figures">.*?</dl>', html, flags=re.DOTALL).group()
    assert figures.count("<dd>") == figures.count('<dd><a href="#') == 9
    assert html.index(">backward</a>") < html.index(">high_acceleration</a>") < html.index(">jerk_flicker</a>")


def test_verdicts_are_for_programs_as_well(open_lake, small_lake):
    verdicts = build_report(open_lake(**small_lake), {}).quality["verdicts"]
    assert [(row["dataset"], row["subset"]) for row in verdicts[-2:]] == [("highd", None), ("ngsim", None)]
