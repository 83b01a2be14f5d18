"""Single values of NGSIM's rows that decide something: the origin of a recording, a speed of exactly 5 ft/s."""

import pytest
from raw_texts import as_csv, ngsim, ngsim_row, read_ngsim, tracks_of, write

from tracklake.quality_reports.rules.registry import RULES


@pytest.mark.parametrize(
    ("key", "origin"),
    [
        (1118853000042 - 100, "synthetic"),
        (1118853000042 - 100 + 100 * 77, "synthetic"),  # frames numbered again
        (1118853000000 - 100, "recorded"),
        (1118853000043 - 100, "recorded"),
        (1118846978900, "recorded"),
        (1163030342, "recorded"),  # another day: some clock that runs beside the tenth
    ],
)
def test_the_origin_of_a_recording_shows_in_its_times(tmp_path, key, origin):
    canonical, _ = read_ngsim(tmp_path, write(tmp_path / "a.csv", as_csv([ngsim_row(5, 1, key=key)])))
    assert [made.subsets[0].facts["origin"][0] for made in canonical.values()] == [origin]


@pytest.mark.parametrize(("feet", "slow"), [("5", True), ("5.00", True), ("5.000000", True), ("5.01", False)])
def test_five_feet_per_second_are_a_low_constant_speed(tmp_path, feet, slow):
    canonical = ngsim(tmp_path, as_csv([ngsim_row(1, 1, v_Vel=feet, v_Acc="0")]))
    (rule,) = (rule for rule in RULES if rule.name == "low_constant_speed")
    assert tracks_of(canonical).select(rule.breaks(rule.defaults)).item() is slow
