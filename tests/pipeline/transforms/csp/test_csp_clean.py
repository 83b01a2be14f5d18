"""`--clean`: late starts, gaps, shared cells and splits, and otherwise the original's arithmetic."""

import numpy as np
import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st
from test_csp_original import DTYPES, assemble, drive, prepare, recordings

from tracklake.pipeline.transforms.csp.parts import REASONS, TEST, TRAIN, VAL
from tracklake.pipeline.transforms.csp.subset import (
    CleanContext,
    CspRecording,
    prepare_clean_subset,
    put_on_csp_clock,
    stack_tracks,
)
from tracklake.schemas import MISSING_STARTS, SPLITS
from tracklake.schemas.columns import FOOT_M

ALL = 2**31 - 1


def make_blocks(*rows):
    """(part, first_frame, last_frame) or with the first and the last vehicle."""
    named = [
        {"split": "s", "dataset": "ngsim", "subset": "a", "block": number, "part": part, "first_frame": first,
         "last_frame": last, "first_vehicle_id": vehicles[0] if vehicles else None,
         "last_vehicle_id": vehicles[1] if vehicles else None}
        for number, (part, first, last, *vehicles) in enumerate(rows)
    ]  # fmt: skip
    return pl.DataFrame(named, schema=SPLITS.dtypes)


def clean(rows, *, blocks=(("train", 0, ALL),), early=(), missing=(), last_lane=None, full_future=False):
    """Rows of the script (feet) through --clean; `missing` are rows of missing_starts."""
    metres = [(v, f, float(y) * FOOT_M, float(x) * FOOT_M, lane) for v, f, x, y, lane in rows]
    tracks = pl.DataFrame(metres, schema=DTYPES, orient="row").sort("vehicle_id", "frame")
    starts = tracks.select(pl.col("vehicle_id").unique().sort()).with_columns(early=pl.col("vehicle_id").is_in(early))
    recorded = CspRecording(1, tracks["frame"].min(), 10.0, last_lane)
    context = CleanContext(make_blocks(*blocks), starts, pl.DataFrame(list(missing), schema=MISSING_STARTS.dtypes))
    return prepare_clean_subset(put_on_csp_clock(tracks, recorded), context, recorded, full_future=full_future)


def dropped(subset):
    return {reason: sum(counts) for reason, counts in subset.dropped.items() if sum(counts)}


def tracks_of(subset, part=TRAIN):
    """{id: frames}"""
    ids, lengths, values = stack_tracks(subset, part)
    starts = np.cumsum(lengths) - lengths
    return {
        vehicle: values[start : start + length, 0].tolist()
        for vehicle, start, length in zip(ids.tolist(), starts, lengths, strict=True)
    }


def test_a_later_run_gets_an_id_that_no_vehicle_had():
    """Vehicle 5 has a gap; the highest id, 7, is of a vehicle that stands outside the split."""
    rows = [(5, frame, 6.0, 10.0 * frame, 1) for frame in (*range(1, 41), *range(61, 101))]
    rows += [(7, frame, 6.0, 10.0 * (frame - 200), 1) for frame in range(201, 241)]
    found = clean(rows, blocks=(("train", 1, 150),))
    assert tracks_of(found) == {5: list(range(1, 41)), 8: list(range(61, 101))}


@given(recordings(), st.sampled_from([None, 6]), st.booleans())
@settings(max_examples=15, deadline=None)
def test_whole_tracks_keep_the_originals_rows_and_labels(rows, last_lane, full_future):
    """Samples of vehicles without gaps, in one part, with all vehicles around them present."""
    frames = {vehicle: [row[1] for row in rows if row[0] == vehicle] for vehicle, *_ in rows}
    whole = [row for row in rows if max(frames[row[0]]) - min(frames[row[0]]) + 1 == len(frames[row[0]])]
    if not whole:
        return
    original = prepare(whole, last_lane=last_lane, full_future=full_future)
    found = clean(whole, last_lane=last_lane, full_future=full_future)
    expected = np.concatenate([assemble(original, part) for part in (TRAIN, VAL, TEST)])
    assert np.array_equal(assemble(found, TRAIN)[:, :8], expected[:, :8])
    assert found.left_out == {}
    # No neighbor is overwritten: what stands in an original grid stands in this one.
    for mine, theirs in zip(assemble(found, TRAIN)[:, 8:], expected[:, 8:], strict=True):
        assert set(theirs.tolist()) <= set(mine.tolist()) or len(set(mine.tolist())) >= 13


