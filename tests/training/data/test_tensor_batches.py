"""Batches equal those of a literal per-sample loop over the tables, value for value."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, F, H, loop_over_samples, random_tables
from tensor_tables import CLOCK, drive, sample_everything, split_row, write
from tiny_network import write_tiny

from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import UsageError
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.tensor_folder import TensorFolder


def assert_batch_equals(batch, expected):
    pairs = [(position, *pair) for position, sample in enumerate(expected) for pair in sample.around]

    def array(values, dtype, *shape):
        return np.array(values, dtype=dtype).reshape(-1, *shape)

    np.testing.assert_array_equal(batch.history, array([s.history for s in expected], np.float32, H, 2))
    np.testing.assert_array_equal(batch.future, array([s.future for s in expected], np.float32, F, 2))
    np.testing.assert_array_equal(batch.future_mask, array([s.future_mask for s in expected], bool, F))
    np.testing.assert_array_equal(batch.origin, array([s.origin for s in expected], np.float32, 2))
    np.testing.assert_array_equal(batch.lateral, [s.lateral for s in expected])
    np.testing.assert_array_equal(batch.longitudinal, [s.longitudinal for s in expected])
    np.testing.assert_array_equal(batch.neighbor_sample, [pair[0] for pair in pairs])
    np.testing.assert_array_equal(batch.neighbor_cell, [pair[1] for pair in pairs])
    np.testing.assert_array_equal(batch.neighbor_history, array([pair[2] for pair in pairs], np.float32, H, 2))
    np.testing.assert_array_equal(batch.neighbor_mask, array([pair[3] for pair in pairs], bool, H))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    batch_size=st.sampled_from([1, 3, 100]),
    shuffle=st.booleans(),
)
def test_batches_equal_a_literal_loop(tmp_path_factory, seed, splits, batch_size, shuffle):
    tables = random_tables(seed)
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, splits))
    expected = loop_over_samples(tables, splits)
    assert len(folder.sample_row) == len(expected)
    assert [PARTS[part] for part in folder.sample_part] == [sample.part for sample in expected]
    for part in PARTS:
        of_part = [position for position, sample in enumerate(expected) if sample.part == part]
        seen = []
        for batch in folder.batches(part, batch_size, shuffle_seed=seed if shuffle else None):
            assert 1 <= len(batch) <= batch_size
            seen += batch.sample.tolist()
            assert_batch_equals(batch, [expected[number] for number in batch.sample])
        assert sorted(seen) == of_part
        if not shuffle:
            assert seen == of_part
        assert folder.subsets_of(part) == {f"highd/{expected[number].subset}" for number in of_part}


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), splits=st.sampled_from([UNDIVIDED, BY_VEHICLE]))
def test_absolute_positions_are_those_of_the_tables(tmp_path_factory, seed, splits):
    tables = random_tables(seed)
    folder = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, splits))
    expected = loop_over_samples(tables, splits, absolute=True)
    batch = folder.gather(np.arange(len(expected)), absolute=True)
    assert batch.absolute
    assert_batch_equals(batch, expected)
    np.testing.assert_array_equal(batch.history[:, -1], batch.origin)


def one_vehicle(ticks, *, vehicle_id=7, x0=0.0):
    rows = [(vehicle_id, tick, 1 + 5 * tick, x0 + 10.0 * tick, 4.0, 1, 20.0, vehicle_id) for tick in ticks]
    return pl.DataFrame(rows, schema=CLOCK, orient="row")


def sample_of(*origins):
    rows = [("tiny", "highd", "a", vehicle, tick, None, 1, "left", "brake", None) for vehicle, tick in origins]
    return pl.DataFrame(rows, schema=SAMPLES.dtypes, orient="row")


def neighbor_of(*pairs):
    rows = [("tiny", "highd", "a", *pair, 0.0) for pair in pairs]
    return pl.DataFrame(rows, schema=NEIGHBORS.dtypes, orient="row")


def open_one(folder, clock, samples, neighbors):
    return TensorFolder.open(write(folder, [("a", clock, samples, neighbors)], split_row("a", "eval")))


def test_one_sample_without_neighbors_and_with_a_masked_future_by_hand(tmp_path):
    # Five positions, fewer than a history and a future together: 0, 10, 20 m, then 30 and 40 of four wanted.
    folder = open_one(tmp_path, one_vehicle(range(5)), sample_of((7, 2)), neighbor_of())
    (batch,) = folder.batches("eval", 8)
    assert batch.history.tolist() == [[[-20, 0], [-10, 0], [0, 0]]]
    assert batch.future.tolist() == [[[10, 0], [20, 0], [20, 0], [20, 0]]]
    assert batch.future_mask.tolist() == [[True, True, False, False]]
    assert batch.origin.tolist() == [[20, 4]]
    assert (batch.neighbor_history.shape, batch.neighbor_mask.shape) == ((0, H, 2), (0, H))
    assert (batch.lateral.tolist(), batch.longitudinal.tolist()) == ([1], [1])
    assert list(folder.batches("train", 8)) == [], "a part without samples"


def test_neighbors_that_came_late_by_hand(tmp_path):
    # Vehicle 9 appears one tick before the sample's, vehicle 8 at it.
    clock = pl.concat(
        [one_vehicle(range(5)), one_vehicle([2, 3], vehicle_id=8, x0=5), one_vehicle([1, 2], vehicle_id=9)]
    )
    around = neighbor_of((7, 2, 30, 8), (7, 2, 4, 9))
    batch = open_one(tmp_path, clock, sample_of((7, 2)), around).gather([0])
    assert batch.neighbor_cell.tolist() == [4, 30], "by cell, not as they were listed"
    assert batch.neighbor_mask.tolist() == [[False, True, True], [False, False, True]]
    assert batch.neighbor_history[..., 0].tolist() == [[-10, -10, 0], [5, 5, 5]]


def test_fewer_rows_than_a_window(tmp_path):
    folder = open_one(tmp_path, one_vehicle(range(4)), sample_of((7, 2)), neighbor_of())
    assert len(folder.lane) == F  # the future's window fits exactly once, and begins behind the sample
    assert folder.gather([0]).future[..., 0].tolist() == [[10, 10, 10, 10]]
    shorter = open_one(tmp_path / "b", one_vehicle(range(4)).head(3), sample_of((7, 2)).clear(), neighbor_of())
    assert len(list(shorter.batches("eval", 3))) == 0
    assert shorter.gather_scenes([]).history.shape == (0, H, 2)


def test_the_last_batch_is_what_is_left(tmp_path):
    clock = one_vehicle(range(12))
    folder = open_one(tmp_path, clock, sample_of(*((7, tick) for tick in range(2, 11))), neighbor_of())
    assert [len(batch) for batch in folder.batches("eval", 4)] == [4, 4, 1]
    assert [len(batch) for batch in folder.batches("eval", 4, shuffle_seed=1)] == [4, 4, 1]


def test_batches_of_no_samples_are_refused(tmp_path):
    folder = open_one(tmp_path, one_vehicle(range(5)), sample_of((7, 2)), neighbor_of())
    with pytest.raises(ValueError, match="at least 1, got 0"):
        next(folder.batches("eval", 0))


def test_numbers_that_are_no_sample_are_refused(tmp_path):
    folder = open_one(tmp_path, one_vehicle(range(5)), sample_of((7, 2)), neighbor_of())
    for wrong in ([-1], [1]):
        with pytest.raises(IndexError, match="samples are numbered 0 to 0, got"):
            folder.gather(wrong)


def test_a_shuffle_is_fixed_by_its_seed(tmp_path):
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=3, ticks=20)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    folder = TensorFolder.open(write(tmp_path, tables, split_row("a", "train")))
    orders = [
        np.concatenate([batch.sample for batch in folder.batches("train", 4, shuffle_seed=seed)]).tolist()
        for seed in (1, 1, 2)
    ]
    assert orders[0] == orders[1]
    assert orders[0] != orders[2]


def test_no_samples_still_open_and_gather_nothing(tmp_path):
    folder = TensorFolder.open(write(tmp_path, [], split_row("a", "train").clear()))
    assert list(folder.batches("train", 8)) == []
    batch = folder.gather([])
    assert (batch.history.shape, batch.future.shape, batch.neighbor_history.shape) == ((0, H, 2), (0, F, 2), (0, H, 2))
    assert folder.neighbor_offset.tolist() == [0]


def test_unknown_part(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(1), UNDIVIDED))
    with pytest.raises(UsageError, match="unknown part `test`: expected one of train, val, eval"):
        folder.samples_of("test")


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), storage=st.sampled_from(["int16-decimetres", "int16-centimetres"]))
def test_int16_batches_differ_by_the_rounding_and_no_more(tmp_path_factory, seed, storage):
    tables = random_tables(seed)
    exact = TensorFolder.open(write(tmp_path_factory.mktemp("exact"), tables, IN_TIME))
    small = TensorFolder.open(write(tmp_path_factory.mktemp("small"), tables, IN_TIME, storage=storage))
    assert small.position_m.dtype == np.int16
    step = np.array([0.1 if storage == "int16-decimetres" else 0.01, 0.001])
    everything = np.arange(len(exact.sample_row))
    for absolute in (False, True):
        wanted, got = exact.gather(everything, absolute=absolute), small.gather(everything, absolute=absolute)
        most = step * (0.5 if absolute else 1.0) + 1e-4  # a difference of two rounded positions errs twice
        for name in ("history", "future", "neighbor_history"):
            assert (np.abs(getattr(got, name) - getattr(wanted, name)) <= most).all(), name
            if not absolute:  # whole steps, exactly: nothing is left of where the centre lies
                steps = getattr(got, name) / step
                np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)
        assert (np.abs(got.origin - wanted.origin) <= step / 2 + 1e-4).all()
        np.testing.assert_array_equal(got.future_mask, wanted.future_mask)
        np.testing.assert_array_equal(got.neighbor_mask, wanted.neighbor_mask)
    errors = small.index["max_error_m"]
    assert all(0 <= error <= most for error, most in zip(errors, step / 2 + 1e-4, strict=True))
    assert small.index["rms_error_m"][0] <= errors[0]


def test_samples_are_found_by_subset_and_recording(tmp_path):
    """`01` is both carriageways of the recording, and not the recording 011."""
    names = ("01-lower", "01-upper", "011")
    splits = pl.concat([split_row(name, part) for name, part in zip(names, ("train", "eval", "train"), strict=True)])
    folder = TensorFolder.open(str(write_tiny(tmp_path, splits, subsets=names)))
    subset = folder.run_subset[folder.runs_of(folder.sample_row)]
    wanted = {("train", "01"): [0], ("train", "011"): [2], ("train", "01-lower", "011"): [0, 2], ("eval", "01"): [1]}
    for (part, *chosen), subsets in wanted.items():
        found = folder.samples_of(part, *chosen)
        assert found.tolist() == [number for number, own in enumerate(subset) if own in subsets]
        assert len(folder.read_part(part, *chosen)) == len(found) > 0
    assert len(folder.samples_of("eval", "011")) == 0
    with pytest.raises(UsageError, match="expected subsets, or recordings, of 01-lower, 01-upper, 011, got 01, 02"):
        folder.samples_of("train", "01", "02")
