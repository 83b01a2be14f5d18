"""Mirroring and shifting, by hand and by a loop."""

from dataclasses import fields

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import UNDIVIDED, random_tables
from tensor_tables import CLOCK, split_row, write

from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.augmentation import draw_mirrored, mirror, mirror_scenes, shift, shift_scenes
from tracklake.training.data.tensor_folder import TensorFolder

MARKINGS = [0.0, 4.0, 8.0, 11.0]
"""Three lanes, centres at 2, 6 and 9.5 m; the middle of the carriageway is at 5.5 m."""


@pytest.fixture
def folder(tmp_path):
    """Vehicle 1 drives right of its lane's centre and changes right; 2 is ahead, listed right, and 3 behind, left."""
    rows = []
    for vehicle_id, x0, y_m, lane in ((1, 0.0, 3.0, 1), (2, 9.0, 6.0, 2), (3, -9.0, 9.0, 3)):
        rows += [(vehicle_id, t, 1 + 5 * t, x0 + 10.0 * t, y_m + 0.5 * t, lane, 20.0, vehicle_id) for t in range(6)]
    clock = pl.DataFrame(rows, schema=CLOCK, orient="row")
    sample = ("tiny", "highd", "a", 1, 2, None, 1, "right", "brake", None)
    samples = pl.DataFrame([sample], schema=SAMPLES.dtypes, orient="row")
    around = [("tiny", "highd", "a", 1, 2, cell, other, 0.0) for cell, other in ((13 * 0 + 4, 3), (13 * 2 + 8, 2))]
    neighbors = pl.DataFrame(around, schema=NEIGHBORS.dtypes, orient="row")
    tables = [("a", clock, samples, neighbors)]
    return TensorFolder.open(write(tmp_path, tables, split_row("a", "train"), markings=MARKINGS))


YES = np.array([True])


def test_a_mirrored_sample_by_hand(folder):
    # At tick 2 vehicle 1 stands at (20, 4), 2 at (29, 7), 3 at (11, 10).
    plain, mirrored = folder.gather([0]), mirror(folder, folder.gather([0]), YES)
    assert plain.history[0].tolist() == [[-20, -1], [-10, -0.5], [0, 0]]
    assert mirrored.history[0].tolist() == [[-20, 1], [-10, 0.5], [0, 0]]
    assert mirrored.future[0].tolist() == [[10, -0.5], [20, -1], [30, -1.5], [30, -1.5]]
    assert mirrored.origin.tolist() == [[20, 7]]
    assert (plain.lateral.tolist(), mirrored.lateral.tolist()) == ([2], [1])
    assert mirrored.longitudinal.tolist() == [1]
    # Who was in the left column is in the right one and now comes last.
    assert plain.neighbor_cell.tolist() == [4, 34]
    assert mirrored.neighbor_cell.tolist() == [8, 30]
    assert mirrored.neighbor_history[:, -1].tolist() == [[9, -3], [-9, -6]]


def test_absolute_positions_are_measured_from_the_other_edge(folder):
    mirrored = mirror(folder, folder.gather([0], absolute=True), YES)
    assert mirrored.history[0].tolist() == [[0, 8], [10, 7.5], [20, 7]]
    assert mirrored.origin.tolist() == [[20, 7]]
    assert mirrored.neighbor_history[:, -1].tolist() == [[29, 4], [11, 1]]


def test_a_mirrored_scene_by_hand(folder):
    scenes = folder.gather_scenes([0])
    mirrored = mirror_scenes(folder, scenes, YES)
    assert mirrored.vehicle_id.tolist() == scenes.vehicle_id.tolist() == [1, 2, 3]
    assert (scenes.lane.tolist(), mirrored.lane.tolist()) == ([1, 2, 3], [3, 2, 1])
    assert mirrored.has_left.tolist() == [True, True, False]
    assert mirrored.has_right.tolist() == [False, True, True]
    assert scenes.lane_offset_m.tolist() == [2, 1, 0.5]
    assert mirrored.lane_offset_m.tolist() == [-2, -1, -0.5]
    assert mirrored.lateral.tolist() == [1, -1, -1]
    assert mirrored.origin[:, 1].tolist() == [7, 4, 1]
    assert mirrored.history[0, 0].tolist() == [-20, 1]


