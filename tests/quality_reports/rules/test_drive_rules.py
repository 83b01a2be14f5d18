"""Rules for drives: their cases, positions of messages against a slow obvious computation, runs and counts."""

import math

import polars as pl
import pytest
from drive_rows import DRIVE, lay_out_case, make_rows
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.rules.along_messages import DRIVE_READS, place_messages, prepare_messages
from tracklake.quality_reports.rules.drive_findings import TICK_COLUMNS, Drive, find_runs, judge_drive
from tracklake.quality_reports.rules.markdown import write_rules
from tracklake.quality_reports.rules.registry import ALL_RULES, DRIVE_RULES, RULES, resolve, select_thresholds
from tracklake.schemas import BSM, DRIVE_CHECKS, DRIVE_FINDINGS, EGO_STATES, SURROUNDING

BY_NAME = {rule.name: rule for rule in DRIVE_RULES}


@pytest.mark.parametrize("rule", DRIVE_RULES, ids=lambda rule: rule.name)
def test_a_drive_rule_is_broken_by_those_rows_of_its_case_and_no_other(rule):
    rows = lay_out_case(rule)
    broken = rows.select(rule.broken(rule.defaults)).to_series()
    assert tuple(broken.arg_true()) == rule.case.breaks
    assert 0 < len(rule.case.breaks) < rows.height
    assert find_runs(rows, rule, rule.defaults)["entries"].sum() == len(rule.case.breaks)
    section = write_rules().split(f"\n## {rule.name}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    assert [place for place, line in enumerate(lines) if line.endswith("| yes |")] == list(rule.case.breaks)


def test_drive_rules_read_declared_columns_and_share_no_name():
    placed = {*SURROUNDING.dtypes, "message_x_m", "message_y_m"}
    for rule in DRIVE_RULES:
        assert set(rule.columns) <= (set(BSM.dtypes) if rule.over == "messages" else placed)
        assert {*rule.reads} <= {*DRIVE_READS}
    assert len({rule.name for rule in ALL_RULES}) == len(ALL_RULES)
    assert len(resolve(ALL_RULES)) == sum(len(rule.thresholds) for rule in ALL_RULES)


def test_thresholds_of_drives_do_not_reach_the_rules_over_tracks():
    overrides = {"message_latency_s": 0.2, "overlap_m": 1.0}
    assert select_thresholds(DRIVE_RULES, overrides) == {"message_latency_s": 0.2}
    assert "message_latency_s" not in resolve(RULES, select_thresholds(RULES, overrides))


def test_a_message_is_placed_ahead_and_to_the_right_of_the_ego():
    """On the equator 0.001 degrees are 110.574 m northwards and 111.319 m eastwards."""
    ticks = pl.DataFrame(
        {"vehicle_id": [1, 1, 1, 1, 1], "tick": [9, 10, 11, 20, 21]},
        schema_overrides={"tick": pl.Int32, "vehicle_id": pl.Int32},
    )
    sent = make_rows(
        BSM, time_s=[0.9], received_s=[0.95], lat_deg=[0.001], lon_deg=[0.0005], speed_mps=[20.0], heading_deg=[0.0]
    )
    ego = make_rows(EGO_STATES, time_s=[1.0, 2.0], speed_mps=[10.0, 0.0], heading_deg=[90.0, 90.0])
    placed = place_messages(ticks, sent, ego).select("message_x_m", "message_y_m").rows()
    # At tick 9 it has not arrived. Facing east: ahead is 55.66 m, to the right is southwards.
    assert placed[0] == (None, None)
    assert placed[1] == pytest.approx((55.6597, -(110.5743 + 2.0)), abs=1e-3)
    # 0.1 s later the ego has gone 1 m east, the vehicle 2 m further north.
    assert placed[2] == pytest.approx((54.6597, -(110.5743 + 4.0)), abs=1e-3)
    assert placed[3] == (None, None), "the message is older than 1 s"
    assert placed[4] == (None, None)


@settings(max_examples=30, deadline=None)
@given(
    ego_lat=st.floats(-60, 60),
    heading=st.floats(0, 359),
    ahead=st.floats(-100, 100),
    right=st.floats(-30, 30),
)
def test_a_placed_message_lies_where_the_ellipsoid_puts_it(ego_lat, heading, ahead, right):
    """Built the other way round: from metres to degrees, on the WGS-84 radii at the ego."""
    a, e2 = 6378137.0, 0.00669437999014
    turn, sine = math.radians(heading), math.sin(math.radians(ego_lat))
    north = ahead * math.cos(turn) - right * math.sin(turn)
    east = ahead * math.sin(turn) + right * math.cos(turn)
    meridian = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    parallel = a / math.sqrt(1 - e2 * sine**2) * math.cos(math.radians(ego_lat))
    sent = make_rows(
        BSM, time_s=[1.0], lat_deg=[ego_lat + math.degrees(north / meridian)], lon_deg=[math.degrees(east / parallel)]
    )
    ego = make_rows(EGO_STATES, time_s=[1.0], lat_deg=[ego_lat], heading_deg=[heading])
    ticks = pl.DataFrame({"vehicle_id": [1], "tick": [10]}, schema_overrides={"tick": pl.Int32, "vehicle_id": pl.Int32})
    assert place_messages(ticks, sent, ego).row(0)[2:] == pytest.approx((ahead, right), abs=2e-3)


def test_runs_are_messages_in_a_row_or_of_adjacent_ticks():
    """Latencies of 0.2 s break the rule; between the messages of ticks 0 and 30 none was received."""
    late, time = 0.2, [0.0, 0.01, 0.02, 3.0, 3.1, 3.5, 3.7]
    latency = [late, 0.0, late, late, 0.0, 0.0, late]
    rows = make_rows(BSM, time_s=time, received_s=[a + b for a, b in zip(time, latency, strict=True)])
    found = find_runs(prepare_messages(rows), BY_NAME["message_latency"], resolve(DRIVE_RULES))
    # The first and third are of one tick; the fourth follows the third directly; the last has others before it.
    assert found.select("first_tick", "last_tick", "entries").rows() == [(0, 30, 3), (37, 37, 1)]
    DRIVE_FINDINGS.validate(found, where="test")


def test_a_drive_is_judged_and_what_could_not_be_checked_is_counted():
    messages = make_rows(BSM, time_s=[0.0, 0.1, 0.2], lost_before=[0, 0, 4])
    ticks = make_rows(SURROUNDING, tick=[0, 1, 2], box_x_m=[0.0, 5.5, 6.0], from_lidar=[True] * 3).select(TICK_COLUMNS)
    ego = make_rows(EGO_STATES, time_s=[0.0], source=["bsm"])
    findings, checks = judge_drive(Drive(messages, ticks, ego))
    assert findings.select("rule", "vehicle_id", "first_tick", "last_tick", "entries", "worst").rows() == [
        ("box_mismatch", 1, 1, 2, 2, 6.0),
        ("message_loss", 1, 2, 2, 1, pytest.approx(4 / 7)),
    ]
    counted = {row["rule"]: row for row in checks.iter_rows(named=True)}
    assert counted.keys() == BY_NAME.keys()
    assert counted["box_mismatch"] == {
        **DRIVE, "rule": "box_mismatch", "severity": "warning", "checked": 3, "entries": 2, "vehicles": 1, "runs": 1,
        "worst": 6.0,
    }  # fmt: skip
    assert (counted["message_latency"]["checked"], counted["message_latency"]["worst"]) == (0, None)
    DRIVE_FINDINGS.validate(findings, where="test")
    DRIVE_CHECKS.validate(checks, where="test")


def test_a_drive_without_messages_or_ticks_has_no_findings():
    empty = Drive(BSM.empty(), SURROUNDING.empty().select(TICK_COLUMNS), EGO_STATES.empty())
    findings, checks = judge_drive(empty)
    assert findings.is_empty()
    assert checks.is_empty()


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(1, 3), st.integers(0, 60), st.integers(0, 5)),
        min_size=1,
        max_size=40,
        unique_by=lambda row: row[:2],
    )
)
def test_loss_shares_equal_those_of_a_slow_loop(rows):
    ordered = sorted(rows)
    frame = make_rows(
        BSM,
        vehicle_id=[row[0] for row in ordered],
        time_s=[row[1] / 4 for row in ordered],
        lost_before=[row[2] for row in ordered],
    )
    expected = []
    for vehicle, quarter, _ in ordered:
        window = [row for row in ordered if row[0] == vehicle and quarter - 20 < row[1] <= quarter]
        lost = sum(row[2] for row in window)
        expected.append(lost / (lost + len(window)))
    assert prepare_messages(frame)["loss_share"].to_list() == pytest.approx(expected)
