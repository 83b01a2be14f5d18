"""Slices: every frame is owned once, and what is read around it is complete and within the bound."""

import numpy as np
import polars as pl
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tracklake.pipeline.transforms.slices import Slice, cut_frames, list_windows

COUNTS = st.dictionaries(st.integers(0, 60), st.integers(1, 9), min_size=1)


@given(COUNTS, st.integers(1, 120), st.integers(0, 7))
def test_every_frame_is_owned_once_and_no_slice_is_larger_than_it_may_be(rows, most_rows, context):
    frames = np.array(sorted(rows))
    slices = list(cut_frames(frames, np.array([rows[frame] for frame in frames]), most_rows, context))
    owned = [frame for each in slices for frame in range(each.first_frame, each.end_frame)]
    assert owned == list(range(frames[0], frames[-1] + 1))
    for each in slices:
        read = range(each.first_frame - context, each.end_frame + context)
        is_least = each.end_frame - each.first_frame <= max(context, 1)
        assert sum(rows.get(frame, 0) for frame in read) <= most_rows or is_least


@given(COUNTS, st.integers(1, 120), st.integers(0, 7))
def test_a_slice_could_not_be_longer(rows, most_rows, context):
    frames = np.array(sorted(rows))
    for each in cut_frames(frames, np.array([rows[frame] for frame in frames]), most_rows, context):
        read = range(each.first_frame - context, each.end_frame + context + 1)
        assert sum(rows.get(frame, 0) for frame in read) > most_rows or each.end_frame == frames[-1] + 1


def test_cuts_by_hand():
    """Frames 0 to 9 with one row each, at most six rows, two frames of context."""
    made = cut_frames(np.arange(10), np.ones(10, np.int64), 6, 2)
    # 0 to 3 read 0 to 5; then two frames read six: 2 to 7, 4 to 9; the rest is six frames, too: 4 to 9.
    assert [(each.first_frame, each.end_frame) for each in made] == [(0, 4), (4, 6), (6, 10)]


def test_a_bound_beyond_all_numbers_is_one_slice():
    (made,) = cut_frames(np.arange(10), np.ones(10, np.int64), 10**30, 2)
    assert (made.first_frame, made.end_frame) == (0, 10)


def test_names_in_order_are_slices_in_order_of_time():
    names = [each.name for each in cut_frames(np.arange(0, 3000, 40), np.ones(75, np.int64), 1, 0)]
    assert names == sorted(names)


@pytest.mark.parametrize("stride", [5.0, 2.5, 25 / 3, 29.97 / 5, 0.4])
def test_ticks_of_a_slice_are_those_whose_frames_it_owns(stride):
    ticks = pl.DataFrame({"tick": range(-20, 300)}, schema={"tick": pl.Int32})
    for first, end in ((20, 30), (30, 31), (31, 80)):
        own = Slice(first, end, 3).is_own_tick(pl.col("tick"), first_frame=10, stride=stride)
        expected = [tick for tick in range(-20, 300) if first <= 10 + tick * stride < end]
        assert ticks.filter(own)["tick"].to_list() == expected


def test_a_file_with_ticks_of_other_times_is_not_read(tmp_path):
    for name, first in (("a", 0), ("b", 100)):
        rows = pl.DataFrame({"tick": range(first, first + 100)}, schema={"tick": pl.Int32})
        rows.write_parquet(tmp_path / f"{name}.parquet")
    content = bytearray((tmp_path / "b.parquet").read_bytes())
    footer = int.from_bytes(content[-8:-4], "little") + 8
    content[4:-footer] = bytes(len(content) - 4 - footer)
    (tmp_path / "b.parquet").write_bytes(content)
    own = Slice(0, 50, 0).is_own_tick(pl.col("tick"), first_frame=0, stride=2.5)
    assert pl.scan_parquet(tmp_path / "*.parquet").filter(own).collect()["tick"].to_list() == list(range(20))
    with pytest.raises(pl.exceptions.PolarsError):
        pl.read_parquet(tmp_path / "b.parquet")


@example([(0, 1), (0, 1), (2, 1), (2, 1)], 1)  # nothing in frame 1
@given(st.lists(st.tuples(st.integers(-5, 40), st.integers(1, 12)), max_size=8), st.integers(1, 30))
def test_windows_have_every_frame_of_every_run_once_in_order_of_time(runs, most_rows):
    first, size = np.array(runs, np.int64).reshape(-1, 2).T
    seen, last = [], -6
    for chosen, before, inside in list_windows(first, size, most_rows):
        rows = [(run, first[run] + b + k) for run, b, n in zip(chosen, before, inside, strict=True) for k in range(n)]
        frames = {frame for _, frame in rows}
        assert min(frames) > last
        assert len(rows) <= most_rows or len(frames) == 1
        last = max(frames)
        seen += rows
    assert sorted(seen) == [(run, f) for run in range(len(runs)) for f in range(first[run], first[run] + size[run])]
