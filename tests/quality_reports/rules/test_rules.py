"""The rules: declared once for Pandera, findings and documentation, with more boundaries than their own cases have.

What a rule needs of tests comes from its declaration (test_rule_cases.py); what stands here is of DESIGN's sixteen.
"""

import numpy as np
import polars as pl
import pytest
from pandera.errors import SchemaErrors

from tracklake.pipeline.transforms.reconstruction.bounds import limit_motion
from tracklake.quality_reports.rules.derived import DERIVED
from tracklake.quality_reports.rules.registry import (
    RULES,
    ThresholdError,
    as_schema,
    describe,
    resolve,
    select_broken,
    select_checkable,
)
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.columns import SEVERITIES
from tracklake.schemas.motion_bounds import BOUNDS

NAMES = [
    "negative_headway", "negative_headway_recorded", "high_acceleration", "low_constant_speed", "backward",
    "position_jump", "frame_gap", "overlap", "speed_mismatch", "high_jerk", "jerk_flicker", "lane_flicker",
    "leader_mismatch", "headway_mismatch", "implausible_size", "outside_lane", "hard_deceleration",
    "acceleration_bound", "lateral_acceleration", "heading_motion_mismatch", "track_fragment", "cross_section_flow",
    "duplicate_track", "size_change",
]  # fmt: skip
SOUND = {
    "gap_m": (10.0, pl.Float64), "speed_mps": (20.0, pl.Float32), "accel_mps2": (0.5, pl.Float32),
    "speed_10hz_mps": (20.0, pl.Float32), "leader_id": (7, pl.Int32), "length_m": (4.5, pl.Float32),
    "width_m": (1.8, pl.Float32), "class": ("car", pl.String), "jump_m": (0.1, pl.Float64),
    "frames_skipped": (0, pl.Int32), "jerk_mps3": (0.0, pl.Float64), "jerk_reversals": (0, pl.Int8),
    "lane_stay_s": (None, pl.Float64), "out_of_lane_m": (0.0, pl.Float64), "overlap_m": (0.0, pl.Float64),
    "nearest_ahead_m": (14.5, pl.Float64), "leader_ahead_m": (14.5, pl.Float64), "leader_in_lane": (1.0, pl.Float64),
    "recorded_gap_m": (10.0, pl.Float64), "motion_class": ("car", pl.String), "lateral_accel_mps2": (0.0, pl.Float64),
    "heading_error_rad": (0.0, pl.Float64), "fragment_m": (None, pl.Float64), "missed_section_m": (None, pl.Float64),
    "double_track_s": (0.0, pl.Float64), "length_range_m": (0.0, pl.Float32), "width_range_m": (0.0, pl.Float32),
}  # fmt: skip
"""An entry that breaks no rule: every column that a rule names, those of tracks and the derived ones."""


def entries(**columns) -> pl.DataFrame:
    """Prepared entries of one vehicle: sound but for the given columns."""
    height = max(len(values) for values in columns.values())
    values = {name: columns.get(name, [value] * height) for name, (value, _) in SOUND.items()}
    frame = pl.DataFrame(values, schema={name: dtype for name, (_, dtype) in SOUND.items()})
    return frame.with_columns(
        dataset=pl.lit("highd"), subset=pl.lit("01-upper"), vehicle_id=pl.lit(1, pl.Int32), frame=pl.int_range(height)
    )


def broken(frame: pl.DataFrame, name: str, **thresholds: float) -> list[bool]:
    """The entries that break a rule."""
    (rule,) = (rule for rule in RULES if rule.name == name)
    return frame.select(rule.broken(resolve(RULES, thresholds))).to_series().to_list()


def test_all_rules_of_the_design_are_declared():
    assert sorted(rule.name for rule in RULES if rule.name in NAMES) == sorted(NAMES)
    assert {rule.severity for rule in RULES} <= set(SEVERITIES)
    assert len(resolve(RULES)) == sum(len(rule.thresholds) for rule in RULES), "two thresholds share a name"
    assert {name for rule in RULES if rule.name in NAMES for name in rule.reads} == set(SOUND)
    assert not [rule.name for rule in RULES if not rule.columns]