def test_a_shift_moves_absolute_positions_along_the_road_and_no_others(folder):
    by = np.array([7.5], dtype=np.float32)
    relative, plain = shift(folder.gather([0]), by), folder.gather([0])
    assert relative.history.tolist() == plain.history.tolist()
    assert relative.neighbor_history.tolist() == plain.neighbor_history.tolist()
    assert relative.origin.tolist() == [[27.5, 4]]
    absolute = shift(folder.gather([0], absolute=True), by)
    assert absolute.history[0].tolist() == [[7.5, 3], [17.5, 3.5], [27.5, 4]]
    assert absolute.future[0, 0].tolist() == [37.5, 4.5]
    assert absolute.neighbor_history[:, -1].tolist() == [[18.5, 10], [36.5, 7]]
    assert absolute.origin.tolist() == [[27.5, 4]]


def test_a_shifted_scene_by_hand(folder):
    # At tick 2 vehicle 1 stands at (20, 4), 2 at (29, 7), 3 at (11, 10).
    by = np.array([7.5], dtype=np.float32)
    relative, plain = shift_scenes(folder.gather_scenes([0]), by), folder.gather_scenes([0])
    assert relative.origin.tolist() == [[27.5, 4], [36.5, 7], [18.5, 10]]
    assert relative.history.tolist() == plain.history.tolist()
    assert relative.future.tolist() == plain.future.tolist()
    absolute = shift_scenes(folder.gather_scenes([0], absolute=True), by)
    assert absolute.origin.tolist() == relative.origin.tolist()
    assert absolute.history[0].tolist() == [[7.5, 3], [17.5, 3.5], [27.5, 4]]
    assert absolute.future[:, 0].tolist() == [[37.5, 4.5], [46.5, 7.5], [28.5, 10.5]]
    assert absolute.lane_offset_m.tolist() == plain.lane_offset_m.tolist()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), absolute=st.booleans())
def test_each_scene_is_shifted_by_its_own_and_back_again(tmp_path_factory, seed, absolute):
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), random_tables(seed), UNDIVIDED))
    scenes = folder.gather_scenes(np.arange(len(folder.scene_part)), absolute=absolute)
    by = np.arange(len(scenes), dtype=np.float32)
    moved = shift_scenes(scenes, by)
    for vehicle, scene in enumerate(scenes.vehicle_scene.tolist()):
        assert moved.origin[vehicle].tolist() == [
            scenes.origin[vehicle, 0] + np.float32(scene),
            scenes.origin[vehicle, 1],
        ]
    back = shift_scenes(moved, -by)
    for own in fields(scenes):
        np.testing.assert_allclose(getattr(back, own.name), getattr(scenes, own.name), atol=1e-4, err_msg=own.name)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), absolute=st.booleans())
def test_only_the_chosen_are_mirrored_and_twice_is_not_at_all(tmp_path_factory, seed, absolute):
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), random_tables(seed), UNDIVIDED))
    batch = folder.gather(np.arange(len(folder.sample_row)), absolute=absolute)
    chosen = draw_mirrored(len(batch), np.random.default_rng(seed))
    once = mirror(folder, batch, chosen)
    twice = mirror(folder, once, chosen)
    for own in fields(batch):
        if own.name != "absolute":
            wanted, got = getattr(batch, own.name), getattr(twice, own.name)
            assert got.dtype == wanted.dtype, own.name
            np.testing.assert_allclose(got, wanted, atol=2e-6, err_msg=own.name)
    for position in range(len(batch)):
        mine = batch.neighbor_sample == position
        cells = [
            13 * (2 - cell // 13) + cell % 13 if chosen[position] else cell
            for cell in batch.neighbor_cell[mine].tolist()
        ]
        assert once.neighbor_cell[mine].tolist() == sorted(cells)
        if not chosen[position]:
            np.testing.assert_array_equal(once.history[position], batch.history[position])


def test_half_of_many_are_drawn():
    drawn = draw_mirrored(10_000, np.random.default_rng(0))
    assert 4_700 < drawn.sum() < 5_300
    assert not draw_mirrored(10, np.random.default_rng(0), share=0.0).any()
