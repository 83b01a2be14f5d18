"""Maneuver labels: windows of 4 s either side, 3 s back, 5 s ahead, clamped to the track; by tick and never by row."""

from fractions import Fraction

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.samples.maneuvers import label_maneuvers


def make_clock(runs):
    """Each run: (vehicle_id, first tick, [(x_m, lane), ...]); a run is a segment."""
    rows = [
        (vehicle, first + i, x, lane, segment)
        for segment, (vehicle, first, points) in enumerate(runs)
        for i, (x, lane) in enumerate(points)
    ]
    schema = {"vehicle_id": pl.Int32, "tick": pl.Int32, "x_m": pl.Float64, "lane": pl.Int16, "segment": pl.Int32}
    return pl.DataFrame(rows, schema=schema, orient="row")


def lateral(lanes, rate_hz=1):
    clock = make_clock([(1, 0, [(0.0, lane) for lane in lanes])])
    return label_maneuvers(clock, rate_hz=rate_hz)["lateral_maneuver"].to_list()


def longitudinal(x_m, rate_hz=1):
    clock = make_clock([(1, 0, [(x, 1) for x in x_m])])
    return label_maneuvers(clock, rate_hz=rate_hz)["longitudinal_maneuver"].to_list()


def test_lane_change_is_labelled_four_seconds_either_side():
    """At 1 Hz, lane 2 from tick 6 on: ticks 2 to 5 see it ahead, ticks 6 to 9 behind them."""
    assert lateral([1] * 6 + [2] * 8) == ["keep"] * 2 + ["right"] * 8 + ["keep"] * 4
    assert lateral([2] * 6 + [1] * 8) == ["keep"] * 2 + ["left"] * 8 + ["keep"] * 4


def test_windows_scale_with_the_rate():
    labels = lateral([1] * 30 + [2] * 30, rate_hz=5)
    assert labels == ["keep"] * 10 + ["right"] * 40 + ["keep"] * 10


def test_windows_are_clamped_to_the_track():
    """Three ticks only: the last entry stands for 4 s after, the first for 4 s before."""
    assert lateral([1, 1, 2]) == ["right", "right", "right"]
    assert lateral([3]) == ["keep"]


def test_right_is_tested_first():
    """Tick 4 lies between a change to the left behind it and one to the right ahead of it, and the other way round."""
    assert lateral([3, 2, 2, 2, 2, 2, 2, 2, 3])[4] == "right"
    assert lateral([1, 2, 2, 2, 2, 2, 2, 2, 1])[4] == "right"


def test_only_the_ends_of_the_windows_count():
    """A lane change and its reversal within 4 s are not seen from tick 0."""
    assert lateral([1, 2, 2, 1, 1, 1])[0] == "keep"


def test_brake_below_four_fifths_of_the_mean_speed_behind():
    """10 m/s for 3 s, then 5 s at 8 m/s (ratio 0.8: normal) or at 7.9 m/s (brake)."""
    history = [0.0, 10.0, 20.0, 30.0]
    assert longitudinal([*history, *(30 + 8.0 * i for i in range(1, 6))])[3] == "normal"
    assert longitudinal([*history, *(30 + 7.9 * i for i in range(1, 6))])[3] == "brake"


@pytest.mark.parametrize("offset_m", [0.1, 0.3, 100.7, 612.345])
def test_a_ratio_of_four_fifths_is_not_below_it_wherever_it_is_driven(offset_m):
    x_m = [0.0, 0.1, 0.2, 0.3, *(0.3 + 0.08 * i for i in range(1, 6))]
    assert longitudinal([offset_m + x for x in x_m])[3] == "normal"


def test_brake_windows_are_three_seconds_back_and_five_ahead():
    """At 2 Hz: 6 ticks back, 10 ahead. What lies farther does not count."""
    x_m = [0.0]
    for speed in [50] * 2 + [10] * 6 + [8] * 10 + [0] * 4:
        x_m.append(x_m[-1] + speed / 2)
    assert longitudinal(x_m, rate_hz=2)[8] == "normal"  # 10 behind, 8 ahead
    assert longitudinal(x_m, rate_hz=2)[7] == "brake"  # (50 + 5 * 10) / 6 behind


