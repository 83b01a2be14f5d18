"""The rules: each fires at its threshold and nowhere else, declared once for Pandera, findings and documentation."""

import polars as pl
import pytest
from pandera.errors import SchemaErrors

from quality_reports.rules import RULES, ThresholdError, as_schema, describe, resolve
from schemas import TRACKS
from schemas.columns import SEVERITIES

NAMES = ["negative_headway", "high_acceleration", "low_constant_speed", "backward"]


def entries(**columns) -> pl.DataFrame:
    """Entries of one vehicle: gap 10 m, speed 20 m/s, acceleration 0.5 m/s2 but for the given columns."""
    height = max(len(values) for values in columns.values())
    sound = {"gap_m": [10.0] * height, "speed_mps": [20.0] * height, "accel_mps2": [0.5] * height}
    frame = pl.DataFrame({**sound, **columns}, schema={name: TRACKS.dtypes[name] for name in sound})
    return frame.with_columns(
        dataset=pl.lit("highd"), subset=pl.lit("01-upper"), vehicle_id=pl.lit(1, pl.Int32), frame=pl.int_range(height)
    )


def broken(frame: pl.DataFrame, name: str, **thresholds: float) -> list[bool]:
    """Which entries break a rule."""
    (rule,) = (rule for rule in RULES if rule.name == name)
    return frame.select(rule.broken(resolve(RULES, thresholds))).to_series().to_list()


def test_the_first_rules_are_declared():
    assert [rule.name for rule in RULES] == NAMES
    assert {rule.severity for rule in RULES} <= set(SEVERITIES)
    assert len(resolve(RULES)) == sum(len(rule.thresholds) for rule in RULES), "two thresholds share a name"
    assert all(set(rule.columns) <= set(TRACKS.dtypes) for rule in RULES)


def test_negative_headway_is_a_gap_below_zero():
    frame = entries(gap_m=[0.0, -0.0, -0.001, 0.001, None])
    assert broken(frame, "negative_headway") == [False, False, True, False, False]


def test_the_recorded_value_3_05_is_no_high_acceleration():
    frame = entries(accel_mps2=[3.05, 3.06, 3.04, -9.0, None])
    assert broken(frame, "high_acceleration") == [False, True, False, False, False]


def test_the_recorded_value_1_52_is_a_low_constant_speed():
    frame = entries(
        speed_mps=[1.52, 1.53, 0.0, 0.01, -1.0, 1.0, 1.0, 1.0], accel_mps2=[0.0, 0.0, 0.0, 0.0, 0.0, 0.01, None, -0.0]
    )
    assert broken(frame, "low_constant_speed") == [True, False, False, True, False, False, False, True]


def test_backward_is_a_speed_below_zero():
    frame = entries(speed_mps=[0.0, -0.0, -0.01, 0.01])
    assert broken(frame, "backward") == [False, False, True, False]


@pytest.mark.parametrize("hundredths", range(10, 1000, 55))
def test_a_recorded_value_equals_a_threshold_of_two_decimals(hundredths):
    # As Float64 about half of these would not: the Float32 next to 0.1 is greater than 0.1.
    value = hundredths / 100
    frame = entries(accel_mps2=[value])
    assert broken(frame, "high_acceleration", high_acceleration_mps2=value) == [False]
    frame = entries(speed_mps=[value], accel_mps2=[0.0])
    assert broken(frame, "low_constant_speed", low_constant_speed_mps=value) == [True]


def test_thresholds_override_the_defaults():
    assert resolve(RULES, {"high_acceleration_mps2": 4})["high_acceleration_mps2"] == 4.0
    assert broken(entries(accel_mps2=[3.5, 4.5]), "high_acceleration", high_acceleration_mps2=4) == [False, True]


def test_an_unknown_threshold_is_refused_with_the_known_ones():
    with pytest.raises(ThresholdError, match=r"unknown name 'high_accel'.*high_acceleration_mps2"):
        resolve(RULES, {"high_accel": 3.0})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "3", None, True])
def test_a_threshold_must_be_a_finite_number(value):
    with pytest.raises(ThresholdError, match="high_acceleration_mps2 must be a finite number"):
        resolve(RULES, {"high_acceleration_mps2": value})


BREAKING = {
    "negative_headway": {"gap_m": [1.0, -1.0]},
    "high_acceleration": {"accel_mps2": [3.05, 3.2]},
    "low_constant_speed": {"speed_mps": [1.0, 1.0], "accel_mps2": [0.1, 0.0]},
    "backward": {"speed_mps": [1.0, -1.0]},
}


def test_every_rule_has_an_injected_defect():
    assert list(BREAKING) == [rule.name for rule in RULES]


@pytest.mark.parametrize("name", NAMES)
def test_as_pandera_checks_each_rule_fires_alone(name):
    with pytest.raises(SchemaErrors) as caught:
        as_schema().validate(entries(**BREAKING[name]), lazy=True)
    cases = caught.value.failure_cases
    assert cases["check"].str.starts_with(name).to_list() == [True]
    assert cases["index"].to_list() == [1]


def test_as_pandera_checks_sound_entries_and_nulls_pass():
    frame = entries(gap_m=[10.0, None], accel_mps2=[0.1, None])
    assert as_schema().validate(frame, lazy=True).equals(frame)


def test_as_pandera_checks_take_thresholds():
    frame = entries(accel_mps2=[3.2])
    assert as_schema(thresholds={"high_acceleration_mps2": 3.5}).validate(frame, lazy=True).equals(frame)


def test_the_documentation_follows_from_the_declaration():
    rows = describe(thresholds={"backward_mps": -0.1})
    assert [row["name"] for row in rows] == NAMES
    assert rows[1]["thresholds"] == [{"name": "high_acceleration_mps2", "value": 3.05, "default": 3.05, "unit": "m/s2"}]
    assert rows[3]["thresholds"] == [{"name": "backward_mps", "value": -0.1, "default": 0.0, "unit": "m/s"}]
    assert rows[2]["columns"] == ["speed_mps", "accel_mps2"]
    assert all(row["meaning"] and row["source"] and row["unit"] for row in rows)
