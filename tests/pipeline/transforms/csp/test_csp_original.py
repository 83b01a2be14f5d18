"""The faithful files against a slow re-statement of the original script, value for value in single precision."""

from fractions import Fraction

import numpy as np
import polars as pl
import pytest
from csp_script import PARTS, run_script
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.csp.entries import to_feet
from tracklake.pipeline.transforms.csp.grid import CHUNK_ROWS
from tracklake.pipeline.transforms.csp.parts import TEST, TRAIN, VAL, assign_parts_by_id, number_datasets
from tracklake.pipeline.transforms.csp.subset import (
    CspRecording,
    prepare_original_subset,
    put_on_csp_clock,
    stack_tracks,
)
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.errors import TracklakeError

DTYPES = {
    "vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64, "y_m": pl.Float64, "lane": pl.Int16,
}  # fmt: skip


def prepare(rows, *, dataset=1, last_lane=None, vehicles=None, full_future=False):
    """Rows of the script, (Vehicle_ID, Frame_ID, Local_X, Local_Y, Lane_ID) in feet, as the lake holds them."""
    metres = [(v, f, float(y) * FOOT_M, float(x) * FOOT_M, lane) for v, f, x, y, lane in rows]
    tracks = pl.DataFrame(metres, schema=DTYPES, orient="row").sort("vehicle_id", "frame")
    ids = tracks.select(pl.col("vehicle_id").unique().sort())
    names = ids.with_columns(source_vehicle_id=pl.col("vehicle_id").replace(vehicles or {}))
    recorded = CspRecording(dataset, tracks["frame"].min(), 10.0, last_lane)
    return prepare_original_subset(put_on_csp_clock(tracks, recorded), names, recorded, full_future=full_future)


def assemble(subset, part):
    blocks = list(subset.assemble_samples(subset.find_samples(part), subset.open_grid()))
    return np.concatenate(blocks, axis=1).T if blocks else np.zeros((0, 47), np.float32)


def compare(rows, **options):
    """Hold the fast path against the script, on rows sorted as the files are; gives the subset."""
    rows = sorted(rows, key=lambda row: row[:2])
    folded = (options.get("dataset", 1),) if options.get("last_lane") else ()
    expected, stopped_on = run_script({options.get("dataset", 1): rows}, folded)
    subset = prepare(rows, **options)
    lengths = np.unique(subset.entries.track_id, return_counts=True)[1]
    assert stopped_on == (lengths < 31).sum()
    for code, part in enumerate(PARTS):
        samples, tracks = expected[part]
        found = assemble(subset, code)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, np.array(samples, np.float32).reshape(-1, 47))
        ids, lengths, values = stack_tracks(subset, code)
        assert ids.tolist() == sorted(vehicle for _, vehicle in tracks)
        starts = np.cumsum(lengths) - lengths
        for vehicle, start, length in zip(ids.tolist(), starts, lengths, strict=True):
            np.testing.assert_array_equal(values[start : start + length].T, tracks[options.get("dataset", 1), vehicle])
        assert samples == [] or len(samples) + sum(counts[code] for counts in subset.dropped.values()) == len(values)
    return subset


def drive(vehicle, frames, *, lane=2, y=0.0, step=5.0, x=20.5):
    return [(vehicle, frame, x, round(y + step * place, 3), lane) for place, frame in enumerate(frames)]


@st.composite
def recordings(draw):
    """A few vehicles on a short road, at places that often are halves of a cell or multiples of its length apart."""
    rows = []
    for vehicle in draw(st.lists(st.integers(1, 40), min_size=1, max_size=6, unique=True)):
        length = draw(st.sampled_from([1, 2, 30, 31, 32, 33, 34, 45, 82, 95]))
        start = draw(st.integers(1, 12)) + draw(st.sampled_from([0, 0, 0, 40]))
        gap = draw(st.tuples(st.integers(1, length), st.sampled_from([0, 0, 1, 7, 60])))
        place = draw(st.integers(-8, 14)) * 7.5 + draw(st.sampled_from([0, 0, 1200, 16000])) + draw(
            st.sampled_from([0, 0, 0.001, -0.001, 0.1, 3.7])
        )  # fmt: skip
        step, later = draw(st.tuples(*[st.sampled_from([0.0, 0.0, 1.5, 5.0, 4.0, 0.01, -0.3])] * 2))
        lanes = draw(st.tuples(*[st.integers(0, 8)] * 3))
        turns = sorted(draw(st.tuples(*[st.integers(0, 100)] * 3)))
        for row in range(length):
            frame = start + row + (gap[1] if row >= gap[0] else 0)
            y = place + step * min(row, turns[0]) + later * max(0, row - turns[0])
            lane = lanes[0] if row < turns[1] else lanes[1] if row < turns[2] else lanes[2]
            rows.append((vehicle, frame, round(11.9 + row / 8, 3), round(y, 3), lane))
    return rows


