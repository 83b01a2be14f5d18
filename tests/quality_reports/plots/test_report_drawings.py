"""What the subsets' pages draw by themselves: colours, axes and lines."""

from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.quality_reports.plots.axes import Scale, draw_line, find_range, format_number, make_ticks
from tracklake.quality_reports.plots.distributions import find_speed_range
from tracklake.quality_reports.plots.rasters import EMPTY, LEVELS, grade_values, make_palette


def test_the_palette_grows_lighter_step_by_step():
    colours = make_palette()[1:].astype(float)
    lightness = colours[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > -0.6).all(), "rounding of single channels apart"
    assert (lightness[20::20] - lightness[:-20:20][: len(lightness[20::20])] > 5).all()


def test_values_are_graded_from_the_first_colour_to_the_last():
    values = np.array([np.nan, -3.0, 0.0, 12.5, 25.0, 99.0])
    assert grade_values(values, 0, 25).tolist() == [EMPTY, 1, 1, 128, LEVELS, LEVELS]


@given(st.floats(-1e6, 1e6), st.floats(1e-2, 1e6), st.integers(2, 12))
def test_ticks_are_round_and_within(low, span, most):
    high = low + span
    ticks = make_ticks(low, high, most)
    assert len(ticks) <= most + 1
    assert all(low - span * 1e-6 <= tick <= high + span * 1e-6 for tick in ticks)
    steps = {float(f"{later - tick:.3g}") for tick, later in pairwise(ticks)}
    assert len(steps) <= 1
    assert all(f"{step:e}"[0] in "125" for step in steps)


def test_ticks_by_hand():
    assert make_ticks(0, 66, 10) == [0, 10, 20, 30, 40, 50, 60]
    assert make_ticks(-0.3, 0.9, 4) == [0, 0.5]
    assert format_number(-1250.0) == "\N{MINUS SIGN}1,250"
    assert find_range(pl.Series([3.0, None, 3.0]), 2.0) == pytest.approx((1.9, 4.1))


def test_a_line_breaks_at_gaps_and_missing_values():
    points = pl.DataFrame(
        {
            "time_s": [0.0, 1.0, 2.0, 5.0, 6.0, 7.0],
            "x_m": [0.0, 1.0, 2.0, 5.0, None, 7.0],
            "follows": [False, True, True, False, True, True],
        }
    )
    drawn = draw_line(points, Scale(0, 10, 0, 100), Scale(0, 10, 100, 0), "x_m", "time_s")
    assert drawn == "M0.0 100.0h0L10.0 90.0L20.0 80.0M50.0 50.0h0M70.0 30.0h0"


@pytest.mark.parametrize(
    ("speeds", "ends"),
    [
        ([0, 12, 20], (0.0, 21.0)),
        ([24, 30, 33], (23.0, 34.0)),
        ([-3, 5], (-3.0, 6.0)),
        ([5], (4.0, 10.0)),
    ],
)
def test_a_speed_axis_is_not_half_empty(speeds, ends):
    assert find_speed_range(speeds) == ends
