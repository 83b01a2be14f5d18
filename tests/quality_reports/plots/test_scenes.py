"""The player's packed scenes: against a slow obvious loop, and within their limit of size."""

import base64
import struct

import numpy as np
import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.plots.scenes import (
    find_stretches,
    mark_segments,
    pack_entries,
    prepare_entries,
    select_ticks,
)

SCHEMA = {
    "vehicle_id": pl.Int32,
    "tick": pl.Int32,
    "x_m": pl.Float64,
    "y_m": pl.Float64,
    "speed_mps": pl.Float32,
    "heading_rad": pl.Float32,
}
ENTRY = st.tuples(
    st.sampled_from([1, 2, 2**31 - 1]),
    st.integers(0, 12),
    st.sampled_from([-50.0, 0.0, 0.04, 3.3, 12.7, 12.8, 900.0]),
    st.sampled_from([-1.0, 0.0, 0.5, 1.27, 1.3]),
    st.sampled_from([-3.0, 0.0, 7.8, 90.0]),
    st.sampled_from([-1.6, 0.0, 0.02, 1.6]),
)


def frame(rows) -> pl.DataFrame:
    """Entries, of which vehicle 1 alone has a known size."""
    known = pl.col("vehicle_id") == 1
    sizes = {"length_m": pl.when(known).then(4.04), "width_m": pl.when(known).then(2.0)}
    return pl.DataFrame(sorted(rows), schema=SCHEMA, orient="row").with_columns(**sizes)


def unpack(packed: dict[str, str]) -> dict[tuple[int, int], tuple]:
    """Read what the page's script reads: (x, y, speed, heading, length, width) by vehicle and tick."""
    heads, entries = (base64.b64decode(packed[name]) for name in ("segments", "entries"))
    row = iter(struct.iter_unpack("<bbBb", entries))
    read = {}
    for vehicle, tick, count, x, y, length, width in struct.iter_unpack("<7i", heads):
        for step in range(count):
            dx, dy, speed, heading = next(row)
            x, y = x + dx, y + dy
            read[vehicle, tick + step] = (x, y, speed, heading, length, width)
    assert next(row, None) is None
    return read


@settings(max_examples=50, deadline=None)
@given(st.lists(ENTRY, max_size=25, unique_by=lambda entry: entry[:2]), st.sets(st.integers(0, 12)))
def test_packed_entries_are_the_rounded_ones(rows, ticks):
    entries = prepare_entries(frame(rows))
    packed = pack_entries(entries, np.array(sorted(ticks), np.int64))
    sizes = {1: (40, 20)}
    expected = {
        (vehicle, tick): (
            round(x * 10),
            round(y * 100),
            min(255, max(0, round(speed * 3.6 + 40))),
            min(127, max(-127, round(np.float32(heading).item() * 75))),
            *sizes.get(vehicle, (45, 18)),
        )
        for vehicle, tick, x, y, speed, heading in rows
        if tick in ticks
    }
    read = unpack(packed)
    assert read.keys() == expected.keys()
    for key, values in expected.items():
        # Halves round up or down.
        assert all(abs(got - wanted) <= 1 for got, wanted in zip(read[key], values, strict=True)), key
        assert read[key][:2] == values[:2]


def test_a_jump_a_gap_and_another_vehicle_begin_a_segment():
    rows = [(1, 0, 0.0), (1, 1, 12.7), (1, 2, 25.5), (1, 4, 30.0), (1, 5, 31.0), (2, 6, 31.0)]
    marked = prepare_entries(frame([(vehicle, tick, x, 0.0, 5.0, 0.0) for vehicle, tick, x in rows]))
    assert marked["begins"].to_list() == [True, False, True, True, False, True]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(ENTRY, max_size=30, unique_by=lambda entry: entry[:2]),
    st.lists(st.tuples(st.integers(0, 12), st.integers(0, 4)), max_size=4),
    st.integers(0, 900),
)
def test_what_is_selected_fits_and_comes_in_order(rows, begins, most_bytes):
    windows = [(begin, min(12, begin + length)) for begin, length in begins]
    fetched = {*range(7), *(tick for begin, end in windows for tick in range(begin, end + 1))}
    entries = prepare_entries(frame([row for row in rows if row[1] in fetched]))
    selection = select_ticks(entries, windows, (0, 6), most_bytes)
    packed = pack_entries(entries, selection.ticks)
    assert sum(map(len, packed.values())) <= most_bytes + 8, "base64 fills up to four characters, twice"
    expected = set(range(selection.first_ticks))
    for (begin, end), accepted in zip(windows, selection.accepted, strict=True):
        expected |= set(range(begin, end + 1)) if accepted else set()
    assert selection.ticks.tolist() == sorted(expected)
    if most_bytes == 900 and len(rows) < 5:
        assert selection.first_ticks == 7


def test_the_gravest_window_comes_first_and_the_beginning_last():
    """One vehicle, 13 ticks: a window of 3 ticks costs 2 * 28 + 3 * 4 bytes at most, the rest 4 bytes a tick."""
    entries = prepare_entries(frame([(1, tick, 1.0 * tick, 0.0, 5.0, 0.0) for tick in range(13)]))
    tight = select_ticks(entries, [(8, 10), (3, 5)], (0, 12), 56)
    assert (tight.accepted, tight.first_ticks, tight.ticks.tolist()) == ([True, False], 0, [8, 9, 10])
    loose = select_ticks(entries, [(8, 10), (3, 5)], (0, 12), 4000)
    assert (loose.accepted, loose.first_ticks) == ([True, True], 13)


def test_stretches_are_runs_of_consecutive_ticks():
    assert find_stretches(np.array([0, 1, 2, 5, 7, 8])) == [[0, 2], [5, 5], [7, 8]]
    assert find_stretches(np.array([4])) == [[4, 4]]


def test_nothing_packs_to_nothing():
    empty = prepare_entries(frame([]))
    assert pack_entries(empty, np.empty(0, np.int64)) == {"segments": "", "entries": ""}
    assert mark_segments(empty).is_empty()