@given(recordings(), st.sampled_from([None, 6]))
@settings(max_examples=20, deadline=None)
@example(drive(1, [7]), None)  # one vehicle, one frame
@example(drive(3, range(5)) + drive(4, range(9)), None)  # shorter than any window
@example(drive(1, range(40)) + drive(2, range(40), lane=3) + drive(7, range(40)), None)  # side by side, one even inside
@example(drive(1, range(40), lane=0) + drive(2, range(40), lane=1, y=9), None)  # lane 0
@example(drive(5, [*range(35), *range(90, 130)]) + drive(6, range(130), lane=1, step=3), None)  # leaves and returns
@example([row for v in range(1, 9) for row in drive(v, range(36), lane=2 + v % 2, y=v * 0.4)], 6)  # all in one cell
@example(drive(1, range(40), lane=5) + drive(2, range(40), lane=7, y=30) + drive(3, range(40), lane=8), 6)  # the ramps
def test_files_are_those_of_the_script(rows, last_lane):
    compare(rows, last_lane=last_lane)


def test_many_samples_at_once_are_put_together_in_order():
    """More origins than one chunk of the grid holds."""
    vehicles = CHUNK_ROWS // 500
    rows = [row for v in range(1, vehicles + 4) for row in drive(v, range(v, v + 560), lane=1 + v % 3, y=20.0 * v)]
    subset = prepare(rows)
    samples = np.flatnonzero(subset.kept)
    assert samples.size > CHUNK_ROWS
    ids = subset.open_grid().fill_grids(samples)
    pick = np.array([0, CHUNK_ROWS - 1, CHUNK_ROWS, samples.size - 1])
    assert np.array_equal(ids[pick], subset.open_grid().fill_grids(samples[pick]))
    assert np.array_equal(assemble(subset, TRAIN)[:, 1:3], np.stack(
        [values[subset.find_samples(TRAIN)] for values in (subset.entries.track_id, subset.entries.frame)], axis=1
    ))  # fmt: skip


def cells_around(*others, own=(50, 1000.0, 2)):
    """{cell: id} around one vehicle at one frame; others are (id, y, lane)."""
    rows = [(vehicle, 1, 20.0, y, lane) for vehicle, y, lane in (own, *others)]
    subset = prepare(rows)
    (grid,) = subset.open_grid().fill_grids(np.flatnonzero(subset.entries.track_id == own[0]))
    return {cell: int(vehicle) for cell, vehicle in enumerate(grid) if vehicle}


def test_cells_round_half_away_from_zero_before_the_offset_is_taken():
    """(dy + 90) / 15: 7.5 ahead is 6.5, up to 7; 7.5 behind 5.5, up to 6; 82.5 behind 0.5, up to 1."""
    assert cells_around((1, 1007.5, 2), (2, 992.5, 1), (3, 917.5, 3), (4, 1082.5, 3)) == {
        13 + 7: 1, 6: 2, 26 + 1: 3, 26 + 12: 4,
    }  # fmt: skip


def test_reach_is_exclusive_and_only_the_own_lane_excludes_what_is_alongside():
    assert cells_around((1, 1090.0, 2), (2, 910.0, 1), (3, 1000.0, 2)) == {}
    assert cells_around((1, 1089.99, 2), (2, 910.01, 1), (3, 1000.0, 3)) == {13 + 12: 1, 0: 2, 26 + 6: 3}


def test_the_later_row_keeps_the_cell_not_the_nearer_vehicle():
    assert cells_around((3, 1010.0, 3), (9, 1012.0, 3), (70, 990.0, 1), (60, 991.0, 1)) == {26 + 7: 9, 5: 70}


def test_places_before_the_section_are_sorted_as_numbers():
    assert cells_around((1, -40.0, 2), (2, -5.0, 2), (3, 10.0, 2), (4, 75.0, 2), own=(50, -20.0, 2)) == {
        13 + 5: 1, 13 + 7: 2, 13 + 8: 3,
    }  # fmt: skip


def test_single_precision_decides_where_decimals_would_not():
    """7.5 ft apart as written; as singles 1.1 and 8.6 are 7.5000005 apart, 1016.601 and 1024.101 7.4999390."""
    assert cells_around((1, 8.6, 2), own=(50, 1.1, 2)) == {13 + 7: 1}
    assert np.float32(1024.101) - np.float32(1016.601) < 7.5
    assert cells_around((1, 1024.101, 2), own=(50, 1016.601, 2)) == {13 + 6: 1}


