"""Batches equal those of a literal per-sample loop over the tables, value for value."""

import json
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_tables import TINY, build, drive, random_clock, sample_everything, split_row, write

from pipeline.transforms.tensors import concatenate
from schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from schemas.tensors import ARRAYS
from training.tensors import TensorError, TensorFolder

H, F = TINY.history_ticks, TINY.horizon_ticks


def block_of(vehicle_id, frame, blocks):
    """The block of an entry, by looking at each."""
    for row in blocks.iter_rows(named=True):
        low, high = row["first_vehicle_id"], row["last_vehicle_id"]
        if (
            row["first_frame"] <= frame <= row["last_frame"]
            and (low is None or vehicle_id >= low)
            and (high is None or vehicle_id <= high)
        ):
            return row["block"], row["part"]
    return None


def loop_over_samples(tables, splits):
    """Every sample as plain values, straight from the tables: what the tensors must say."""
    expected = []
    for subset, clock, samples, neighbors in tables:
        blocks = splits.filter(pl.col("subset") == subset)
        # (vehicle, tick) -> (x, y, what it may be joined with: same segment and same block)
        entries = {}
        for vehicle_id, tick, frame, x_m, y_m, _, _, segment in clock.iter_rows():
            block = block_of(vehicle_id, frame, blocks)
            if block is not None:
                entries[vehicle_id, tick] = (np.float32(x_m), np.float32(y_m), segment, block)
        for sample in samples.iter_rows(named=True):
            own, tick = sample["vehicle_id"], sample["tick"]
            if (own, tick) not in entries:
                continue
            x0, y0, segment, block = entries[own, tick]

            def at(vehicle_id, when, like, origin=(x0, y0), entries=entries):
                entry = entries.get((vehicle_id, when))
                if entry is None or entry[2:] != like:
                    return None
                return entry[0] - origin[0], entry[1] - origin[1]

            history = [at(own, tick - H + 1 + h, (segment, block)) for h in range(H)]
            future = [at(own, tick + f, (segment, block)) for f in range(1, F + 1)]
            for f in range(1, F):  # once lost, lost: a track that comes back after a gap is not the same run
                if future[f - 1] is None:
                    future[f] = None
            if None in history or future[0] is None:
                continue
            last_known = [position for position in future if position is not None][-1]
            around = []
            rows = neighbors.filter((pl.col("vehicle_id") == own) & (pl.col("tick") == tick)).sort("cell")
            for row in rows.iter_rows(named=True):
                other = row["neighbor_id"]
                if (other, tick) not in entries or entries[other, tick][3] != block:
                    continue
                like = entries[other, tick][2:]
                positions, known = [], []
                for back in range(H):
                    position = at(other, tick - back, like)
                    if position is None or (known and not known[0]):
                        positions.insert(0, positions[0])
                        known.insert(0, False)
                    else:
                        positions.insert(0, position)
                        known.insert(0, True)
                around.append((row["cell"], positions, known))
            expected.append(
                SimpleNamespace(
                    subset=subset,
                    key=(subset, own, tick),
                    part=block[1],
                    origin=(x0, y0),
                    history=history,
                    future=[last_known if position is None else position for position in future],
                    future_mask=[position is not None for position in future],
                    around=around,
                    lateral=LATERAL_MANEUVERS.index(sample["lateral_maneuver"]),
                    longitudinal=LONGITUDINAL_MANEUVERS.index(sample["longitudinal_maneuver"]),
                )
            )
    return expected


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


def random_tables(seed, subsets=("a", "b", "c")):
    draw = np.random.default_rng(seed)
    tables = []
    for subset in subsets:
        clock = random_clock(draw, vehicles=int(draw.integers(0, 7)))
        tables.append((subset, clock, *sample_everything(draw, clock, dataset="highd", subset=subset)))
    return tables


