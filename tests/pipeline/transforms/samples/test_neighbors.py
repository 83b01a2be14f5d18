"""The 13 x 3 grid: reach, rounding, lanes, and vehicles that share a cell."""

from fractions import Fraction

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.samples import neighbors as module
from tracklake.pipeline.transforms.samples.neighbors import NEIGHBOR_DTYPES, count_collisions, find_neighbors
from tracklake.schemas.errors import TracklakeError

CELL_M = Fraction("4.572")
INT32_MAX = 2**31 - 1


def make_clock(entries):
    """(vehicle_id, tick, x_m, lane) rows."""
    schema = {"vehicle_id": pl.Int32, "tick": pl.Int32, "x_m": pl.Float64, "lane": pl.Int16}
    return pl.DataFrame(entries, schema=schema, orient="row")


def around(entries, vehicle=1, tick=0):
    """{cell: neighbor} of one vehicle."""
    found = find_neighbors(make_clock(entries)).neighbors.filter(vehicle_id=vehicle, tick=tick)
    return dict(found.select("cell", "neighbor_id").iter_rows())


def test_columns_are_left_own_right_and_row_12_is_ahead():
    others = [(2, 0, 110.0, 1), (3, 0, 90.0, 1), (4, 0, 120.0, 2), (5, 0, 80.0, 2), (6, 0, 100.0, 3), (7, 0, 126.0, 3)]
    # 10 / 4.572 = 2.19, 20 / 4.572 = 4.37, 26 / 4.572 = 5.69
    assert around([(1, 0, 100.0, 2), *others]) == {8: 2, 4: 3, 13 + 10: 4, 13 + 2: 5, 26 + 6: 6, 26 + 12: 7}


def test_only_the_same_tick_and_adjacent_lanes():
    others = [(2, 0, 100.0, 4), (3, 0, 100.0, 0), (4, 1, 100.0, 2), (4, 2, 100.0, 1)]
    assert around([(1, 0, 100.0, 2), *others]) == {}


def test_vehicles_at_other_ticks_change_nothing():
    """Positions between whole units round alike, wherever the least one lies: that of a slice is another."""
    scene = [(1, 1, 0.0, 2), (2, 1, 2.286 - 4e-8, 2)]
    assert around(scene, tick=1) == {13 + 7: 2}
    assert around([(1, 0, -0.99999997, 2), *scene], tick=1) == {13 + 7: 2}


def test_lanes_of_neighbouring_ticks_are_not_adjacent():
    """The highest lane of one tick and the lowest of the next are sorted beside one another."""
    assert find_neighbors(make_clock([(1, 0, 0.0, 3), (2, 1, 0.0, 1), (3, 2, 0.0, 3)])).neighbors.is_empty()


@pytest.mark.parametrize("own_x_m", [0.0, 0.1, 100.0, 327.331, 639.9])
def test_reach_is_exclusive(own_x_m):
    assert around([(1, 0, own_x_m, 2), (2, 0, own_x_m + 27.432, 2), (3, 0, own_x_m - 27.432, 1)]) == {}
    near = [(2, 0, own_x_m + 27.431, 2), (3, 0, own_x_m - 27.431, 1)]
    assert around([(1, 0, own_x_m, 2), *near]) == {13 + 12: 2, 0: 3}


@pytest.mark.parametrize("own_x_m", [0.0, 0.1, 100.0, 327.331, 639.9])
def test_halves_are_rounded_away_from_zero(own_x_m):
    """2.286 m is half a cell, 6.858 m one and a half."""
    ahead = [(2, 0, own_x_m + 2.286, 2), (3, 0, own_x_m + 6.858, 2)]
    behind = [(4, 0, own_x_m - 2.286, 2), (5, 0, own_x_m - 6.858, 2)]
    assert around([(1, 0, own_x_m, 2), *ahead, *behind]) == {13 + 7: 2, 13 + 8: 3, 13 + 5: 4, 13 + 4: 5}
    assert around([(1, 0, own_x_m, 2), (2, 0, own_x_m + 2.285, 2)]) == {13 + 6: 2}


