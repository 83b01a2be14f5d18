"""Figures of drives: worked out by hand from the drive of helpers/known_drive.py, and gates on them."""

import pytest

from tracklake.quality_reports.drives import collect_drives, describe_drive, describe_drives
from tracklake.quality_reports.gates.gate import judge_gate, parse_gate
from tracklake.quality_reports.gates.metrics import METRICS, collect_metrics


@pytest.fixture(scope="module")
def opened(open_lake, small_drive):
    return open_lake(**small_drive)


@pytest.fixture(scope="module")
def collected(opened):
    return collect_drives(opened)


def test_figures_of_one_drive_are_those_among_all(opened, collected):
    assert collect_drives(opened, only="drive-1") == collected
    assert collect_drives(opened, only="drive-2") is None


def test_a_lake_without_drives_has_no_figures_of_them(open_lake):
    assert collect_drives(open_lake()) is None


def test_messages_losses_and_sources_are_counted(collected):
    (facts,) = collected["drives"]
    counted = {
        name: facts[name] for name in ("stations", "messages", "own_messages", "lost", "duplicates", "id_changes")
    }
    assert counted == {
        "stations": 2, "messages": 110, "own_messages": 60, "lost": 10, "duplicates": 3, "id_changes": 1
    }  # fmt: skip
    assert facts["lost_share"] == pytest.approx(10 / 120)
    assert (facts["latency_median_s"], facts["latency_p95_s"], facts["mean_speed_mps"]) == (0.05, 0.05, 20.0)
    # Vehicle 1 and 2 at 59 ticks, the third at 21; no message of ten of them, LiDAR at 50 and 21, camera at 25.
    assert (facts["vehicles"], facts["vehicle_ticks"], facts["predicted_share"]) == (3, 139, 0.0)
    shares = [facts[f"{name}_share"] for name in ("v2v", "lidar", "camera")]
    assert shares == pytest.approx([108 / 139, 71 / 139, 25 / 139])
    assert (facts["findings"], facts["errors"]) == (2, 0)


def test_errors_are_against_the_truth_and_binned_by_distance(collected):
    (facts,) = collected["drives"]
    # 50 of 118 ticks are 0.2 m off, the others 1 m.
    errors = {name: facts[f"{name}_median_m"] for name in ("message_error", "error", "smoothed_error")}
    assert errors == {"message_error": pytest.approx(1.0, abs=1e-4), "error": 1.0, "smoothed_error": 0.5}
    assert (facts["true_ticks"], facts["error_p95_m"]) == (118, 1.0)
    assert [
        (row["from_m"], row["ticks"], row["error_median_m"], row["error_p95_m"]) for row in collected["errors"]
    ] == [
        (0.0, 59, 1.0, 1.0),
        (25.0, 59, pytest.approx(0.2), 1.0),
    ]
    assert [(row["from_m"], row["until_m"], row["messages"], row["lost"]) for row in collected["losses"]] == [
        (0.0, 25.0, 60, 0),
        (25.0, 50.0, 50, 10),
    ]


def test_a_drive_is_described_in_a_line(collected):
    (facts,) = collected["drives"]
    assert describe_drive(facts) == (
        "2 stations, 110 messages, 8.3 % lost, median latency 50 ms, 50 LiDAR scans, "
        "median position error 1.00 m against truth"
    )
    bare = facts | {"stations": 1, "messages": 1, "scans": 0}
    bare |= dict.fromkeys(("lost_share", "latency_median_s", "error_median_m"))
    assert describe_drive(bare) == "1 station, 1 message"
    alone = bare | {"stations": 0, "messages": 0, "own_messages": 60}
    assert describe_drive(alone) == "no messages of other vehicles, 60 of the ego"
    assert describe_drive(alone | {"own_messages": 0, "scans": 1}) == "no messages of other vehicles, 1 LiDAR scan"


def test_all_drives_are_described_by_what_they_hold_together(collected):
    (facts,) = collected["drives"]
    facts = facts | {"images": 0}
    assert describe_drives([facts]) == "1 drive: 2 stations, 110 messages, 50 LiDAR scans"
    assert describe_drives([facts, facts]) == "2 drives: 4 stations, 220 messages, 100 LiDAR scans"


def test_a_recorded_drive_of_messages_alone_has_no_errors(open_lake, small_drive):
    left_out = ("surrounding", "surrounding_truth", "drive_findings", "drive_checks")
    lake = {name: rows for name, rows in small_drive.items() if name not in left_out}
    collected = collect_drives(open_lake(**lake))
    (facts,) = collected["drives"]
    unknown = ("error_median_m", "message_error_median_m", "lidar_share", "findings")
    assert {facts[name] for name in unknown} == {None}
    assert (facts["vehicle_ticks"], facts["lost"], collected["errors"], collected["rules"]) == (0, 10, [], [])
    assert len(collected["losses"]) == 2


@pytest.mark.parametrize(
    ("text", "state"),
    [
        ("drive_message_loss_share > 5%", "failed"),
        ("drive_message_loss_share > 10%", "passed"),
        ("drive_latency_s > 0.04 and origin == synthetic", "failed"),
        ("drive_position_error_m > 0.9 and drive == drive-1", "failed"),
        ("drive_findings > 2 per lake", "passed"),
        ("drive_errors > 0", "passed"),
        ("drives < 2 per lake", "failed"),
        ("error_share > 0", "unknown"),  # there are no carriageways
    ],
)
def test_a_gate_judges_drives(opened, text, state):
    gate = parse_gate(text)
    rows = collect_metrics(opened, {condition.metric.name for condition in gate.conditions})
    assert judge_gate(gate, rows).state == state


def test_gates_of_drives_do_not_judge_carriageways(open_lake, small_lake, small_drive):
    gate = parse_gate("drive_errors > 0")
    alone = judge_gate(gate, collect_metrics(open_lake(**small_lake), {"drive_errors"}))
    assert (alone.state, alone.problem) == ("unknown", "nothing is judged: the lake holds no drives")
    both = judge_gate(gate, collect_metrics(open_lake(**small_lake, **small_drive), {"drive_errors"}))
    assert [(each.name, each.state) for each in both.judged] == [("v2v/drive-1", "passed")]
    unaware = collect_metrics(open_lake(**small_lake, **small_drive), {"error_share"})
    assert {row["scope"] for row in unaware} == {"subset", "recording", "dataset", "lake"}


def test_every_metric_of_drives_has_values_in_its_scopes(opened):
    metrics = [metric for metric in METRICS if metric.name.startswith("drive")]
    rows = collect_metrics(opened, {metric.name for metric in metrics})
    for metric in metrics:
        assert {row["scope"] for row in rows if row.get(metric.name) is not None} == {*metric.scopes}
