"""The k nearest of the whole scene: every lane, everybody, ties by the smaller id."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_context import Place, list_nearest

from tracklake.pipeline.transforms.samples import nearest as module
from tracklake.pipeline.transforms.samples.nearest import find_nearest

INT32_MAX = 2**31 - 1


def make_clock(entries):
    """(vehicle_id, tick, x_m, y_m) rows."""
    schema = {"vehicle_id": pl.Int32, "tick": pl.Int32, "x_m": pl.Float64, "y_m": pl.Float64}
    return pl.DataFrame(entries, schema=schema, orient="row")


def around(entries, k=10, vehicle=1, tick=0):
    clock = make_clock(entries)
    found = clock.with_columns(find_nearest(clock, k)).filter(vehicle_id=vehicle, tick=tick)
    return found["nearest"].item().to_list()


def test_by_distance_in_the_plane():
    """5 m diagonally (3, 4) is nearer than 5.1 m ahead, and farther than 4.9 m beside."""
    others = [(2, 0, 105.1, 0.0), (3, 0, 97.0, 4.0), (4, 0, 100.0, 4.9), (5, 0, 40.0, 0.0)]
    assert around([(1, 0, 100.0, 0.0), *others]) == [4, 3, 2, 5]
    assert around([(1, 0, 100.0, 0.0), *others], k=2) == [4, 3]


def test_equally_far_the_smaller_id_comes_first():
    """Ahead, behind, beside, and (3, 4): all 5 m away, wherever the origin is."""
    for x, y in ((0.0, 0.0), (100.1, 7.3), (639.9, 22.457)):
        others = [(9, 0, x + 5, y), (4, 0, x - 5, y), (7, 0, x, y + 5), (3, 0, x - 3, y + 4), (8, 0, x + 4, y - 3)]
        assert around([(1, 0, x, y), *others]) == [3, 4, 7, 8, 9]
        assert around([(1, 0, x, y), *others], k=3) == [3, 4, 7]


def test_itself_and_other_ticks_are_left_out():
    clock = [(1, 0, 0.0, 0.0), (1, 1, 0.0, 0.0), (2, 1, 1.0, 0.0), (3, 2, 1.0, 0.0)]
    assert around(clock) == []
    assert around(clock, tick=1) == [2]
    assert around(clock, vehicle=3, tick=2) == []


def test_at_the_same_place():
    assert around([(1, 0, 5.0, 1.0), (3, 0, 5.0, 1.0), (2, 0, 5.0, 1.0)]) == [2, 3]
    assert around([(1, 0, 5.0, 1.0), (3, 0, 5.0, 1.0), (2, 0, 5.0, 1.0)], vehicle=2) == [1, 3]


def test_near_along_the_road_is_not_near():
    """Forty abreast, half a metre apart: by x all are alongside, and the nearest stands farthest by x."""
    abreast = [(vehicle, 0, 100.0 + vehicle / 1000, 50.0 + vehicle / 2) for vehicle in range(2, 42)]
    assert around([(1, 0, 100.0, 0.0), *abreast, (50, 0, 140.0, 0.0), (51, 0, 60.5, 0.0)], k=3) == [51, 50, 2]


def test_origins_limit_whose_nearest_are_listed_not_who_is_among_them():
    clock = make_clock([(1, 0, 0.0, 0.0), (2, 0, 1.0, 0.0), (3, 0, 5.0, 0.0)])
    assert find_nearest(clock, 5, np.array([False, True, False])).to_list() == [[1, 3]]
    assert find_nearest(clock, 5, np.zeros(3, bool)).to_list() == []


def test_no_entries_and_one_entry():
    for entries, expected in (([], []), ([(INT32_MAX, INT32_MAX, 1.5, 0.0)], [[]])):
        found = find_nearest(make_clock(entries), 3)
        assert (found.name, found.dtype, found.to_list()) == ("nearest", pl.List(pl.Int32), expected)


def test_at_least_one_is_asked_for():
    with pytest.raises(ValueError, match="cannot list the 0 nearest"):
        find_nearest(make_clock([]), 0)


POSITIONS = st.one_of(st.integers(-60_000, 60_000), st.integers(-3, 3).map(lambda metres: 1000 * metres))
ENTRIES = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 2, 3, 5, 8, 13, 21, 34, 55, INT32_MAX - 1, INT32_MAX]),
        st.sampled_from([0, 1, INT32_MAX]),
        POSITIONS,
        POSITIONS,
    ),
    unique_by=lambda entry: entry[:2],
    max_size=30,
)


@settings(max_examples=30, deadline=None)
@given(ENTRIES, st.integers(1, 12), st.sampled_from([1, 4, 1 << 13]), st.data())
def test_agrees_with_a_loop_over_origins_whatever_the_order_and_the_blocks(entries, k, block_rows, data):
    """Millimetres, in any order of rows."""
    clock = {(vehicle, tick): Place(2 * x, 2 * y, 1, None, (0, 0)) for vehicle, tick, x, y in entries}
    wanted = np.array(data.draw(st.lists(st.booleans(), min_size=len(entries), max_size=len(entries))), bool)
    expected = [
        list_nearest(clock, *entry[:2], k) for entry, is_origin in zip(entries, wanted, strict=True) if is_origin
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BLOCK_ROWS", block_rows)
        found = find_nearest(make_clock([(v, t, x / 1000, y / 1000) for v, t, x, y in entries]), k, wanted)
    assert found.to_list() == expected


def test_crowded_road_agrees_with_the_loop():
    """Two hundred on a grid of metres: many at the same place, many equally far, some to be looked for twice."""
    rng = np.random.default_rng(5)
    entries = [(v, t, int(rng.integers(0, 60)), int(rng.integers(0, 60))) for t in (3, 4) for v in range(200)]
    clock = {(v, t): Place(x, y, 1, None, (0, 0)) for v, t, x, y in entries}
    found = find_nearest(make_clock([(v, t, float(x), float(y)) for v, t, x, y in entries]), 10)
    assert found.to_list() == [list_nearest(clock, v, t, 10) for v, t, _, _ in entries]