def test_clamped_brake_windows_are_means_over_what_there_is():
    """One second behind at 10 m/s, one ahead at 7 m/s."""
    assert longitudinal([0.0, 10.0, 17.0]) == ["normal", "brake", "normal"]


def test_empty_or_standing_history_is_normal():
    assert longitudinal([0.0, 0.0, 0.0]) == ["normal"] * 3
    assert longitudinal([5.0, 5.0, 5.0, 5.0, 9.0])[3] == "normal"
    assert longitudinal([0.0, 10.0])[0] == "normal"  # nothing behind
    assert longitudinal([0.0, 10.0])[1] == "normal"  # nothing ahead
    assert longitudinal([9.0, 8.0, 12.0])[1] == "normal"  # pushed backwards


def test_a_gap_ends_the_windows():
    """Vehicle 1 returns in another lane after a gap; neither run sees the other, nor the next vehicle."""
    clock = make_clock(
        [(1, 0, [(0.0, 1), (10.0, 1)]), (1, 4, [(11.0, 2), (12.0, 2)]), (2, 6, [(0.0, 3), (1.0, 3), (1.1, 3)])]
    )
    labels = label_maneuvers(clock, rate_hz=1)
    assert labels["lateral_maneuver"].to_list() == ["keep"] * 7
    assert labels["longitudinal_maneuver"].to_list() == ["normal"] * 5 + ["brake", "normal"]


def test_no_entries():
    labels = label_maneuvers(make_clock([]), rate_hz=5)
    assert labels.columns == ["lateral_maneuver", "longitudinal_maneuver"]
    assert labels.is_empty()


def test_unknown_lane_is_refused():
    clock = make_clock([(1, 0, [(0.0, 1), (1.0, None)])])
    with pytest.raises(ValueError, match="1 of 2 entries have no lane"):
        label_maneuvers(clock, rate_hz=5)


RUNS = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 2**31 - 1]),
        st.integers(0, 5),
        st.lists(st.tuples(st.integers(-30, 120).map(lambda tenths: tenths / 10), st.integers(0, 2)), max_size=20),
    ),
    max_size=4,
)


@settings(max_examples=30, deadline=None)
@given(RUNS, st.sampled_from([1, 2]))
def test_agrees_with_a_loop_over_entries(runs, rate_hz):
    """x_m are sums of tenths of a metre, compared as fractions."""
    tenths = [[round(10 * step) for step, _ in points] for _, _, points in runs]
    expected = []
    driven_runs = []
    for (vehicle, first, points), steps in zip(runs, tenths, strict=True):
        x = [sum(steps[: i + 1]) for i in range(len(steps))]
        driven_runs.append((vehicle, first, [(x[i] / 10, lane) for i, (_, lane) in enumerate(points)]))
        lanes = [lane for _, lane in points]
        for i in range(len(points)):
            before, after = lanes[max(0, i - 4 * rate_hz)], lanes[min(len(points) - 1, i + 4 * rate_hz)]
            if after > lanes[i] or lanes[i] > before:
                side = "right"
            elif after < lanes[i] or lanes[i] < before:
                side = "left"
            else:
                side = "keep"
            back, ahead = max(0, i - 3 * rate_hz), min(len(points) - 1, i + 5 * rate_hz)
            speed = "normal"
            if back < i < ahead and x[i] > x[back]:
                ratio = Fraction(x[ahead] - x[i], ahead - i) / Fraction(x[i] - x[back], i - back)
                speed = "brake" if ratio < Fraction(4, 5) else "normal"
            expected.append((side, speed))
    assert label_maneuvers(make_clock(driven_runs), rate_hz=rate_hz).rows() == expected
