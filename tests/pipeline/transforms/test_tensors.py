"""Arrays of one subset by hand: rows, runs, blocks and neighbors. (Batches against a loop: tests/training.)"""

import numpy as np
import polars as pl
import pytest

from pipeline.tensor_files import write_tensors
from pipeline.transforms.tensors import build_subset_arrays, concatenate, describe_tensors
from schemas.protocols import Protocol
from schemas.samples import NEIGHBORS, SAMPLES
from schemas.splits import SPLITS

P = Protocol(name="p", rate_hz=2, history_s=0.5, horizon_s=1.0, min_future_s=0.5)  # 2 positions of history, 2 of future
TOP = 2**31 - 1

CLOCK = pl.DataFrame(
    [
        # vehicle 3 has a gap after tick 2; vehicle TOP ends its segment after tick 1 without one
        (3, 0, 10.0, 1, 1),
        (3, 1, 11.0, 1, 1),
        (3, 2, 12.0, 1, 1),
        (3, 4, 14.0, 1, 2),
        (3, 5, 15.0, 1, 2),
        (TOP, 0, 20.0, 2, 3),
        (TOP, 1, 21.0, None, 3),
        (TOP, 2, 22.0, 2, 4),
        (TOP, 3, 23.0, 2, 4),
        (TOP, 4, 24.0, 2, 4),
    ],
    schema={
        "vehicle_id": pl.Int32,
        "tick": pl.Int32,
        "x_m": pl.Float64,
        "lane": pl.Int16,
        "segment": pl.Int32,
    },
    orient="row",
).with_columns(y_m=pl.lit(1.5), speed_mps=pl.lit(2.0, dtype=pl.Float32), frame=pl.lit(None, dtype=pl.Int32))


def samples(*origins, protocol="p", lateral="right", longitudinal="brake"):
    rows = [(protocol, "highd", "a", vehicle, tick, None, 1, lateral, longitudinal) for vehicle, tick in origins]
    return pl.DataFrame(rows, schema=SAMPLES.dtypes, orient="row")


def neighbors(*pairs, protocol="p"):
    rows = [(protocol, "highd", "a", *pair, 0.0) for pair in pairs]
    return pl.DataFrame(rows, schema=NEIGHBORS.dtypes, orient="row")


def blocks(*rows):
    return pl.DataFrame([("s", "highd", "a", *row) for row in rows], schema=SPLITS.dtypes, orient="row")


WHOLE = blocks((0, 1, 100, None, None, "eval"))
SAMPLED = samples((3, 1), (TOP, 3))


def build(sampled=SAMPLED, around=None, split=WHOLE, clock=CLOCK, subset_index=4):
    # 25 Hz on a 2 Hz clock: tick k lies at frame 1 + 12.5 k
    return build_subset_arrays(
        clock,
        sampled,
        neighbors() if around is None else around,
        split,
        subset_index=subset_index,
        first_frame=1,
        frame_rate_hz=25.0,
        protocol=P,
    )


def test_rows_runs_and_samples_by_hand():
    arrays = build(around=neighbors((3, 1, 20, TOP), (TOP, 3, 0, 3)).head(1))
    assert arrays["segment_first"].tolist() == [0, 0, 0, 3, 3, 5, 5, 7, 7, 7]
    assert arrays["segment_last"].tolist() == [2, 2, 2, 4, 4, 6, 6, 9, 9, 9]
    assert arrays["sample_row"].tolist() == [1, 8]
    assert arrays["sample_part"].tolist() == [2, 2]
    assert arrays["sample_lateral"].tolist() == [2, 2]
    assert arrays["sample_longitudinal"].tolist() == [1, 1]
    assert arrays["neighbor_offset"].tolist() == [0, 1, 1]
    assert arrays["neighbor_row"].tolist() == [6]
    assert arrays["neighbor_cell"].tolist() == [20]
    assert arrays["subset"].tolist() == [4] * 10
    assert arrays["vehicle_id"].tolist() == [3] * 5 + [TOP] * 5
    assert arrays["lane"].tolist() == [1, 1, 1, 1, 1, 2, 0, 2, 2, 2]
    assert arrays["x_m"].tolist() == [10, 11, 12, 14, 15, 20, 21, 22, 23, 24]


def test_a_block_cuts_rows_histories_futures_and_neighbors():
    # Ticks 0, 1, 2, 3, 4 lie at frames 1, 13.5, 26, 38.5, 51. The blocks meet between ticks 2 and 3.
    split = blocks((0, 1, 26, None, None, "train"), (1, 27, 60, None, None, "eval"))
    around = neighbors((3, 1, 5, TOP))
    arrays = build(sampled=samples((3, 1), (TOP, 3), (TOP, 4)), around=around, split=split)
    # Vehicle TOP's rows at ticks 2 | 3, 4 are cut apart: its sample at tick 3 has lost its history, that at tick 4 has
    # no future. Vehicle 3's last entry (frame 63.5) stands in no block.
    assert arrays["tick"].tolist() == [0, 1, 2, 4, 0, 1, 2, 3, 4]
    assert arrays["segment_first"].tolist() == [0, 0, 0, 3, 4, 4, 6, 7, 7]
    assert arrays["segment_last"].tolist() == [2, 2, 2, 3, 5, 5, 6, 8, 8]
    assert arrays["sample_row"].tolist() == [1]
    assert arrays["sample_part"].tolist() == [0]
    assert arrays["neighbor_row"].tolist() == [5]