def test_positions_in_feet():
    """7.5 ft is half a cell, 90 ft out of reach, whatever the position in metres rounds to."""
    for own_ft in np.arange(0.0, 2000.0, 37.123):
        x = own_ft * 0.3048
        assert around([(1, 0, x, 2), (2, 0, (own_ft + 7.5) * 0.3048, 2)]) == {13 + 7: 2}
        assert around([(1, 0, x, 2), (2, 0, (own_ft + 90) * 0.3048, 2)]) == {}


def test_rows_and_offsets():
    found = find_neighbors(make_clock([(1, 0, 100.0, 2), (2, 0, 109.5, 2)])).neighbors
    assert dict(found.schema) == NEIGHBOR_DTYPES
    assert found.rows() == [(1, 0, 13 + 8, 2, 9.5), (2, 0, 13 + 4, 1, -9.5)]


def test_side_by_side_and_at_the_same_place():
    """Self is left out, another vehicle at dx = 0 is not, not even in the own lane."""
    assert around([(1, 0, 50.0, 1), (2, 0, 50.0, 2)]) == {26 + 6: 2}
    assert around([(1, 0, 50.0, 1), (2, 0, 50.0, 1)]) == {13 + 6: 2}
    assert around([(1, 0, 50.0, 1), (2, 0, 50.0, 1)], vehicle=2) == {13 + 6: 1}


def test_lane_zero_is_a_lane():
    assert around([(1, 0, 50.0, 0), (2, 0, 50.0, 1)]) == {26 + 6: 2}
    assert around([(1, 0, 50.0, 1), (2, 0, 50.0, 0)]) == {6: 2}


def test_unknown_lane_has_no_neighbors_and_is_none():
    clock = make_clock([(1, 0, 50.0, None), (2, 0, 50.0, 1), (3, 0, 50.0, 1)])
    assert find_neighbors(clock).neighbors.select("vehicle_id", "neighbor_id").rows() == [(2, 3), (3, 2)]
    wanted = find_neighbors(clock, np.array([True, False, True])).neighbors
    assert wanted.select("vehicle_id", "neighbor_id").rows() == [(3, 2)]
    assert find_neighbors(clock.filter(pl.col("lane").is_null())).neighbors.is_empty()


def test_nearest_keeps_the_cell_and_the_other_moves_to_the_nearest_free_one():
    """Both 9 and 10 m lie in row 8; 10 moves ahead (its dx points there) although row 7 is as near."""
    found = find_neighbors(
        make_clock([(1, 0, 0.0, 2), (2, 0, 10.0, 3), (3, 0, 9.0, 3)]), np.array([True, False, False])
    )
    assert found.neighbors.select("cell", "neighbor_id").rows() == [(26 + 8, 3), (26 + 9, 2)]
    assert (found.collisions, found.crowded_out) == (1, 0)
    behind = around([(1, 0, 0.0, 2), (2, 0, -10.0, 3), (3, 0, -9.0, 3)])
    assert behind == {26 + 4: 3, 26 + 3: 2}


def test_home_cells_are_given_before_anybody_moves():
    """Row 9 ahead is the home of vehicle 4, so vehicle 2 moves back to row 7."""
    assert around([(1, 0, 0.0, 2), (2, 0, 10.0, 3), (3, 0, 9.0, 3), (4, 0, 14.0, 3)]) == {
        26 + 7: 2,
        26 + 8: 3,
        26 + 9: 4,
    }