def test_lateral_codes_and_their_windows_of_40_rows():
    rows = [(1, f, 0.0, 5.0 * f, 3 if f >= 100 else 2) for f in range(200)]
    rows += [(2, f, 0.0, 5.0 * f, 1 if f >= 100 else 2) for f in range(200)]
    found = prepare(rows).lateral
    assert [i for i, code in enumerate(found[:200]) if code == 3] == list(range(60, 140))
    assert [i for i, code in enumerate(found[200:]) if code == 2] == list(range(60, 140))
    assert set(found.tolist()) == {1, 2, 3}


def test_both_ways_within_the_windows_is_right_because_that_is_tested_first():
    rows = [(1, f, 0.0, 5.0 * f, 3 if 30 <= f < 60 else 2) for f in range(90)]
    assert prepare(rows).lateral[[45, 15, 75, 29]].tolist() == [3, 3, 2, 1]


def test_braking_is_less_than_four_fifths_of_the_speed_before():
    for later, code in ((4.0, 1), (3.99, 2)):
        rows = [(1, f, 0.0, round(5.0 * min(f, 40) + later * max(0, f - 40), 3), 2) for f in range(120)]
        assert prepare(rows).longitudinal[40] == code
    assert prepare(drive(1, range(60))).longitudinal[[0, 59]].tolist() == [1, 1]


@pytest.mark.parametrize(("slow_from", "code"), [(90, 2), (91, 1)])
def test_the_future_is_50_rows(slow_from, code):
    """4 of 5 ft a frame in the next 49 rows, and standing still in the 50th or in the 51st."""
    y = np.cumsum([0.0] + [5.0] * 40 + [4.0] * (slow_from - 41) + [0.0] * 60)
    assert prepare([(1, f, 0.0, y[f], 2) for f in range(len(y))]).longitudinal[40] == code


@pytest.mark.parametrize(("step", "code"), [(0.0, 1), (5.0, 1), (-0.01, 2)])
def test_after_standing_only_going_backwards_is_braking(step, code):
    """0 / 0 is NaN, 5 / 0 Inf, -0.01 / 0 -Inf."""
    rows = [(1, f, 0.0, round(50 + step * max(0, f - 40), 3), 2) for f in range(100)]
    assert prepare(rows).longitudinal[40] == code


def test_a_gap_stretches_windows_that_count_rows():
    """The lane changes 45 rows later: within 40 rows only where 10 of them are missing (frames 50 to 59)."""
    frames = [*range(50), *range(60, 150)]
    rows = [(1, f, 0.0, 5.0 * f, 2 if f < 70 else 3) for f in frames]
    assert prepare(rows).lateral[frames.index(25)] == 3
    assert prepare([(1, f, 0.0, 5.0 * f, 2 if f < 70 else 3) for f in range(150)]).lateral[25] == 1


def test_the_drop_rule():
    """32 frames: the 31st is frame 30, whose next frame is the last; 33 frames: one sample."""
    assert not prepare(drive(1, range(32))).kept.any()
    kept = prepare(drive(1, range(33)))
    assert np.flatnonzero(kept.kept).tolist() == [30]
    assert {reason: sum(counts) for reason, counts in kept.dropped.items()} == {
        "short_track": 0, "short_history": 30, "short_future": 2,
    }  # fmt: skip
    short = prepare(drive(1, range(30)))
    assert {reason: sum(counts) for reason, counts in short.dropped.items()} == {
        "short_track": 30, "short_history": 0, "short_future": 0,
    }  # fmt: skip


def test_frames_count_for_the_end_of_a_track_and_rows_for_its_beginning():
    """After frame 29 comes 90: the 31st row is frame 90. Before the last frame, 200, nothing is within one frame."""
    subset = prepare(drive(1, [*range(30), *range(90, 94), 200]))
    assert subset.entries.frame[subset.kept].tolist() == [90, 91, 92, 93]


def test_a_full_future_is_50_rows():
    subset = prepare(drive(1, range(100)), full_future=True)
    assert np.flatnonzero(subset.kept).tolist() == list(range(30, 50))
    assert sum(subset.dropped["no_full_future"]) == 98 - 50


