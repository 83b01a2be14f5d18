"""Slices: every frame is owned once, and what is read around it is complete and within the bound."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tracklake.pipeline.transforms.slices import cut_frames, list_windows

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