UNDIVIDED = pl.concat([split_row("a", "train"), split_row("b", "eval"), split_row("c", "train")])
IN_TIME = pl.concat(
    [
        split_row("a", "train", block=0, first_frame=0, last_frame=30),
        split_row("a", "eval", block=1, first_frame=36, last_frame=70),
        split_row("b", "val"),
        split_row("c", "eval", block=0, first_frame=20, last_frame=45),
    ]
)
BY_VEHICLE = pl.concat(
    [
        split_row("a", "train", block=0, ids=(None, 15)),
        split_row("a", "val", block=1, ids=(16, 25)),
        split_row("a", "eval", block=2, ids=(26, None)),
        split_row("b", "train"),
        split_row("c", "eval", block=0, ids=(10, 30)),
    ]
)


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
@given(seed=st.integers(0, 10_000))
def test_arrays_are_as_declared_and_rows_are_sorted(seed):
    tables = random_tables(seed)
    arrays, index = build(tables, UNDIVIDED)
    sizes = index["sizes"]
    lengths = {"N": sizes["N"], "S": sizes["S"], "K": sizes["K"], "S+1": sizes["S"] + 1}
    assert {a.name: (str(arrays[a.name].dtype), arrays[a.name].shape) for a in ARRAYS} == {
        a.name: (a.dtype, (lengths[a.shape],)) for a in ARRAYS
    }
    assert sizes["N"] == sum(table[1].height for table in tables)
    keys = list(zip(arrays["subset"], arrays["vehicle_id"], arrays["tick"], strict=True))
    assert keys == sorted(set(keys))
    assert (np.diff(arrays["sample_row"]) > 0).all()
    assert json.loads(json.dumps(index)) == index


def test_order_of_the_input_rows_of_samples_and_neighbors_does_not_matter():
    tables = random_tables(5)
    shuffled = [
        (subset, clock, *(table.sample(fraction=1.0, shuffle=True, seed=1) for table in rest))
        for subset, clock, *rest in tables
    ]
    wanted, _ = build(tables, UNDIVIDED)
    got, _ = build(shuffled, UNDIVIDED)
    for name, array in wanted.items():
        np.testing.assert_array_equal(got[name], array)


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
    assert {name: len(array) for name, array in concatenate([]).items() if len(array)} == {"neighbor_offset": 1}


def test_unknown_part(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(1), UNDIVIDED))
    with pytest.raises(ValueError, match="unknown part `test`: expected one of train, val, eval"):
        folder.samples_of("test")


def break_index(**changes):
    def change(folder):
        file = folder / "index.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda folder: (folder / "index.json").unlink(),
            "no tensors here \\(no index.json\\); run `tracklake tensors`",
        ),
        (lambda folder: (folder / "index.json").write_text("{"), "index.json: not readable as JSON"),
        (lambda folder: (folder / "index.json").write_text("[]"), "expected version 1 of tensors, got list"),
        (break_index(version=99), "expected version 1 of tensors, got 99"),
        (break_index(protocol={"name": "x"}), "expected a protocol of history_s, .*, got name"),
        (lambda folder: (folder / "x_m.npy").unlink(), "x_m.npy: cannot be read"),
        (lambda folder: (folder / "x_m.npy").write_bytes(b""), "x_m.npy: cannot be read"),
        (
            lambda folder: np.save(folder / "lane.npy", np.zeros(3, dtype=np.int64)),
            "lane.npy: expected int16 of shape \\(\\d+,\\), got int64 of shape \\(3,\\)",
        ),
        (
            lambda folder: np.save(folder / "neighbor_offset.npy", np.zeros(1, dtype=np.int64)),
            "neighbor_offset.npy: expected int64 of shape",
        ),
    ],
)
def test_a_damaged_folder_is_refused_with_what_and_where(tmp_path, damage, message):
    write(tmp_path, random_tables(1), UNDIVIDED)
    damage(tmp_path)
    with pytest.raises(TensorError, match=message):
        TensorFolder.open(tmp_path)


def test_a_protocol_that_was_tampered_with_is_refused(tmp_path):
    write(tmp_path, random_tables(1), UNDIVIDED)
    index = json.loads((tmp_path / "index.json").read_text())
    index["protocol"]["history_s"] = 0.5
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(TensorError, match="digest"):
        TensorFolder.open(tmp_path)


def test_folders_are_opened_without_being_read(tmp_path):
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=5, ticks=20)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    folder = TensorFolder.open(write(tmp_path, tables, split_row("a", "train")))
    assert isinstance(folder.x_m.base, np.memmap)
    assert not folder.x_m.flags.writeable