@given(recordings())
@settings(max_examples=10, deadline=None)
def test_every_entry_is_a_sample_or_counted(rows):
    found = clean(rows, blocks=(("train", 0, 25), ("val", 40, 60), ("eval", 70, 75, 1, 20), ("eval", 76, 90)))
    counted = sum(found.left_out.values()) + sum(dropped(found).values())
    assert int(found.kept.sum()) + counted == len(rows)
    assert set(found.left_out) | set(found.dropped) <= set(REASONS)
    for part in (TRAIN, VAL, TEST):
        for frames in tracks_of(found, part).values():
            assert frames == list(range(int(frames[0]), int(frames[0]) + len(frames)))


def test_a_gap_begins_a_track_of_its_own():
    """Vehicle 5 has frames 0 to 39 and 60 to 99; the unused id is 1 above the highest."""
    found = clean(drive(5, [*range(40), *range(60, 100)]) + drive(7, range(100), lane=3, y=5))
    assert tracks_of(found) == {5: list(range(40)), 7: list(range(100)), 8: list(range(60, 100))}
    samples = assemble(found, TRAIN)
    assert samples[samples[:, 1] == 5][:, 2].tolist() == list(range(30, 38))
    assert samples[samples[:, 1] == 8][:, 2].tolist() == list(range(90, 98))
    beside = {int(row[2]): sorted({int(cell) for cell in row[8:] if cell}) for row in samples if row[1] == 7}
    assert beside[39] == [5]
    assert beside[45] == []
    assert beside[60] == []  # 300 ft behind by then
    assert {vehicle for vehicles in beside.values() for vehicle in vehicles} == {5}


def test_early_vehicles_are_neighbors_and_no_samples():
    found = clean(drive(1, range(40)) + drive(2, range(40), lane=3), early=(2,))
    assert dropped(found) == {"short_history": 60, "short_future": 4, "early_vehicle": 8}
    samples = assemble(found, TRAIN)
    assert set(samples[:, 1]) == {1}
    assert (samples[:, 8 + 26 + 6] == 2).all()


def test_an_early_vehicle_stays_so_after_a_gap():
    found = clean(drive(2, [*range(40), *range(60, 100)]), early=(2,))
    assert dropped(found) == {"short_history": 60, "short_future": 4, "early_vehicle": 16}


def test_entries_around_which_a_late_start_is_missing_are_no_samples():
    """Vehicle 9 is missing in frames 32 to 34, at 60 to 70 m of its lane, beside vehicle 1 (5 ft a frame, at 48 m)."""
    missing = {
        "dataset": "ngsim", "subset": "a", "vehicle_id": 9, "lane": 3, "cutoff_m": 60.0, "start_x_m": 70.0,
        "start_frame": 35, "start_speed_mps": 1.0, "method": "mean_speed", "references": 0, "frames_estimated": 3.0,
        "frames_sigma": 0.0, "first_missing_frame": 32,
    }  # fmt: skip
    rows = drive(1, range(60)) + drive(2, range(60), lane=5) + drive(9, range(35, 60), lane=3, y=230)
    found = clean(rows, missing=[missing])
    samples = assemble(found, TRAIN)
    assert samples[samples[:, 1] == 1][:, 2].tolist() == [30, 31, *range(35, 58)]
    assert samples[samples[:, 1] == 2][:, 2].tolist() == list(range(30, 58))
    assert dropped(found)["would_be_neighbor"] == 3


def test_of_two_in_a_cell_the_nearer_keeps_it_and_the_other_moves():
    rows = drive(50, range(33), y=1000, step=0) + drive(3, range(33), lane=3, y=1010, step=0)
    found = clean(rows + drive(9, range(33), lane=3, y=1012, step=0))
    (grid,) = assemble(found, TRAIN)[assemble(found, TRAIN)[:, 1] == 50][:, 8:]
    assert {cell: vehicle for cell, vehicle in enumerate(grid) if vehicle} == {26 + 7: 3, 26 + 8: 9}
    grid = found.open_grid()
    assert (grid.collisions, grid.crowded_out) == (1, 0)


def test_ramps_are_merged_as_in_the_original():
    rows = drive(1, range(33), lane=5) + drive(2, range(33), lane=7, y=10) + drive(3, range(33), lane=8, y=30)
    samples = assemble(clean(rows, last_lane=6), TRAIN)
    assert samples[:, 5].tolist() == [5, 6, 6]
    assert {cell: int(v) for cell, v in enumerate(samples[0, 8:]) if v} == {26 + 7: 2, 26 + 8: 3}


