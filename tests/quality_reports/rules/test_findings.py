"""Findings equal what a literal loop over the rows finds; subsets are excluded above the share, not at it."""

import struct

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.rules.findings import SubsetOrderError, find, judge_subset
from tracklake.quality_reports.rules.registry import RULES, ThresholdError
from tracklake.schemas import FINDINGS, SUBSET_STATUS

LARGEST = 2**31 - 1
NAMES = ("negative_headway", "high_acceleration", "low_constant_speed", "backward")
RECORDED = tuple(rule for rule in RULES if rule.name in NAMES)
"""Rules that need nothing but what is recorded of an entry: how runs are found does not depend on the rule."""
SCHEMA = {
    "dataset": pl.String,
    "subset": pl.String,
    "vehicle_id": pl.Int32,
    "frame": pl.Int32,
    "speed_mps": pl.Float32,
    "accel_mps2": pl.Float32,
    "gap_m": pl.Float64,
}


def tracks(rows: list[tuple]) -> pl.DataFrame:
    """Tracks of one subset from (vehicle_id, frame, speed, acceleration, gap)."""
    return pl.DataFrame([("highd", "01-upper", *row) for row in rows], schema=SCHEMA, orient="row")


def float32(value: float) -> float:
    return struct.unpack("f", struct.pack("f", value))[0]


def judge(rule: str, speed: float, accel: float | None, gap: float | None) -> float | None:
    """The rule's value where an entry breaks it, else None: DESIGN section 5, read literally."""
    if rule == "negative_headway":
        return gap if gap is not None and gap < 0 else None
    if rule == "high_acceleration":
        return accel if accel is not None and accel > float32(3.05) else None
    if rule == "low_constant_speed":
        return speed if 0 < speed <= float32(1.524) and accel == 0 else None
    return speed if speed < 0 else None


def loop(frame: pl.DataFrame) -> list[tuple]:
    """Findings by a slow loop over rows: (vehicle, rule, severity, first, last, entries, worst), sorted by key."""
    worse = {"negative_headway": min, "high_acceleration": max, "low_constant_speed": min, "backward": min}
    severity = {"negative_headway": "error", "backward": "error"}
    found = []
    for rule in worse:
        run = None
        for vehicle, at, speed, accel, gap in frame.select(list(SCHEMA)[2:]).iter_rows():
            value = judge(rule, speed, accel, gap)
            if value is None:
                run = None
                continue
            if run is not None and run[0] == vehicle and at == run[4] + 1:
                run[4], run[5], run[6] = at, run[5] + 1, worse[rule](run[6], value)
            else:
                run = [vehicle, rule, severity.get(rule, "warning"), at, at, 1, value]
                found.append(run)
    return sorted((tuple(run) for run in found), key=lambda run: (run[1], run[0], run[3]))


def as_tuples(findings: pl.DataFrame) -> list[tuple]:
    columns = ["vehicle_id", "rule", "severity", "first_frame", "last_frame", "entries", "worst"]
    return findings.select(columns).rows()


speeds = st.sampled_from([-1.5, -0.01, 0.0, 0.5, 1.524, 1.53, 30.0]).map(float32)
accelerations = st.none() | st.sampled_from([-9.0, 0.0, 3.04, 3.05, 3.06, 9.0]).map(float32)
gaps = st.none() | st.sampled_from([-4.0, -0.001, 0.0, 12.0])


@st.composite
def random_tracks(draw) -> pl.DataFrame:
    """Tracks with gaps, single entries, and ids and frames at the limits of Int32."""
    rows = []
    for vehicle in sorted(draw(st.sets(st.sampled_from([0, 1, 2, 7, LARGEST]), max_size=4))):
        first = draw(st.sampled_from([0, 1, 5, LARGEST - 12]))
        frames = sorted(draw(st.sets(st.integers(first, first + 12), min_size=1, max_size=12)))
        rows += [(vehicle, frame, draw(speeds), draw(accelerations), draw(gaps)) for frame in frames]
    return tracks(rows)


@settings(max_examples=50, deadline=None)
@given(random_tracks())
def test_findings_equal_a_literal_loop(frame):
    findings = FINDINGS.validate(find(frame, RECORDED), where="01-upper")
    assert as_tuples(findings) == loop(frame)


