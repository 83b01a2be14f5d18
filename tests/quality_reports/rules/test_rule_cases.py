"""Every rule's own case, whatever rules there are: its entries laid out as a subset, prepared, judged and found."""

import polars as pl
import pytest

from tracklake.quality_reports.rules.derived import prepare
from tracklake.quality_reports.rules.evaluate import tracks_needed
from tracklake.quality_reports.rules.findings import find
from tracklake.quality_reports.rules.markdown import write_rules
from tracklake.quality_reports.rules.registry import RULES
from tracklake.quality_reports.rules.rule import Case
from tracklake.quality_reports.rules.scene import VEHICLE_COLUMNS, Scene
from tracklake.schemas import TRACKS, VEHICLES


def lay_out(case: Case) -> Scene:
    """The subset that a case describes, with what it leaves out."""
    height = len(next(iter(case.entries.values())))
    usual = {
        "dataset": ["highd"] * height, "subset": ["01-upper"] * height, "vehicle_id": list(range(1, height + 1)),
        "frame": [1] * height, "x_m": [0.0] * height, "y_m": [0.0] * height, "lane": [1] * height,
        "speed_mps": [20.0] * height, "accel_mps2": [0.0] * height, "length_m": [4.0] * height,
        "width_m": [2.0] * height, "class": ["car"] * height,
    }  # fmt: skip
    said = usual | {name: list(values) for name, values in case.entries.items()}
    tracks = {name: said.get(name, [None] * height) for name in tracks_needed()}
    vehicles = {name: said[name] for name in ("vehicle_id", *VEHICLE_COLUMNS)}
    return Scene(
        pl.DataFrame(tracks, schema={name: TRACKS.dtypes[name] for name in tracks}),
        pl.DataFrame(vehicles, schema={name: VEHICLES.dtypes[name] for name in vehicles})
        .unique("vehicle_id")
        .sort("vehicle_id"),
        case.frame_rate_hz,
        case.lane_markings_m,
    )


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