def test_parts_are_those_of_the_split():
    found = clean(drive(1, range(40)), blocks=[("eval", 0, ALL)])
    assert (assemble(found, TRAIN).size, len(assemble(found, TEST))) == (0, 8)
    assert tracks_of(found, TRAIN) == {}
    assert tracks_of(found, TEST) == {1: list(range(40))}


def test_between_blocks_nothing_is_seen():
    """Frames 0 to 49 train, 60 to 119 evaluate; vehicle 3 is there in both, 4 before, 5 behind."""
    rows = drive(3, range(120)) + drive(4, range(55), lane=3) + drive(5, range(60, 120), lane=1, y=300)
    found = clean(rows, blocks=[("train", 0, 49), ("eval", 60, 119)])
    assert tracks_of(found, TRAIN) == {3: list(range(50)), 4: list(range(50))}
    assert tracks_of(found, TEST) == {5: list(range(60, 120))}
    assert found.left_out == {"outside_split": 10 + 5, "in_two_parts": 60}
    assert not assemble(found, TEST)[:, 8:].any()


def test_a_vehicle_in_two_blocks_of_a_part_is_two_tracks():
    found = clean(drive(3, range(120)), blocks=[("train", 0, 59), ("train", 60, 119)])
    assert tracks_of(found) == {3: list(range(60)), 4: list(range(60, 120))}


def test_blocks_of_vehicles_do_not_see_each_other():
    rows = drive(1, range(40)) + drive(2, range(40), lane=3)
    found = clean(rows, blocks=[("train", 0, ALL, 1, 1), ("val", 0, ALL, 2, 9)])
    assert [assemble(found, part)[:, 1].tolist() for part in (TRAIN, VAL)] == [[1] * 8, [2] * 8]
    assert not assemble(found, TRAIN)[:, 8:].any()


def test_neighbors_stand_with_their_own_origins_where_parts_alternate():
    """Vehicles 1 and 4 train, 2 and 3 are in between; each pair is side by side."""
    rows = [row for v, lane in ((1, 2), (2, 2), (3, 3), (4, 3)) for row in drive(v, range(40), lane=lane)]
    found = clean(rows, blocks=[("train", 0, ALL, 1, 1), ("val", 0, ALL, 2, 3), ("train", 0, ALL, 4, 4)])
    for part, pair in ((TRAIN, {1: 4, 4: 1}), (VAL, {2: 3, 3: 2})):
        samples = assemble(found, part)
        assert samples[:, 1].tolist() == [vehicle for vehicle in pair for _ in range(8)]
        assert samples[:, 8:].sum(axis=1).tolist() == [pair[vehicle] for vehicle in samples[:, 1].tolist()]


def test_a_skipped_source_frame_between_two_ticks_begins_a_track():
    """Frame 2 is missing: ticks 0 (frame 1) and 1 (between frames 3 and 4) are there."""
    frames = [1, *range(3, 101)]
    tracks = pl.DataFrame({"vehicle_id": 1, "frame": frames, "x_m": np.arange(99.0), "y_m": 2.0, "lane": 1}).cast(
        DTYPES
    )
    recorded = CspRecording(1, 1, 25.0, None)
    context = CleanContext(
        make_blocks(("train", 0, ALL)), pl.DataFrame({"vehicle_id": [1], "early": [False]}), MISSING_STARTS.empty()
    )
    found = prepare_clean_subset(put_on_csp_clock(tracks, recorded), context, recorded)
    assert tracks_of(found) == {1: [1], 2: list(range(2, 41))}


def test_ticks_of_another_clock_lie_in_blocks_by_their_frames():
    """25 Hz from frame 1: ticks 0, 1, 2 lie at frames 1, 3.5, 6."""
    tracks = pl.DataFrame(
        {"vehicle_id": 1, "frame": np.arange(1, 101), "x_m": np.arange(100.0), "y_m": 2.0, "lane": 1}
    ).cast(DTYPES)
    recorded = CspRecording(1, 1, 25.0, None)
    starts = pl.DataFrame({"vehicle_id": [1], "early": [False]})
    context = CleanContext(make_blocks(("train", 1, 51)), starts, MISSING_STARTS.empty())
    found = prepare_clean_subset(put_on_csp_clock(tracks, recorded), context, recorded)
    assert tracks_of(found) == {1: list(range(1, 22))}  # frame 51 is tick 20, the 21st
    assert found.left_out == {"outside_split": 40 - 21}
