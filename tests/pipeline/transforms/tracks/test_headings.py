"""Headings by hand, and against the loop that judges the sample."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.synthetic.truth import find_headings as find_slowly
from tracklake.pipeline.transforms.tracks.headings import find_headings

ANGLE = 0.1


def headings_of(rows, rate_hz=25.0):
    """Headings in rad of rows of (vehicle, frame, forward, right)."""
    columns = np.array(rows, np.float64).reshape(-1, 4).T
    cosine, sine = find_headings(*columns[:2].astype(np.int32), *columns[2:], rate_hz)
    assert cosine**2 + sine**2 == pytest.approx(np.ones(len(rows)))
    return np.arctan2(sine, cosine).tolist()


def test_velocities_are_averaged_over_a_fifth_of_a_second():
    """Five frames of 1/25 s; fewer at the ends of a track, beside a gap and beside another vehicle."""
    track = [(1, frame, 20.0, float(right)) for frame, right in enumerate((0, 0, 5, 0, 0, 0, 5), start=1)]
    means = (5 / 3, 5 / 4, 1, 1, 2, 5 / 4, 5 / 3)
    assert headings_of(track) == pytest.approx([math.atan2(mean, 20) for mean in means])
    other = (2, 8, 20.0, -5.0)
    assert headings_of([*track, other]) == pytest.approx([*headings_of(track), math.atan2(-5, 20)])
    late = [*track, (1, 9, 20.0, -5.0), (1, 10, 20.0, -5.0)]
    short = [(1, 12, 20.0, 1.0), (1, 14, 20.0, -1.0)]
    assert headings_of(short) == pytest.approx([math.atan2(1, 20), -math.atan2(1, 20)])
    assert headings_of(late) == pytest.approx([*headings_of(track), *[math.atan2(-5, 20)] * 2]), "a gap is not bridged"


def test_a_slow_vehicle_keeps_its_last_heading_also_across_a_gap():
    fast, slow = (20 * math.cos(ANGLE), 20 * math.sin(ANGLE)), (1.0, -0.9)
    rows = [(1, 1, *slow), (1, 10, *fast), (1, 20, *slow), (1, 21, *slow), (1, 30, *fast), (2, 1, *slow)]
    assert headings_of(rows) == pytest.approx([0, ANGLE, ANGLE, ANGLE, ANGLE, 0])
    at_least = [(1, 1, 2.0, 0.0), (1, 10, 1.2, 1.6), (1, 20, 1.2, 1.59)]
    assert headings_of(at_least) == pytest.approx([0, math.atan2(1.6, 1.2), math.atan2(1.6, 1.2)])


def test_a_vehicle_that_drives_backwards_is_not_turned_round():
    rows = [(1, 1, 20.0, 1.0), (1, 10, -5.0, 0.5), (2, 1, -5.0, 0.5)]
    assert headings_of(rows) == pytest.approx([math.atan2(1, 20), math.atan2(1, 20), 0])


speeds = st.sampled_from([-3.0, 0.0, 1.0, 1.9, 2.0, 2.1, 25.0])


@given(
    tracks=st.dictionaries(
        st.sampled_from([0, 1, 2, 2**31 - 1]),
        st.dictionaries(st.integers(1, 14), st.tuples(speeds, st.sampled_from([-1.0, 0.0, 0.25])), min_size=1),
        max_size=3,
    ),
    rate_hz=st.sampled_from([10.0, 25.0, 30.0]),
)
@settings(max_examples=50, deadline=None)
def test_headings_are_those_of_a_loop(tracks, rate_hz):
    moved = {(vehicle, frame): velocity for vehicle, track in tracks.items() for frame, velocity in track.items()}
    slow = find_slowly(moved, dict.fromkeys(tracks, 2), rate_hz)
    assert headings_of([(*key, *moved[key]) for key in sorted(moved)], rate_hz) == pytest.approx(
        [slow[key] for key in sorted(moved)]
    )
