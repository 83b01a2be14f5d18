"""Every rule's own case, whatever rules there are: its entries laid out as a subset, prepared, judged and found."""

import polars as pl
import pytest
from rule_scenes import lay_out

from tracklake.quality_reports.rules.derived import prepare
from tracklake.quality_reports.rules.findings import find
from tracklake.quality_reports.rules.markdown import write_rules
from tracklake.quality_reports.rules.registry import RULES
from tracklake.schemas import TRACKS, VEHICLES


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_is_broken_by_those_entries_of_its_case_and_no_other(rule):
    case = rule.case
    entries = prepare(lay_out(case), rule.reads)
    broken = entries.select(rule.broken(rule.defaults)).to_series()
    assert tuple(broken.arg_true()) == case.breaks
    assert 0 < len(case.breaks) < entries.height, "a case has entries on either side of the threshold"
    found = find(entries, [rule])
    assert found["entries"].sum() == len(case.breaks)
    worst = entries.select(rule.measure(rule.defaults).cast(pl.Float64).alias("value"))["value"].gather(case.breaks)
    assert worst.null_count() == 0
    assert {worst.min(), worst.max()} >= {getattr(found["worst"], rule.extreme)()}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_case_says_all_that_its_rule_reads_but_what_is_usual(rule):
    """Every column that it names exists, and is one for every entry."""
    assert set(rule.case.entries) <= {*TRACKS.dtypes, *VEHICLES.dtypes}
    assert len({len(values) for values in rule.case.entries.values()}) == 1
    assert set(rule.case.entries) & set(rule.columns) or rule.case.lane_markings_m


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_the_documentation_shows_the_case(rule):
    section = write_rules().split(f"\n## {rule.name}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    assert [place for place, line in enumerate(lines) if line.endswith("| yes |")] == list(rule.case.breaks)
    assert rule.compared in section