def test_a_tick_between_two_frames_stands_in_a_block_only_if_both_do():
    # Tick 1 lies at frame 13.5.
    split = blocks((0, 1, 13, None, None, "train"), (1, 14, 60, None, None, "eval"))
    assert 1 not in build(sampled=samples(), split=split)["tick"]


def test_blocks_by_vehicle_keep_neighbors_of_other_parts_away():
    split = blocks((0, 1, 100, None, 3, "train"), (1, 1, 100, 4, None, "val"))
    arrays = build(around=neighbors((3, 1, 5, TOP)), split=split)
    assert arrays["sample_part"].tolist() == [0, 1]
    assert arrays["neighbor_offset"].tolist() == [0, 0, 0]


def test_samples_of_other_protocols_are_passed_by():
    sampled = pl.concat([SAMPLED, samples((3, 1), protocol="q")])
    around = pl.concat([neighbors((3, 1, 5, TOP)), neighbors((3, 1, 5, TOP), protocol="q")])
    arrays = build(sampled=sampled, around=around)
    assert len(arrays["sample_row"]) == 2
    assert len(arrays["neighbor_row"]) == 1


def test_joined_subsets_shift_rows_and_offsets():
    one = build(around=neighbors((3, 1, 20, TOP)), subset_index=0)
    two = build(around=neighbors((3, 1, 7, TOP), (3, 1, 8, TOP)), subset_index=1)
    joined = concatenate([one, two])
    assert joined["sample_row"].tolist() == [1, 8, 11, 18]
    assert joined["neighbor_offset"].tolist() == [0, 1, 1, 3, 3]
    assert joined["neighbor_row"].tolist() == [6, 16, 16]
    assert joined["neighbor_cell"].tolist() == [20, 7, 8]
    assert joined["segment_last"][10:].tolist() == [12, 12, 12, 14, 14, 16, 16, 19, 19, 19]
    assert joined["subset"].tolist() == [0] * 10 + [1] * 10


def test_the_index_names_protocol_subsets_blocks_and_sizes():
    subsets = pl.DataFrame({"dataset": ["highd"], "subset": ["a"], "frame_rate_hz": [25.0], "more": [1]})
    index = describe_tensors(build(), subsets, WHOLE, P)
    assert index["split"] == "s"
    assert index["protocol"]["name"] == "p"
    assert index["protocol"]["digest"] == P.digest
    assert index["subsets"] == [{"dataset": "highd", "subset": "a", "frame_rate_hz": 25.0}]
    assert index["blocks"][0]["part"] == "eval"
    assert index["sizes"] == {"N": 10, "S": 2, "K": 0}
    assert index["samples_by_part"] == {"train": 0, "val": 0, "eval": 2}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clock": CLOCK.reverse()}, "highd/a: the entries on the clock are not sorted"),
        ({"sampled": samples((3, 3))}, "1 of 1 samples have no entry or not 2 ticks of history .*vehicle 3 at tick 3"),
        ({"sampled": samples((3, 4))}, "not 2 ticks of history on the clock, for example vehicle 3 at tick 4"),
        ({"sampled": samples((9, 1))}, "vehicle 9 at tick 1; make the samples anew"),
        ({"around": neighbors((3, 2, 5, TOP))}, "name a sample that is not there, for example vehicle 3 at tick 2"),
        ({"around": neighbors((3, 1, 5, 77))}, "1 neighbors have no entry on the clock, for example vehicle 77"),
        (
            {"split": blocks((0, 1, 50, None, None, "train"), (1, 38, 60, None, None, "eval"))},
            "highd/a: block 1 of the split overlaps another one",
        ),
    ],
)
def test_tables_that_disagree_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        build(**change)


def test_an_empty_clock_gives_empty_arrays():
    arrays = build(sampled=samples(), clock=CLOCK.clear())
    assert {name: len(array) for name, array in arrays.items() if len(array)} == {"neighbor_offset": 1}


def test_files_are_written_with_their_index(tmp_path):
    arrays = build()
    write_tensors(tmp_path, arrays, {"version": 1})
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == sorted([f"{name}.npy" for name in arrays] + ["index.json"])
    np.testing.assert_array_equal(np.load(tmp_path / "x_m.npy"), arrays["x_m"])


def test_arrays_of_another_kind_are_not_written(tmp_path):
    arrays = build()
    with pytest.raises(ValueError, match="array `lane`: expected int16, got int64"):
        write_tensors(tmp_path, arrays | {"lane": arrays["lane"].astype(np.int64)}, {})
    with pytest.raises(ValueError, match="array `tick`: expected int32, got nothing"):
        write_tensors(tmp_path, {name: array for name, array in arrays.items() if name != "tick"}, {})
    assert list(tmp_path.iterdir()) == []
