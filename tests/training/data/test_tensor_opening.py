"""What is not a whole tensor folder of this version is refused, with what and where; what is, is mapped."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tensor_loop import UNDIVIDED, random_tables
from tensor_tables import TINY, drive, sample_everything, split_row, write

from tracklake.schemas.columns import PARTS
from tracklake.schemas.tensors import ARRAYS, ARRAYS_FILE, INDEX_FILE, INDEX_KEYS, SUBSET_KEYS
from tracklake.training.data.checks import KINDS
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


def change_header(name, **changes):
    def change(folder):
        file = folder / ARRAYS_FILE
        whole = file.read_bytes()
        length = int.from_bytes(whole[:8], "little")
        header = json.loads(whole[8 : 8 + length])
        if changes:
            header[name] |= changes
        else:
            del header[name]
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 8)
        file.write_bytes(len(text).to_bytes(8, "little") + text + whole[8 + length :])

    return change


def change_subset(**changes):
    def change(folder):
        file = folder / INDEX_FILE
        index = json.loads(file.read_text())
        index["subsets"][1] |= changes
        file.write_text(json.dumps(index))

    return change


def set_value(name, position, value):
    """Overwrite one value of an array."""

    def change(folder):
        file = folder / ARRAYS_FILE
        whole = bytearray(file.read_bytes())
        length = int.from_bytes(whole[:8], "little")
        entry = json.loads(whole[8 : 8 + length])[name]
        start, end = (8 + length + offset for offset in entry["data_offsets"])
        values = np.frombuffer(whole[start:end], {"I64": "<i8", "I32": "<i4", "U8": "u1"}[entry["dtype"]]).copy()
        values[position] = value
        whole[start:end] = values.tobytes()
        file.write_bytes(whole)

    return change


def resize(change):
    def damage(folder):
        file = folder / ARRAYS_FILE
        file.write_bytes(change(file.read_bytes()))

    return damage


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
        (lambda folder: (folder / INDEX_FILE).write_text("[]"), "expected version 3 of tensors, got list"),
        (change_index(version=1), "expected version 3 of tensors, got 1; run `tracklake tensors` again"),
        (drop_key, "index.json: lacks blocks, subsets: width_m; run"),
        (change_index(protocol={"name": "x"}), "expected a protocol of drop_error_findings, .*, got name"),
        (change_index(storage="float16"), "expected storage float32 or .*, got 'float16'"),
        (change_index(max_error_m=[0.2, 0.0]), "rounding error along the road of at most 0.001 m for float32, got 0.2"),
        (lambda folder: (folder / ARRAYS_FILE).unlink(), "arrays.safetensors: cannot be read"),
        (resize(lambda whole: whole[:0]), r"not a whole safetensors file \(0 bytes\)"),
        (resize(lambda whole: b"PAR1" + whole[4:]), "not a whole safetensors file"),
        (resize(lambda whole: whole[:-1]), "cut short: array `scene_part` ends at byte [0-9,]+, the file at [0-9,]+"),
        (resize(lambda whole: whole + b"\0"), "expected [0-9,]+ bytes, got [0-9,]+; run"),
        (resize(lambda whole: whole[:8] + b"x" + whole[9:]), "cannot be read"),
        (change_header("lane"), "array `lane`: expected I16 of shape .*, got nothing of shape None"),
        (change_header("lane", dtype="I32"), "array `lane`: expected I16 of shape .*, got I32 of shape"),
        (change_header("neighbor_offset", shape=[1]), r"array `neighbor_offset`: expected I64 of shape .*\[1\]"),
        (change_header("lane", data_offsets=[1, 3]), "array `lane` cannot stand at bytes 1 to 3"),
        (change_header("lane", data_offsets="x"), "`lane`: expected its two `data_offsets` in bytes, got 'x'; run"),
        (change_header("lane", data_offsets=[0]), r"`lane`: expected its two `data_offsets` in bytes, got \[0\]"),
        (change_header("lane", data_offsets=None), "`lane`: expected its two `data_offsets` in bytes, got None"),
        (change_header("lane", data_offsets=[-4, 0]), r"two `data_offsets` in bytes, got \[-4, 0\]"),
        (change_header("lane", data_offsets=[0, True]), r"two `data_offsets` in bytes, got \[0, True\]"),
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


def test_every_kind_that_is_declared_is_known():
    assert {*INDEX_KEYS.values(), *SUBSET_KEYS.values()} == set(KINDS)


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


def test_the_file_is_laid_out_as_safetensors_says(tmp_path):
    """Read by the format's description alone: arrays without holes, in the declared types, holding what is mapped."""
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=5, ticks=20)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    whole = (write(tmp_path, tables, split_row("a", "train")) / ARRAYS_FILE).read_bytes()
    length = int.from_bytes(whole[:8], "little")
    header, values = json.loads(whole[8 : 8 + length]), whole[8 + length :]
    assert length % 8 == 0
    assert header.pop("__metadata__") == {"format": "np"}
    kinds = {"F32": "<f4", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "<i1", "U8": "<u1"}
    folder, end = TensorFolder.open(tmp_path), 0
    assert list(header) == [array.name for array in ARRAYS]
    for name, entry in header.items():
        start, last = entry["data_offsets"]
        assert start == end, "a hole"
        end = last
        read = np.frombuffer(values[start:last], kinds[entry["dtype"]]).reshape(entry["shape"])
        np.testing.assert_array_equal(getattr(folder, name), read)
        assert getattr(folder, name).flags.aligned
    assert end == len(values)
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
