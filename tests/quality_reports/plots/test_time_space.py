"""Packed time-space diagrams: against a slow obvious loop, and marks that are thinned but lose no finding."""

import base64
import struct

import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.plots.time_space import MOST_POINTS, choose_step, draw_scale, pack_diagrams, place_marks

POINTS = {
    "vehicle_id": pl.Int32,
    "frame": pl.Int32,
    "lane": pl.Int16,
    "x_m": pl.Float64,
    "speed_mps": pl.Float32,
}
ERRORS = {"vehicle_id": pl.Int32, "rule": pl.String, "first_frame": pl.Int32, "last_frame": pl.Int32}
POINT = st.tuples(
    st.integers(1, 3),
    st.integers(0, 8).map(lambda tick: 5 * tick),
    st.sampled_from([None, 1, 2]),
    st.sampled_from([-20.0, 0.0, 12.7, 13.0, 25.4, 25.6, 700.0]),
    st.sampled_from([-20.0, -0.2, 0.0, 27.8, 90.0]),
)


def unpack(packed: dict) -> list[tuple]:
    """Read what the page's script reads: lane, vehicle, tick, x in units and speed in km/h."""
    heads, points = (base64.b64decode(packed[name]) for name in ("segments", "points"))
    row = iter(struct.iter_unpack("<bB", points))
    read = []
    for lane, vehicle, first, count, x in struct.iter_unpack("<5i", heads):
        for step in range(count):
            by, speed = next(row)
            x += by
            read.append((lane, vehicle, first + step, x, speed - 40))
    assert next(row, None) is None
    return read


@settings(max_examples=40, deadline=None)
@given(st.lists(POINT, max_size=20, unique_by=lambda point: point[:2]))
def test_every_point_is_packed_once_and_read_as_it_was(rows):
    packed = pack_diagrams(pl.DataFrame(rows, POINTS, orient="row"), pl.DataFrame(schema=ERRORS), 5, 25.0)
    assert (packed["seconds"], packed["unit_m"]) == (0.2, 0.1)
    expected = sorted(
        (-1 if lane is None else lane, vehicle, frame // 5, round(x * 10), min(215, max(-40, round(speed * 3.6))))
        for vehicle, frame, lane, x, speed in rows
    )
    read = unpack(packed)
    assert read == sorted(read)
    assert [point[:4] for point in read] == [point[:4] for point in expected]
    assert all(abs(got[4] - wanted[4]) <= 1 for got, wanted in zip(read, expected, strict=True))


def test_lane_changes_gaps_and_jumps_begin_segments():
    rows = [
        (1, 0, 1, 0.0, 5.0),
        (1, 5, 1, 12.7, 5.0),
        (1, 10, 2, 13.0, 5.0),
        (1, 20, 2, 14.0, 5.0),
        (1, 25, 2, 40.0, 5.0),
    ]
    packed = pack_diagrams(pl.DataFrame(rows, POINTS, orient="row"), pl.DataFrame(schema=ERRORS), 5, 25.0)
    heads = list(struct.iter_unpack("<5i", base64.b64decode(packed["segments"])))
    assert heads == [(1, 1, 0, 2, 0), (2, 1, 2, 1, 130), (2, 1, 4, 1, 140), (2, 1, 5, 1, 400)]


def test_a_mark_stands_at_the_middle_of_its_finding():
    points = pl.DataFrame(
        [(1, 7, 50, 10, 3.0), (1, 7, 60, 12, 8.04)],
        {"lane": pl.Int32, "vehicle_id": pl.Int32, "frame": pl.Int32, "tick": pl.Int32, "x_m": pl.Float64},
        orient="row",
    )
    found = pl.DataFrame([(7, "overlap", 52, 62), (8, "overlap", 52, 62)], ERRORS, orient="row")
    assert place_marks(points, found).rows() == [(1, 12, 8.0, 1, "overlap", 7)], "vehicle 8 has no point"


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 600)), min_size=1, max_size=60), st.integers(1, 9))
def test_marks_are_thinned_and_count_every_finding(found, most):
    points = pl.DataFrame(
        [(1, 7, 5 * tick, tick, 3.0 * tick) for tick in range(130)],
        {"lane": pl.Int32, "vehicle_id": pl.Int32, "frame": pl.Int32, "tick": pl.Int32, "x_m": pl.Float64},
        orient="row",
    )
    errors = pl.DataFrame([(7, "overlap", first, first + more) for more, first in found], ERRORS, orient="row")
    marks = place_marks(points, errors, most)
    assert marks.height <= most
    assert marks["findings"].sum() == len(found)


def test_a_recording_of_any_length_keeps_within_the_points():
    assert [choose_step(entries, 5) for entries in (0, 5 * MOST_POINTS, 5 * MOST_POINTS + 1)] == [5, 5, 10]
    assert choose_step(1_200_000, 2) == 12


def test_the_legend_has_both_units():
    svg = draw_scale(25.0)
    assert ">90<" not in svg
    assert all(f">{text}<" in svg for text in ("km/h", "m/s", "80", "25"))
