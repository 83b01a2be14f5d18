"""What is not a whole tensor folder of this version is refused, with what and where; what is, is mapped."""

import errno
import json
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from tensor_loop import UNDIVIDED, random_tables
from tensor_tables import TINY, drive, sample_everything, split_row, write

from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import FileAccessError
from tracklake.schemas.tensors import ARRAYS, INDEX_FILE
from tracklake.training.data.tensor_folder import TensorError, TensorFolder


def change_index(**changes):
    def change(folder):
        file = folder / INDEX_FILE
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return change


def drop_key(folder):
    file = folder / INDEX_FILE
    index = json.loads(file.read_text())
    del index["blocks"], index["subsets"][0]["width_m"]
    file.write_text(json.dumps(index))


def change_file(name, change):
    """Rewrite an array's file."""

    def damage(folder):
        file = folder / f"{name}.npy"
        file.write_bytes(change(file.read_bytes()))

    return damage


def store_otherwise(name, change):
    """Store other values under an array's name."""

    def damage(folder):
        file = folder / f"{name}.npy"
        np.save(file, change(np.load(file)))

    return damage


def change_subset(**changes):
    def change(folder):
        file = folder / INDEX_FILE
        index = json.loads(file.read_text())
        index["subsets"][1] |= changes
        file.write_text(json.dumps(index))

    return change


def set_value(name, position, value):
    """Overwrite one value of an array."""

    def change(values):
        values[position] = value
        return values

    return store_otherwise(name, change)


def test_the_protocol_is_read_as_it_was_written(tmp_path):
    given = replace(TINY, scored_s=(0.5, 1.5), headline="mae", train_share=0.7, split="mine")
    folder = TensorFolder.open(write(tmp_path, random_tables(1), UNDIVIDED, protocol=given))
    assert folder.protocol == given
    assert isinstance(folder.protocol.scored_s, tuple)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / INDEX_FILE).unlink(), r"no tensors here \(no index.json\); run `tracklake tensors`"),
        (lambda folder: (folder / INDEX_FILE).write_text("{"), "index.json: not readable as JSON"),
        (lambda folder: (folder / INDEX_FILE).write_text("[]"), "expected version 5 of tensors, got list"),
        (change_index(version=1), "expected version 5 of tensors, got 1; run `tracklake tensors` again"),
        (drop_key, "index.json: lacks blocks, subsets: width_m; run"),
        (
            change_index(protocol={"name": "x"}),
            "expected a protocol of drop_error_findings, .*, got fold_lanes, grid_cell_m, name",
        ),
        (change_index(storage="float16"), "expected storage float32 or .*, got 'float16'"),
        (change_index(max_error_m=[0.2, 0.0]), "rounding error along the road of at most 0.001 m for float32, got 0.2"),
        (lambda folder: (folder / "lane.npy").unlink(), "lane.npy: cannot be read"),
        (change_file("lane", lambda whole: whole[:0]), "lane.npy: cannot be read"),
        (change_file("lane", lambda whole: b"PAR1" + whole[4:]), "lane.npy: cannot be read"),
        (change_file("lane", lambda whole: whole[:-1]), "lane.npy: cannot be read .*greater than file size"),
        (change_file("lane", lambda whole: whole + b"\0"), "lane.npy: expected [0-9,]+ bytes, got [0-9,]+; run"),
        (change_file("lane", lambda whole: whole[:20] + b"x" + whole[21:]), "lane.npy: cannot be read"),
        (store_otherwise("lane", lambda lane: lane.astype(np.int32)), "lane.npy: expected int16 of .*, got int32 of"),
        (store_otherwise("neighbor_offset", lambda own: own[:1]), r"neighbor_offset.npy: expected int64 .*\(1,\)"),
        (store_otherwise("lane", lambda lane: lane.astype(object)), "lane.npy: cannot be read"),
        (change_index(sizes={}), "index.json: lacks sizes: R, sizes: S, sizes: C, sizes: N, sizes: K; run"),
        (change_index(sizes=None), "index.json: `sizes`: expected counts by name, got None; run"),
        (change_index(sizes={"N": -1}), r"`sizes`: expected counts by name, got \{'N': -1\}"),
        (change_index(protocol=None), "`protocol`: expected an object, got None"),
        (change_index(split=5), "`split`: expected text, got 5"),
        (change_index(max_error_m=None), "`max_error_m`: expected two numbers, got None"),
        (change_index(max_error_m=[]), r"`max_error_m`: expected two numbers, got \[\]"),
        (change_index(max_error_m=[0.0, float("nan")]), r"`max_error_m`: expected two numbers, got \[0.0, nan\]"),
        (change_index(rms_error_m=[True, 0]), r"`rms_error_m`: expected two numbers, got \[True, 0\]"),
        (change_index(blocks=None), "`blocks`: expected objects, got None"),
        (change_index(subsets=None), "`subsets`: expected objects, got None"),
        (change_index(subsets=[5]), r"`subsets`: expected objects, got \[5\]"),
        (change_index(subsets=[]), "array `run_subset`: expected 0 to -1, the index's subsets, got 0 to [0-9]; run"),
        (change_subset(centre_m=[0.0]), r"`subsets\[1\].centre_m`: expected two numbers, got \[0.0\]; run"),
        (
            change_subset(lane_markings_m=["x"]),
            r"`subsets\[1\].lane_markings_m`: expected numbers or null, got \['x'\]",
        ),
        (change_subset(last_lane=2.5), r"`subsets\[1\].last_lane`: expected a whole number, got 2.5"),
        (change_subset(width_m=None), r"`subsets\[1\].width_m`: expected a number, got None"),
        (change_index(samples_by_part=None), "`samples_by_part`: expected counts by name, got None"),
        (change_index(samples_by_part={"val": 0}), "lacks samples_by_part: train, samples_by_part: eval; run"),
        (
            change_index(samples_by_part={"train": 1, "val": 0, "eval": 0}),
            "array `sample_part`: expected 1 samples of train, as the index counts, got [0-9]+; run",
        ),
        (set_value("sample_part", 0, 2), "array `sample_part`: expected [0-9]+ samples of [a-z]+, as the index counts"),
        (set_value("run_subset", 0, -1), "array `run_subset`: expected 0 to [0-9], the index's subsets, got -1 to"),
        (set_value("run_first_row", 0, 1), "array `run_first_row`: expected offsets from 0 to [0-9]+, got 1 to"),
        (set_value("neighbor_offset", -1, 0), "`neighbor_offset`: expected offsets from 0 to [0-9]+, got 0 to 0; run"),
        (
            set_value("scene_offset", 1, -7),
            "`scene_offset`: expected offsets that never fall, got -7 after 0 at 1; run",
        ),
    ],
)
def test_a_damaged_folder_is_refused_with_what_and_where(tmp_path, damage, message):
    write(tmp_path, random_tables(1), UNDIVIDED)
    damage(tmp_path)
    with pytest.raises(TensorError, match=message):
        TensorFolder.open(tmp_path)