def test_rules_read_declared_columns_only():
    known = {*TRACKS.dtypes, *VEHICLES.dtypes, *SUBSETS.dtypes}
    assert all(set(derived.reads) <= known for derived in DERIVED.values())
    assert all(set(rule.columns) <= known for rule in RULES)
    columns = {rule.name: set(rule.columns) for rule in RULES}
    assert columns["overlap"] == {"vehicle_id", "frame", "x_m", "y_m", "heading_rad", "length_m", "width_m"}
    assert columns["outside_lane"] == {"vehicle_id", "y_m", "heading_rad", "length_m", "lane", "lane_markings_m"}


BOUNDARIES = [
    ("negative_headway", {"gap_m": [0.0, -0.0, -0.001, 0.001, None]}, [2]),
    ("negative_headway_recorded", {"recorded_gap_m": [0.0, -0.001, None]}, [1]),
    # As recorded, 3.05 is the Float32 next to it, which is less than 3.05.
    ("high_acceleration", {"accel_mps2": [3.05, 3.06, 3.04, -9.0, None]}, [1]),
    (
        "low_constant_speed",
        {"speed_mps": [1.524, 1.525, 0.0, 0.01, -1.0, 1.0, 1.0, 1.0], "accel_mps2": [0, 0, 0, 0, 0, 0.01, None, -0.0]},
        [0, 3, 7],
    ),
    ("backward", {"speed_mps": [0.0, -0.0, -0.01, 0.01]}, [2]),
    ("position_jump", {"jump_m": [2.0, 2.001, None]}, [1]),
    ("frame_gap", {"frames_skipped": [0, 1, 300]}, [1, 2]),
    ("overlap", {"overlap_m": [0.0, 0.001, None]}, [1]),
    # 20.01 - 19.01 is not 1 in Float32; that the speeds differ either way does not matter.
    ("speed_mismatch", {"speed_mps": [20.01, 20.02, 20, 20], "speed_10hz_mps": [19.01, 19.01, 21.01, None]}, [1, 2]),
    ("high_jerk", {"jerk_mps3": [15.0, -15.0, 15.05, -15.05, None]}, [2, 3]),
    ("jerk_flicker", {"jerk_reversals": [0, 1, 2, 9]}, [2, 3]),
    ("lane_flicker", {"lane_stay_s": [2.0, 2.04, 0.04, None]}, [0, 2]),
    (
        "leader_mismatch",
        {
            # right; farther than the nearest; abreast of the nearest; another lane; behind; no one ahead; unseen;
            # none recorded: no one ahead, within 100 m, beyond.
            "leader_id": [7, 7, 7, 7, 7, 7, 7, None, None, None],
            "leader_ahead_m": [20, 30, 20, 20, -1, 20, None, None, None, None],
            "nearest_ahead_m": [20, 20, 20, 25, 20, None, 20, None, 100, 100.1],
            "leader_in_lane": [1, 1, 1, 0, 1, 1, None, None, None, None],
        },
        [1, 3, 4, 8],
    ),
    ("headway_mismatch", {"recorded_gap_m": [11.0, 9.0, 11.001, 8.999, None]}, [2, 3]),
    (
        "implausible_size",
        {
            "class": ["car", "car", "car", "car", "truck", "truck", "motorcycle", None, "car"],
            "length_m": [2.4, 8.0, 8.01, 4.5, 8.01, 26.5, 2.2, 99.0, None],
            "width_m": [1.2, 2.7, 1.8, 1.19, 2.5, 2.5, 0.8, 9.0, None],
        },
        [2, 3, 5],
    ),
    ("outside_lane", {"out_of_lane_m": [0.0, 0.001, None]}, [1]),
    ("hard_deceleration", {"accel_mps2": [-8.0, -8.01, 9.0, None]}, [1]),
    (
        "acceleration_bound",
        {
            # A car's bound is 5 m/s2 at rest and backwards, 3.2 at 20 m/s and 2 from 33 on; a truck's 1.2 at 25.
            "speed_mps": [0.0, -1.0, -1.0, 20.0, 20.0, 30.0, 45.0, 45.0, 25.0, 60.0, 10.0, 0.0],
            "accel_mps2": [5.0, 5.0, 5.01, 3.2, 3.21, 2.3, 2.0, 2.01, 1.2, 1.01, 6.2, None],
            "motion_class": [*["car"] * 8, "truck", "truck", "motorcycle", "car"],
        },
        [2, 4, 7, 9],
    ),
    ("lateral_acceleration", {"lateral_accel_mps2": [3.0, -3.0, 3.001, -3.001, None]}, [2, 3]),
    (
        "heading_motion_mismatch",
        {"heading_error_rad": [0.1, 0.1001, 0.2, 0.2, None], "speed_mps": [20.0, 20.0, 4.99, 5.0, 20.0]},
        [1, 3],
    ),
    ("track_fragment", {"fragment_m": [20.0, 20.001, -3.0, None]}, [1]),
    ("cross_section_flow", {"missed_section_m": [0.0, 0.001, None]}, [1]),
    ("duplicate_track", {"double_track_s": [0.0, 0.48, 0.5, None]}, [2]),
    (
        "size_change",
        {"length_range_m": [0.1, 0.101, 0.0, None, None], "width_range_m": [0.0, 0.0, 0.2, 0.2, None]},
        [1, 2, 3],
    ),
]