def test_equally_near_the_smaller_id_keeps_the_cell():
    """Alongside: ahead and behind by the same distance; then all at one place."""
    assert around([(1, 0, 0.0, 2), (9, 0, 2.0, 3), (4, 0, -2.0, 3)]) == {26 + 6: 4, 26 + 7: 9}
    assert around([(1, 0, 0.0, 2), (4, 0, 2.0, 3), (9, 0, -2.0, 3)]) == {26 + 6: 4, 26 + 5: 9}
    assert around([(1, 0, 0.0, 2), (5, 0, 0.0, 3), (3, 0, 0.0, 3), (4, 0, 0.0, 3)]) == {
        26 + 6: 3,
        26 + 7: 4,
        26 + 5: 5,
    }


def test_the_end_of_the_column_turns_movers_back():
    """Both in row 12: there is nothing ahead of it."""
    assert around([(1, 0, 0.0, 2), (2, 0, 26.0, 2), (3, 0, 27.0, 2)]) == {13 + 12: 2, 13 + 11: 3}


def test_all_in_one_cell():
    """Fifteen vehicles on one spot of the left lane: cell 6, then 7, 5, 8, 4 ... in turn; two find no room."""
    entries = [(1, 0, 0.0, 2)] + [(10 + i, 0, 0.0, 1) for i in range(15)]
    found = find_neighbors(make_clock(entries), np.arange(16) == 0)
    cells = [6, 7, 5, 8, 4, 9, 3, 10, 2, 11, 1, 12, 0]
    assert dict(found.neighbors.select("neighbor_id", "cell").iter_rows()) == {10 + i: c for i, c in enumerate(cells)}
    assert (found.collisions, found.crowded_out) == (14, 2)


def test_more_on_one_spot_than_a_byte_counts():
    """Around the first are 299: one keeps the cell, twelve find another, the rest none."""
    entries = [(vehicle, 0, 7.0, 2) for vehicle in range(300)]
    found = find_neighbors(make_clock(entries), np.arange(300) == 0)
    assert found.neighbors.sort("neighbor_id")["neighbor_id"].to_list() == list(range(1, 14))
    assert (found.collisions, found.crowded_out) == (298, 286)


def test_origins_limit_whose_neighbors_are_found_not_who_is_one():
    clock = make_clock([(1, 0, 0.0, 2), (1, 1, 1.0, 2), (2, 0, 5.0, 2), (2, 1, 6.0, 2)])
    found = find_neighbors(clock, np.array([False, True, False, False])).neighbors
    assert found.select("vehicle_id", "tick", "neighbor_id").rows() == [(1, 1, 2)]
    assert find_neighbors(clock, np.zeros(4, bool)).neighbors.is_empty()


def test_no_entries_and_one_entry():
    for entries in ([], [(INT32_MAX, INT32_MAX, 1.5, 3)]):
        found = find_neighbors(make_clock(entries))
        assert dict(found.neighbors.schema) == NEIGHBOR_DTYPES
        assert (found.neighbors.height, found.collisions, found.crowded_out) == (0, 0, 0)


def test_too_wide_a_span_is_refused():
    clock = make_clock([(1, 0, 0.0, 1), (2, INT32_MAX, 20_000.0, 1)])
    with pytest.raises(
        TracklakeError, match="too wide a span to search for neighbors: pass the entries of one recording"
    ):
        find_neighbors(clock)


def test_a_longer_cell_reaches_farther_with_as_many_rows():
    """30 feet, 9.144 m: 20 m are 2.19 cells, 54.863 m 5.9999; 54.864 m are no longer within reach."""
    clock = make_clock([(1, 0, 100.0, 2), (2, 0, 120.0, 2), (3, 0, 154.863, 1), (4, 0, 45.136, 3), (5, 0, 45.137, 3)])
    found = find_neighbors(clock, np.arange(5) == 0, cell_m=9.144).neighbors
    assert dict(found.select("cell", "neighbor_id").iter_rows()) == {13 + 8: 2, 12: 3, 26: 5}


