"""Settings of a lane-change forest: what is refused, and what is read back."""

import json
from dataclasses import asdict

import pytest

from tracklake.schemas.errors import UsageError
from tracklake.training.lane_changes.examples import LaneForestSettings


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"augmentation": ("rotate",)}, "`augmentation.0`: expected 'mirror' or 'shift', got 'rotate'"),
        ({"start_s": 0.0}, "`start_s`: expected more than 0, got 0.0"),
        ({"shift_m": -1.0}, "`shift_m`: expected 0 or more, got -1.0"),
        ({"start_s": float("inf")}, "`start_s`: expected a finite number, got inf"),
        ({"shift_m": float("nan")}, "`shift_m`: expected a finite number, got nan"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong, message):
    with pytest.raises(UsageError, match=message):
        LaneForestSettings(**wrong)


def test_stored_settings_are_read_back():
    asked = LaneForestSettings(start_s=3.0, trees=7, augmentation=("shift",))
    stored = json.loads(json.dumps(asdict(asked)))
    assert LaneForestSettings(**stored) == asked
    assert LaneForestSettings(start_s=3) == LaneForestSettings(start_s=3.0)