@pytest.mark.parametrize(("name", "columns", "expected"), BOUNDARIES, ids=NAMES)
def test_a_rule_is_broken_beyond_its_threshold_only(name, columns, expected):
    frame = entries(**columns)
    assert [place for place, breaks in enumerate(broken(frame, name)) if breaks] == expected
    # The worst value is known wherever the rule is broken.
    (rule,) = (rule for rule in RULES if rule.name == name)
    values = frame.select(rule.measure(rule.defaults).alias("value"))["value"].gather(expected)
    assert values.null_count() == 0


@pytest.mark.parametrize(
    ("name", "columns", "value"),
    [
        ("leader_mismatch", {"leader_ahead_m": [30.0], "nearest_ahead_m": [20.0]}, 10.0),
        ("leader_mismatch", {"leader_ahead_m": [-3.0], "nearest_ahead_m": [None]}, 3.0),
        ("leader_mismatch", {"leader_ahead_m": [None], "nearest_ahead_m": [40.0]}, 40.0),
        ("headway_mismatch", {"recorded_gap_m": [7.5]}, 2.5),
        ("high_jerk", {"jerk_mps3": [-20.0]}, 20.0),
        ("speed_mismatch", {"speed_10hz_mps": [22.5]}, 2.5),
        ("implausible_size", {"length_m": [9.0], "width_m": [3.0]}, 1.0),
        ("implausible_size", {"length_m": [2.0], "width_m": [3.0]}, 0.4),
    ],
)
def test_worst_values_by_hand(name, columns, value):
    (rule,) = (rule for rule in RULES if rule.name == name)
    assert entries(**columns).select(rule.measure(rule.defaults)).item() == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize("hundredths", range(10, 1000, 55))
def test_a_recorded_value_equals_a_threshold_of_two_decimals(hundredths):
    # As Float64 about half of these would not: the Float32 next to 0.1 is greater than 0.1.
    value = hundredths / 100
    frame = entries(accel_mps2=[value])
    assert broken(frame, "high_acceleration", high_acceleration_mps2=value) == [False]
    frame = entries(speed_mps=[value], accel_mps2=[0.0])
    assert broken(frame, "low_constant_speed", low_constant_speed_mps=value) == [True]
    frame = entries(length_m=[value])
    assert broken(frame, "implausible_size", car_length_min_m=value, car_length_max_m=value) == [False]
    frame = entries(speed_mps=[20.0 + value])
    assert broken(frame, "speed_mismatch", speed_mismatch_mps=value) == [False]


def test_thresholds_override_the_defaults():
    assert resolve(RULES, {"high_acceleration_mps2": 4})["high_acceleration_mps2"] == 4.0
    assert broken(entries(accel_mps2=[3.5, 4.5]), "high_acceleration", high_acceleration_mps2=4) == [False, True]
    # A worst value may depend on the threshold as well.
    (rule,) = (rule for rule in RULES if rule.name == "implausible_size")
    frame = entries(length_m=[9.0])
    assert frame.select(rule.measure({**rule.defaults, "car_length_max_m": 6.0})).item() == 3.0