@given(st.integers(1, 1 << 24))
@example(5)
@example(15)
@example(2235)
def test_parts_end_at_rounded_shares_of_the_highest_id(highest):
    last_train, last_val = ((share * highest + 5) // 10 for share in (7, 8))
    ids = {i for end in (last_train, last_val) for i in (end - 1, end, end + 1)} | {1, highest}
    ids = np.array(sorted(i for i in ids if 1 <= i <= highest), np.int32)
    if highest <= 30_000:  # beyond, single precision does not hold the tenths
        expected = [TRAIN if i <= last_train else VAL if i <= last_val else TEST for i in ids]
        assert assign_parts_by_id(ids).tolist() == expected
    assert assign_parts_by_id(ids)[-1] == (TEST if highest > 2 else TRAIN if highest == 1 else VAL)
    assert (np.diff(assign_parts_by_id(ids)) >= 0).all()


@given(st.lists(st.tuples(st.integers(0, 60_000_000), st.sampled_from([1000, 1_000_000])), min_size=1))
def test_feet_are_recovered_as_the_single_that_was_read(numbers):
    """The source stores `Local_Y * 0.3048`; the script reads the text of Local_Y: three decimals, or up to six."""
    feet = np.array([float(Fraction(number, unit)) for number, unit in numbers])
    assert np.array_equal(to_feet(feet * FOOT_M), feet.astype(np.float32))


def test_all_feet_of_three_decimals_that_a_section_has_are_recovered():
    feet = np.arange(0, 3_000_000, 2) / 1000
    assert np.array_equal(to_feet(feet * FOOT_M), feet.astype(np.float32))


def test_ids_that_the_lake_told_apart_are_one_track_again():
    """Vehicle 9 of the lake is the file's second vehicle 2: one id, and where both have a frame the first one's row."""
    rows = drive(2, range(40)) + drive(9, range(38, 80), lane=3, y=500) + drive(4, range(60), lane=1)
    subset = prepare(rows, vehicles={9: 2})
    assert np.unique(subset.entries.track_id).tolist() == [2, 4]
    assert subset.left_out == {"same_id_and_frame": 2}
    file_rows = drive(2, range(40)) + drive(9, range(38, 80), lane=3, y=500)[2:] + drive(4, range(60), lane=1)
    expected, _ = run_script({1: sorted((2 if v == 9 else v, *rest) for v, *rest in file_rows)})
    for code, part in enumerate(PARTS):
        assert np.array_equal(assemble(subset, code), np.array(expected[part][0], np.float32).reshape(-1, 47))


def test_nobody_is_called_zero():
    subset = prepare(drive(0, range(40)) + drive(1, range(40), lane=3))
    assert subset.left_out == {"id_zero": 40}
    assert assemble(subset, TRAIN)[:, 8:].max(initial=0) == 0


def test_what_single_precision_cannot_tell_apart_is_refused():
    with pytest.raises(TracklakeError, match=r"track_id 16777217.*up to 16,777,216"):
        prepare(drive((1 << 24) + 1, range(3)))
    with pytest.raises(TracklakeError, match="frame 2147483647"):
        prepare(drive(1, [2**31 - 2, 2**31 - 1]))


def test_25_hz_is_interpolated_to_ticks_counted_from_one():
    """Tick k lies at frame 1 + 2.5 k: 1, 3.5, 6 ...; y runs 1 m a frame."""
    tracks = pl.DataFrame(
        {"vehicle_id": 3, "frame": np.arange(1, 101), "x_m": np.arange(1.0, 101.0), "y_m": 2.0, "lane": 1}
    ).cast(DTYPES)  # fmt: skip
    recorded = CspRecording(7, 1, 25.0, None)
    clock = put_on_csp_clock(tracks, recorded)
    subset = prepare_original_subset(clock, pl.DataFrame({"vehicle_id": [3], "source_vehicle_id": [3]}), recorded)
    assert subset.entries.frame.tolist() == list(range(1, 41))
    assert np.array_equal(subset.entries.y_ft, (np.arange(1.0, 101.0, 2.5) / 0.3048).astype(np.float32))
    assert np.flatnonzero(subset.kept).tolist() == list(range(30, 38))
    assert assemble(subset, TEST)[:, 0].tolist() == [7.0] * 8


def test_data_set_ids():
    mixed = [("highd", "02-upper"), ("ngsim", "i-80-1600"), ("ngsim", "us-101-x"), ("highd", "01-lower")]
    assert number_datasets(mixed) == {
        ("ngsim", "i-80-1600"): 4, ("ngsim", "us-101-x"): 7, ("highd", "01-lower"): 8, ("highd", "02-upper"): 9,
    }  # fmt: skip
    others = number_datasets([("highd", "01-upper"), ("ngsim", "elsewhere")])
    assert others == {("ngsim", "elsewhere"): 1, ("highd", "01-upper"): 2}
    six = ("us-101-0750", "us-101-0805", "us-101-0820", "i-80-1600", "i-80-1700", "i-80-1715")
    assert list(number_datasets([("ngsim", name) for name in six]).values()) == [1, 2, 3, 4, 5, 6]