def test_too_few_descriptors_are_no_damage(tmp_path, monkeypatch):
    write(tmp_path, random_tables(1), UNDIVIDED)
    full = Mock(side_effect=OSError(errno.EMFILE, "Too many open files"))
    monkeypatch.setattr(np.lib.format, "open_memmap", full)
    with pytest.raises(FileAccessError, match=r"\.npy: Too many open files\. Raise the limit .*`ulimit -n 1024`"):
        TensorFolder.open(tmp_path)


def test_samples_of_no_part_are_refused(tmp_path):
    """Those that are left do agree with the index."""
    write(tmp_path, random_tables(1), UNDIVIDED)
    index = json.loads((tmp_path / INDEX_FILE).read_text())
    part = PARTS[TensorFolder.open(tmp_path).sample_part[0]]
    counts = index["samples_by_part"] | {part: index["samples_by_part"][part] - 1}
    change_index(samples_by_part=counts)(tmp_path)
    set_value("sample_part", 0, 9)(tmp_path)
    with pytest.raises(TensorError, match=r"`sample_part`: expected 0 to 2, got 9 \(1 samples of no part\); run"):
        TensorFolder.open(tmp_path)


def test_steps_that_do_not_fit_the_error_are_refused(tmp_path):
    write(tmp_path, random_tables(1), UNDIVIDED, storage="int16-decimetres")
    change_index(storage="int16-centimetres")(tmp_path)
    with pytest.raises(TensorError, match=r"error along the road of at most 0.006 m for int16-centimetres, got 0.0"):
        TensorFolder.open(tmp_path)


def test_a_protocol_that_was_tampered_with_is_refused(tmp_path):
    write(tmp_path, random_tables(1), UNDIVIDED)
    index = json.loads((tmp_path / INDEX_FILE).read_text())
    index["protocol"]["history_s"] = 0.5
    (tmp_path / INDEX_FILE).write_text(json.dumps(index))
    with pytest.raises(TensorError, match="digest"):
        TensorFolder.open(tmp_path)


def test_any_reader_of_numpys_format_reads_the_arrays(tmp_path):
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=5, ticks=20)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    folder = TensorFolder.open(write(tmp_path, tables, split_row("a", "train")))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([INDEX_FILE, *(array.file for array in ARRAYS)])
    for array in ARRAYS:
        read = np.load(tmp_path / array.file, allow_pickle=False)
        mapped = getattr(folder, array.name)
        assert read.dtype == mapped.dtype
        np.testing.assert_array_equal(mapped, read)
        assert mapped.flags.aligned
    assert len(folder.lane) == clock.height
    np.testing.assert_array_equal(folder.position_m, clock.select("x_m", "y_m").to_numpy().astype(np.float32))


def test_folders_are_opened_without_being_read(tmp_path):
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=5, ticks=20)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    folder = TensorFolder.open(write(tmp_path, tables, split_row("a", "train"), protocol=TINY))
    base = folder.position_m
    while isinstance(base.base, np.ndarray):
        base = base.base
    assert isinstance(base, np.memmap)
    assert not folder.position_m.flags.writeable