def test_an_unknown_threshold_is_refused_with_the_nearest_known_one():
    with pytest.raises(ThresholdError, match=r"high_accel: unknown name; did you mean high_acceleration_mps2\?"):
        resolve(RULES, {"high_accel": 3.0})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "3", None, True])
def test_a_threshold_must_be_a_finite_number(value):
    with pytest.raises(ThresholdError, match="high_acceleration_mps2: expected a finite number"):
        resolve(RULES, {"high_acceleration_mps2": value})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"high_acceleration_mps2": -3}, r"high_acceleration_mps2: expected 0 or more \(m/s2\), got -3"),
        ({"backward_mps": 0.5}, r"backward_mps: expected 0 or less \(m/s\), got 0\.5"),
        ({"car_length_min_m": 9}, "car_length_min_m to be no more than car_length_max_m, which are 9 and 8"),
    ],
)
def test_thresholds_have_bounds(overrides, message):
    with pytest.raises(ThresholdError, match=message):
        resolve(RULES, overrides)


def test_defaults_lie_within_their_bounds():
    thresholds = [threshold for rule in RULES for threshold in rule.thresholds]
    assert resolve(RULES, {each.name: each.default for each in thresholds}) == resolve(RULES)


def test_rules_are_checkable_where_nothing_they_read_is_lacking():
    assert select_checkable(RULES, ()) == RULES
    names = {rule.name for rule in select_checkable(RULES, ("gap_m", "lane_markings_m", "accel_mps2"))}
    lost = {
        "negative_headway", "negative_headway_recorded", "headway_mismatch", "outside_lane", "high_acceleration",
        "low_constant_speed", "high_jerk", "jerk_flicker", "hard_deceleration", "acceleration_bound",
    }  # fmt: skip
    assert names & set(NAMES) == set(NAMES) - lost


@pytest.mark.parametrize(("name", "columns", "expected"), BOUNDARIES, ids=NAMES)
def test_as_pandera_checks_each_rule_fires(name, columns, expected):
    frame = entries(**columns)[[0, expected[0]] if expected[0] else [1, 0]]
    with pytest.raises(SchemaErrors) as caught:
        as_schema([rule for rule in RULES if rule.name == name]).validate(frame, lazy=True)
    cases = caught.value.failure_cases
    assert cases["check"].str.starts_with(f"{name} (").to_list() == [True]
    assert cases["index"].to_list() == [1]
    assert [rule.name for rule in select_broken(frame) if rule.name == name] == [name]


def test_as_pandera_checks_sound_entries_and_nulls_pass():
    frame = entries(gap_m=[10.0, None], accel_mps2=[0.1, None])
    assert as_schema().validate(frame, lazy=True).equals(frame)
    assert select_broken(frame) == ()


def test_as_pandera_checks_take_thresholds():
    frame = entries(accel_mps2=[3.2], speed_mps=[10.0], speed_10hz_mps=[10.0])
    assert as_schema(thresholds={"high_acceleration_mps2": 3.5}).validate(frame, lazy=True).equals(frame)


@pytest.mark.parametrize("kind", BOUNDS)
def test_accelerations_that_reconstructed_tracks_may_have_break_no_bound(kind):
    speeds = [step / 2 for step in range(140)]
    greatest = limit_motion([BOUNDS[kind]], np.zeros(140, int), np.array(speeds)).accel_mps2.tolist()
    frame = entries(speed_mps=speeds, accel_mps2=greatest, motion_class=[kind] * len(speeds))
    assert not any(broken(frame, "acceleration_bound"))


def test_the_documentation_follows_from_the_declaration():
    rows = describe(thresholds={"backward_mps": -0.1})
    assert [row["name"] for row in rows] == [rule.name for rule in RULES]
    shown = {row["name"]: row for row in rows}
    assert shown["high_acceleration"]["thresholds"] == [
        {"name": "high_acceleration_mps2", "value": 3.05, "default": 3.05, "unit": "m/s2"}
    ]
    assert shown["backward"]["thresholds"] == [{"name": "backward_mps", "value": -0.1, "default": 0.0, "unit": "m/s"}]
    assert shown["low_constant_speed"]["columns"] == ["speed_mps", "accel_mps2"]
    assert all(row["meaning"] and row["source"] and row["unit"] for row in rows)