def slow_neighbors(entries, cell_m=CELL_M):
    """One origin after the other, in exact arithmetic (x in thousandths)."""
    rows, collisions, crowded_out = [], 0, 0
    for vehicle, tick, x, lane in entries:
        for column in range(3):
            home = []
            for other, other_tick, other_x, other_lane in entries:
                dx = Fraction(other_x - x, 1000)
                if (other, other_tick) == (vehicle, tick) or other_tick != tick or other_lane - lane != column - 1:
                    continue
                if abs(dx) < 6 * cell_m:
                    half_up = int(abs(dx) / cell_m + Fraction(1, 2))
                    home.append((abs(dx), other, 6 + (half_up if dx > 0 else -half_up), dx))
            home.sort()
            cells, movers = {}, []
            for candidate in home:
                if candidate[2] in cells:
                    movers.append(candidate)
                else:
                    cells[candidate[2]] = candidate
            collisions += len(movers)
            for candidate in movers:
                side = 1 if candidate[3] >= 0 else -1
                free = [row for row in range(13) if row not in cells]
                if not free:
                    crowded_out += 1
                    continue
                steps = [(abs(row - candidate[2]), -side * (row - candidate[2]), row) for row in free]
                cells[min(steps)[2]] = candidate
            rows += [(vehicle, tick, 13 * column + row, c[1], c[3]) for row, c in sorted(cells.items())]
    return rows, collisions, crowded_out


ENTRIES = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 2, 3, 5, 8, 13, 21, 34, 55, INT32_MAX - 1, INT32_MAX]),
        st.integers(0, 2),
        st.one_of(st.integers(-60_000, 60_000), st.integers(-3, 3).map(lambda k: 2286 * k), st.integers(0, 3_000)),
        st.integers(0, 3),
    ),
    unique_by=lambda entry: entry[:2],
    max_size=30,
).map(sorted)


@settings(max_examples=30, deadline=None)
@given(
    ENTRIES,
    st.randoms(use_true_random=False),
    st.sampled_from([1, 3, 1 << 14]),
    st.sampled_from(["4.572", "9.144", "1", "7.3"]),
)
def test_agrees_with_a_loop_over_origins_whatever_the_order_and_the_chunks(entries, random, chunk_rows, cell_m):
    expected, collisions, crowded_out = slow_neighbors(entries, Fraction(cell_m))
    shuffled = list(entries)
    random.shuffle(shuffled)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CHUNK_ROWS", chunk_rows)
        clock = make_clock([(v, t, x / 1000, lane) for v, t, x, lane in shuffled])
        found, counted = find_neighbors(clock, cell_m=float(cell_m)), count_collisions(clock)
    names = ("vehicle_id", "tick", "cell", "neighbor_id")
    rows = found.neighbors.sort("vehicle_id", "tick", "cell")
    assert rows.select(names).rows() == [row[:4] for row in expected]
    assert rows["dx_m"].to_list() == [float(np.float32(float(row[4]))) for row in expected]
    assert (found.collisions, found.crowded_out) == (collisions, crowded_out)
    assert counted == slow_neighbors(entries)[1]  # as published, whatever the cell


@pytest.mark.parametrize("grain_mm", [1, 2_000])
def test_crowded_road_agrees_with_the_loop(grain_mm):
    """Forty vehicles within 30 m of two lanes: many collisions, many equally near, some crowded out."""
    rng = np.random.default_rng(11)
    entries = [
        (vehicle, tick, int(rng.integers(0, 30_000 // grain_mm)) * grain_mm, int(rng.integers(1, 3)))
        for vehicle in range(40)
        for tick in (4, 5)
    ]
    expected, collisions, crowded_out = slow_neighbors(entries)
    clock = make_clock([(v, t, x / 1000, lane) for v, t, x, lane in entries])
    found, counted = find_neighbors(clock), count_collisions(clock)
    assert found.neighbors.select("vehicle_id", "tick", "cell", "neighbor_id").rows() == [row[:4] for row in expected]
    assert (found.collisions, found.crowded_out) == (collisions, crowded_out)
    assert counted == collisions
    assert crowded_out > 0
