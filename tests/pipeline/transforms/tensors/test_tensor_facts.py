"""Findings between two ticks are not lost, and sizes are those of their vehicles: against loops over every frame."""

from fractions import Fraction

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tensors.vehicle_facts import find_sizes, mark_findings
from tracklake.schemas.columns import SEVERITIES

TOP = 2**31 - 1
FINDINGS = {"vehicle_id": pl.Int32, "severity": pl.String, "first_frame": pl.Int32, "last_frame": pl.Int32}
IDS = st.sampled_from([0, 1, 5, TOP])


def mark(entries, findings, *, first_frame=1, frame_rate_hz=25.0, rate_hz=5):
    vehicle_id, tick = np.array(entries, dtype=np.int64).reshape(-1, 2).T
    rates = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz, "rate_hz": rate_hz}
    found = pl.DataFrame(findings, schema=FINDINGS, orient="row")
    return mark_findings(vehicle_id, tick, found, **rates).tolist()


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        # 25 Hz at 5 Hz: ticks 0, 1, 2, 3 lie at frames 1, 6, 11, 16.
        (1, 1, [1, 0, 0, 0]),
        (2, 2, [0, 1, 0, 0]),  # between two ticks
        (6, 6, [0, 1, 0, 0]),
        (7, 7, [0, 0, 1, 0]),
        (6, 7, [0, 1, 1, 0]),
        (8, 9, [0, 0, 1, 0]),
        (1, 16, [1, 1, 1, 1]),
        (17, 90, [0, 0, 0, 0]),  # after the last tick
        (-3, 0, [1, 0, 0, 0]),  # a tick answers for the frames before it, also where the track begins
        (-9, -4, [0, 0, 0, 0]),
    ],
)
def test_at_5_hz_a_tick_answers_for_the_five_frames_up_to_its_own(first, last, expected):
    entries = [(4, tick) for tick in range(4)]
    assert mark(entries, [(4, "error", first, last)]) == expected


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        # 25 Hz at 10 Hz: ticks 0, 1, 2, 3 lie at frames 1, 3.5, 6, 8.5.
        (1, [2, 0, 0, 0]),
        (2, [0, 2, 0, 0]),
        (3, [0, 2, 0, 0]),
        (4, [0, 2, 2, 0]),  # tick 1 is made of frames 3 and 4; frame 4 also lies after it
        (5, [0, 0, 2, 0]),
        (6, [0, 0, 2, 0]),
        (7, [0, 0, 0, 2]),
        (9, [0, 0, 0, 2]),
        (10, [0, 0, 0, 0]),
    ],
)
def test_a_tick_between_two_frames_answers_for_both(frame, expected):
    assert mark([(4, tick) for tick in range(4)], [(4, "warning", frame, frame)], rate_hz=10) == expected


def test_the_worst_of_several_counts_and_only_the_vehicles_own():
    findings = [(4, "info", 1, 11), (4, "error", 6, 6), (4, "warning", 5, 11), (3, "error", 1, 99), (5, "error", 1, 99)]
    assert mark([(4, 0), (4, 1), (4, 2)], findings) == [3, 1, 2]


def test_no_entries_and_no_findings():
    assert mark([], [(4, "error", 1, 2)]) == []
    assert mark([(4, 0), (4, 9)], []) == [0, 0]


@settings(max_examples=50, deadline=None)
@given(
    entries=st.sets(st.tuples(IDS, st.integers(0, 8)), max_size=12),
    findings=st.lists(st.tuples(IDS, st.sampled_from(SEVERITIES), st.integers(0, 28), st.integers(0, 9)), max_size=6),
    first_frame=st.sampled_from([0, 1, 17]),
    rates=st.sampled_from([(25.0, 5), (25.0, 10), (10.0, 10), (10.0, 5), (30000 / 1001, 10)]),
)
def test_every_frame_of_every_finding_counts_where_it_should(entries, findings, first_frame, rates):
    frame_rate_hz, rate_hz = rates
    stride = Fraction(frame_rate_hz).limit_denominator(1001) / rate_hz
    found = [
        (who, severity, first_frame + begin, first_frame + begin + more) for who, severity, begin, more in findings
    ]
    expected = []
    for who, tick in sorted(entries):
        place, before = first_frame + tick * stride, first_frame + (tick - 1) * stride
        worst = 0
        for owner, severity, first, last in found:
            for frame in range(first, last + 1):
                # After the tick before, and no later than the tick or the frame that it is interpolated towards.
                if owner == who and before < frame < place + 1:
                    code = 1 + SEVERITIES.index(severity)
                    worst = min(worst or code, code)
        expected.append(worst)
    assert (
        mark(sorted(entries), found, first_frame=first_frame, frame_rate_hz=frame_rate_hz, rate_hz=rate_hz) == expected
    )


@settings(max_examples=15, deadline=None)
@given(
    sizes=st.dictionaries(
        IDS, st.tuples(st.none() | st.floats(0, 100, width=32), st.none() | st.floats(0, 20, width=32))
    ),
    draw=st.randoms(use_true_random=False),
)
def test_sizes_are_those_of_their_vehicles_in_any_order(sizes, draw):
    rows = [(who, *size) for who, size in sizes.items()]
    schema = {"vehicle_id": pl.Int32, "length_m": pl.Float32, "width_m": pl.Float32}
    wanted = [draw.choice(sorted(sizes)) for _ in range(5)] if sizes else []
    frame = pl.DataFrame(rows, schema=schema, orient="row")
    length_m, width_m = find_sizes(frame, np.array(wanted, dtype=np.int64), where="highd/a")
    for values, axis in ((length_m, 0), (width_m, 1)):
        assert values.dtype == np.float32
        expected = [np.nan if sizes[who][axis] is None else sizes[who][axis] for who in wanted]
        np.testing.assert_array_equal(values, np.array(expected, dtype=np.float32))


def test_a_vehicle_without_a_row_is_refused():
    none = pl.DataFrame(schema={"vehicle_id": pl.Int32, "length_m": pl.Float32, "width_m": pl.Float32})
    with pytest.raises(ValueError, match=r"ngsim/x: expected every vehicle .*, got 2 runs of others, .* vehicle 8"):
        find_sizes(none, np.array([8, 9]), where="ngsim/x")