def test_runs_end_at_gaps_at_sound_entries_and_at_another_vehicle():
    frame = tracks(
        [
            (1, 1, 20.0, 0.0, -1.0),
            (1, 2, 20.0, 0.0, -2.5),
            (1, 4, 20.0, 0.0, -0.5),  # frame 3 is missing
            (1, 5, 20.0, 0.0, 3.0),
            (1, 6, 20.0, 0.0, -0.1),
            (2, 7, 20.0, 0.0, -0.2),  # the next frame, another vehicle
        ]
    )
    assert as_tuples(find(frame, RECORDED)) == [
        (1, "negative_headway", "error", 1, 2, 2, -2.5),
        (1, "negative_headway", "error", 4, 4, 1, -0.5),
        (1, "negative_headway", "error", 6, 6, 1, -0.1),
        (2, "negative_headway", "error", 7, 7, 1, -0.2),
    ]


def test_each_rule_fires_where_injected_and_nowhere_else():
    sound = (20.0, 0.1, 30.0)
    defects = {
        "high_acceleration": (20.0, 3.5, 30.0),
        "low_constant_speed": (1.0, 0.0, 30.0),
        "backward": (-2.0, 0.1, 30.0),
        "negative_headway": (20.0, 0.1, -1.0),
    }
    assert list(defects) == [rule.name for rule in RECORDED]
    places = {10 * number: name for number, name in enumerate(defects, start=1)}
    frame = [(2, at, *sound) for at in range(1, 60)]
    frame += [(3, at, *(defects[places[at]] if at in places else sound)) for at in range(1, 60)]
    findings = find(tracks(frame), RECORDED).select("vehicle_id", "first_frame", "rule", "entries")
    assert findings.sort("first_frame").rows() == [(3, at, name, 1) for at, name in places.items()]


def test_no_entries_no_findings():
    assert find(tracks([]), RECORDED).equals(FINDINGS.empty())


def test_no_rules_no_findings():
    assert find(tracks([(1, 1, -1.0, 0.0, None)]), rules=()).equals(FINDINGS.empty())


def test_thresholds_reach_the_findings():
    frame = tracks([(1, 1, 20.0, 3.5, None)])
    assert find(frame, RECORDED).height == 1
    assert find(frame, RECORDED, {"high_acceleration_mps2": 4.0}).is_empty()
    with pytest.raises(ThresholdError):
        find(frame, RECORDED, {"no_such": 4.0})


def test_rows_out_of_order_are_refused():
    with pytest.raises(SubsetOrderError, match="01-upper: tracks must be sorted"):
        find(tracks([(1, 2, 1.0, 0.0, None), (1, 1, 1.0, 0.0, None)]), RECORDED)


def test_two_subsets_are_refused():
    frame = tracks([(1, 1, 1.0, 0.0, None), (2, 1, 1.0, 0.0, None)])
    mixed = frame.with_columns(subset=pl.Series(["01-upper", "01-lower"]))
    with pytest.raises(SubsetOrderError, match="one subset"):
        find(mixed, RECORDED)
    with pytest.raises(SubsetOrderError, match="one subset"):
        judge_subset(mixed)


@pytest.mark.parametrize(
    ("backward", "vehicles", "excluded"),
    [(0, 1, False), (1, 100, False), (2, 100, True), (3, 300, False), (1, 99, True)],
)
def test_a_subset_is_excluded_above_one_percent_of_its_vehicles(backward, vehicles, excluded):
    rows = []
    for vehicle in range(vehicles):
        rows += [(vehicle, 1, 20.0, 0.0, None), (vehicle, 2, -0.01 if vehicle < backward else 0.0, 0.0, None)]
    status = SUBSET_STATUS.validate(judge_subset(tracks(rows)), where="01-upper")
    assert status.select("dataset", "subset", "backward_vehicles", "excluded").rows() == [
        ("highd", "01-upper", backward, excluded)
    ]
    reason = status["excluded_reason"][0]
    assert (reason is not None) == excluded
    if excluded:
        assert reason.startswith(f"{backward} of {vehicles} vehicles")


@pytest.mark.parametrize("percent", range(0, 101, 7))
def test_the_share_itself_does_not_exclude(percent):
    # percent of 100 vehicles is the share exactly: not more than it, whatever 0.07 * 100 is in floating point.
    rows = [(vehicle, 1, -1.0 if vehicle < percent else 1.0, 0.0, None) for vehicle in range(100)]
    assert judge_subset(tracks(rows), max_backward_share=percent / 100)["excluded"].to_list() == [False]


def test_a_subset_without_entries_has_no_status():
    assert judge_subset(tracks([])).equals(SUBSET_STATUS.empty())


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_an_impossible_share_is_refused(share):
    with pytest.raises(ValueError, match="max_backward_share"):
        judge_subset(tracks([(1, 1, 1.0, 0.0, None)]), max_backward_share=share)
