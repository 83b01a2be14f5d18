"""Arrays of one subset by hand: rows, runs, blocks and neighbors. (Batches against a loop: tests/training.)"""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.transforms.tensors.arrays import build_subset_tensors, count_sizes, join_after
from tracklake.pipeline.transforms.tensors.entries import TensorInputs
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.schemas.splits import SPLITS
from tracklake.schemas.tensors import ARRAYS, INDEX_KEYS, SUBSET_KEYS

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
    rows = [(protocol, "highd", "a", vehicle, tick, None, 1, lateral, longitudinal, None) for vehicle, tick in origins]
    return pl.DataFrame(rows, schema=SAMPLES.dtypes, orient="row")


def neighbors(*pairs, protocol="p"):
    rows = [(protocol, "highd", "a", *pair, 0.0) for pair in pairs]
    return pl.DataFrame(rows, schema=NEIGHBORS.dtypes, orient="row")


def blocks(*rows):
    return pl.DataFrame([("s", "highd", "a", *row) for row in rows], schema=SPLITS.dtypes, orient="row")


def findings(*rows):
    facts = [("highd", "a", vehicle, "a_rule", severity, *frames, 1, 1.0) for vehicle, severity, *frames in rows]
    return pl.DataFrame(facts, schema=FINDINGS.dtypes, orient="row")


WHOLE = blocks((0, 1, 100, None, None, "eval"))
SAMPLED = samples((3, 1), (TOP, 3))


VEHICLES = pl.DataFrame(
    {"vehicle_id": [TOP, 3], "length_m": [None, 4.5], "width_m": [2.5, None]},
    schema={"vehicle_id": pl.Int32, "length_m": pl.Float32, "width_m": pl.Float32},
)
AT_2_HZ = {"first_frame": 1, "frame_rate_hz": 25.0}
"""25 Hz on a 2 Hz clock: tick k lies at frame 1 + 12.5 k."""
GIVEN = {"vehicles": VEHICLES, "findings": FINDINGS.empty()} | AT_2_HZ


def build_tensors(sampled=SAMPLED, around=None, split=WHOLE, clock=CLOCK, protocol=P, **more):
    around = neighbors() if around is None else around
    return build_subset_tensors(clock, sampled, around, TensorInputs(split, protocol=protocol, **(GIVEN | more)))


def build(**changes):
    return build_tensors(**changes).arrays


def ticks_of(arrays):
    """The tick of every row."""
    lengths = np.diff(arrays["run_first_row"])
    return np.repeat(arrays["run_first_tick"], lengths) + np.concatenate([np.arange(n) for n in lengths])


def test_rows_runs_and_samples_by_hand():
    arrays = build(around=neighbors((3, 1, 20, TOP), (TOP, 3, 0, 3)).head(1))
    assert arrays["run_first_row"].tolist() == [0, 3, 5, 7, 10]
    assert arrays["run_vehicle_id"].tolist() == [3, 3, TOP, TOP]
    assert arrays["run_first_tick"].tolist() == [0, 4, 0, 2]
    assert arrays["run_subset"].tolist() == [0] * 4
    assert arrays["sample_row"].tolist() == [1, 8]
    assert arrays["sample_part"].tolist() == [2, 2]
    assert arrays["sample_lateral"].tolist() == [2, 2]
    assert arrays["sample_longitudinal"].tolist() == [1, 1]
    assert arrays["sample_future"].tolist() == [1, 1]
    assert arrays["neighbor_offset"].tolist() == [0, 1, 1]
    assert arrays["neighbor_row"].tolist() == [6]
    assert arrays["neighbor_cell"].tolist() == [20]
    assert arrays["neighbor_known"].tolist() == [2]
    assert arrays["lane"].tolist() == [1, 1, 1, 1, 1, 2, 0, 2, 2, 2]
    assert arrays["position_m"].tolist() == [[x, 1.5] for x in (10, 11, 12, 14, 15, 20, 21, 22, 23, 24)]
    assert arrays["speed_mps"].tolist() == [2] * 10


def test_sizes_of_every_run_and_nothing_where_the_source_has_none():
    arrays = build()  # vehicle 3 has two runs and no width, vehicle TOP two runs and no length
    np.testing.assert_array_equal(arrays["run_length_m"], np.float32([4.5, 4.5, np.nan, np.nan]))
    np.testing.assert_array_equal(arrays["run_width_m"], np.float32([np.nan, np.nan, 2.5, 2.5]))


def test_findings_of_rows_that_a_block_keeps():
    # Ticks 0, 1, 2, 3, 4 lie at frames 1, 13.5, 26, 38.5, 51; tick 1 answers for frames 2 to 14.
    found = findings((3, "warning", 2, 2), (TOP, "error", 51, 51), (TOP, "info", 20, 40), (9, "error", 1, 99))
    assert build(findings=found)["finding"].tolist() == [0, 2, 0, 0, 0, 0, 0, 3, 3, 1]
    after = blocks((0, 26, 60, None, None, "train"))  # vehicle 3's tick 2, and tick 4; of TOP ticks 2, 3, 4
    arrays = build(sampled=samples(), findings=found, split=after)
    assert ticks_of(arrays).tolist() == [2, 4, 2, 3, 4]
    assert arrays["finding"].tolist() == [0, 0, 3, 3, 1]


def test_scenes_by_hand():
    # Samples at ticks 1 and 3: at tick 1 both vehicles are there, at tick 3 vehicle TOP alone.
    arrays = build()
    assert arrays["scene_offset"].tolist() == [0, 2, 3]
    assert arrays["scene_row"].tolist() == [1, 6, 8]
    assert arrays["scene_sample"].tolist() == [0, -1, 1]
    assert arrays["scene_part"].tolist() == [2, 2]


def test_a_block_cuts_rows_histories_futures_and_neighbors():
    # Ticks 0, 1, 2, 3, 4 lie at frames 1, 13.5, 26, 38.5, 51. The blocks meet between ticks 2 and 3.
    split = blocks((0, 1, 26, None, None, "train"), (1, 27, 60, None, None, "eval"))
    around = neighbors((3, 1, 5, TOP))
    arrays = build(sampled=samples((3, 1), (TOP, 3), (TOP, 4)), around=around, split=split)
    # Vehicle TOP's rows at ticks 2 | 3, 4 are cut apart: its sample at tick 3 has lost its history, that at tick 4 has
    # no future. Vehicle 3's last entry (frame 63.5) stands in no block.
    assert ticks_of(arrays).tolist() == [0, 1, 2, 4, 0, 1, 2, 3, 4]
    assert arrays["run_first_row"].tolist() == [0, 3, 4, 6, 7, 9]
    assert arrays["sample_row"].tolist() == [1]
    assert arrays["sample_part"].tolist() == [0]
    assert arrays["neighbor_row"].tolist() == [5]
    assert arrays["scene_row"].tolist() == [1, 5]


def test_a_tick_between_two_frames_stands_in_a_block_only_if_both_do():
    # Tick 1 lies at frame 13.5.
    split = blocks((0, 1, 13, None, None, "train"), (1, 14, 60, None, None, "eval"))
    assert 1 not in ticks_of(build(sampled=samples(), split=split))


def test_samples_with_a_neighbor_cut_off_are_counted_and_left_out_on_demand():
    """TOP is left out of eval, so that the sample of 3 does not see it; its own sample is in no part."""
    given = {"around": neighbors((3, 1, 20, TOP)), "left_out": pl.Series([TOP], dtype=pl.Int32)}
    kept, dropped = build_tensors(**given), build_tensors(**given, drop_cut=True)
    assert kept.cut_samples == dropped.cut_samples == (0, 0, 1)
    assert (kept.arrays["sample_row"].tolist(), dropped.arrays["sample_row"].tolist()) == ([1], [])
    assert dropped.arrays["lane"].tolist() == kept.arrays["lane"].tolist(), "its track stays"
    trained = build_tensors(**given, split=blocks((0, 1, 100, None, None, "train")), drop_cut=True)
    assert (trained.cut_samples, len(trained.arrays["sample_row"])) == ((0, 0, 0), 2)
    alone = build_tensors(left_out=given["left_out"], drop_cut=True)
    assert (alone.cut_samples, alone.arrays["sample_row"].tolist()) == ((0, 0, 0), [1])


def test_a_vehicle_left_out_keeps_what_trains_and_nothing_else():
    # Vehicle 3 has ticks 0 to 2 in train and 4 in eval; TOP has 0 to 2 in train and 3, 4 in eval.
    split = blocks((0, 1, 26, None, None, "train"), (1, 27, 70, None, None, "eval"))
    arrays = build(sampled=samples((3, 1)), split=split, left_out=pl.Series([TOP, 77], dtype=pl.Int32))
    assert ticks_of(arrays).tolist() == [0, 1, 2, 4, 5, 0, 1, 2]
    assert arrays["sample_part"].tolist() == [0]
    everything = build(sampled=samples((3, 1)), split=split)
    assert ticks_of(everything).tolist() == [0, 1, 2, 4, 5, 0, 1, 2, 3, 4]


def test_blocks_by_vehicle_keep_neighbors_of_other_parts_away():
    split = blocks((0, 1, 100, None, 3, "train"), (1, 1, 100, 4, None, "val"))
    arrays = build(around=neighbors((3, 1, 5, TOP)), split=split)
    assert arrays["sample_part"].tolist() == [0, 1]
    assert arrays["neighbor_offset"].tolist() == [0, 0, 0]


def test_samples_of_other_protocols_are_skipped():
    sampled = pl.concat([SAMPLED, samples((3, 1), protocol="q")])
    around = pl.concat([neighbors((3, 1, 5, TOP)), neighbors((3, 1, 5, TOP), protocol="q")])
    arrays = build(sampled=sampled, around=around)
    assert len(arrays["sample_row"]) == 2
    assert len(arrays["neighbor_row"]) == 1


def test_joined_subsets_shift_rows_and_offsets():
    one = build(around=neighbors((3, 1, 20, TOP)))
    two = build(around=neighbors((3, 1, 7, TOP), (3, 1, 8, TOP)))
    nothing = dict.fromkeys("NRSKCM", 0)
    first = join_after(one, nothing, 0)
    second = join_after(two, count_sizes(one), 1)
    assert count_sizes(one) == {"N": 10, "R": 4, "S": 2, "K": 1, "C": 2, "M": 3}
    joined = {name: np.concatenate([first[name], second[name]]) for name in first}
    assert joined["sample_row"].tolist() == [1, 8, 11, 18]
    assert joined["neighbor_offset"].tolist() == [0, 1, 1, 3, 3]
    assert joined["neighbor_row"].tolist() == [6, 16, 16]
    assert joined["neighbor_cell"].tolist() == [20, 7, 8]
    assert joined["run_first_row"].tolist() == [0, 3, 5, 7, 10, 13, 15, 17, 20]
    assert joined["run_subset"].tolist() == [0] * 4 + [1] * 4
    assert joined["scene_offset"].tolist() == [0, 2, 3, 5, 6]
    assert joined["scene_row"].tolist() == [1, 6, 8, 11, 16, 18]
    assert joined["scene_sample"].tolist() == [0, -1, 1, 2, -1, 3]
    assert {name: array.dtype for name, array in joined.items()} == {name: array.dtype for name, array in one.items()}


def test_more_rows_than_their_numbers_hold_are_refused():
    with pytest.raises(TracklakeError, match="more than 2,147,483,647 rows or samples"):
        join_after(build(), dict.fromkeys("NRSKCM", 2**31 - 5), 1)


FACTS = {
    "dataset": "highd",
    "subset": "a",
    "origin": "recorded",
    "frame_rate_hz": 25.0,
    "lane_markings_m": None,
    "more": 1,
}


def test_the_index_names_protocol_subsets_blocks_sizes_and_errors(tmp_path):
    marked = FACTS | {"subset": "b", "lane_markings_m": [0.0, 4.0, 8.0, 12.0]}
    index = write_tensors(
        tmp_path, [(FACTS, [build_tensors()]), (marked, [build_tensors()])], WHOLE, P, storage="float32"
    )
    assert json.loads((tmp_path / "index.json").read_text()) == index
    assert set(index) == INDEX_KEYS.keys()
    assert index["split"] == "s"
    assert index["protocol"]["name"] == "p"
    assert index["protocol"]["digest"] == P.digest
    unmarked = {
        "dataset": "highd", "subset": "a", "origin": "recorded", "frame_rate_hz": 25.0, "centre_m": [0, 0],
        "lane_markings_m": None, "last_lane": 2, "width_m": 7.3152, "lateral_positions": "recorded",
    }  # fmt: skip
    assert index["subsets"][0] == unmarked
    assert index["subsets"][1] == unmarked | {
        "subset": "b", "lane_markings_m": [0, 4, 8, 12], "last_lane": 3, "width_m": 12,
    }  # fmt: skip
    assert set(unmarked) == set(SUBSET_KEYS)
    assert index["blocks"][0]["part"] == "eval"
    assert index["sizes"] == {"N": 20, "R": 8, "S": 4, "K": 0, "C": 4, "M": 6}
    assert index["samples_by_part"] == {"train": 0, "val": 0, "eval": 4}
    assert (index["max_error_m"], index["rms_error_m"]) == ([0, 0], [0, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clock": CLOCK.reverse()}, "highd/a: the entries on the clock are not sorted"),
        ({"sampled": samples((3, 3))}, "1 of 1 samples have no entry or not 2 ticks of history .*vehicle 3 at tick 3"),
        ({"sampled": samples((3, 4))}, "not 2 ticks of history on the clock, for example vehicle 3 at tick 4"),
        ({"sampled": samples((9, 1))}, "vehicle 9 at tick 1; make the samples again"),
        ({"vehicles": VEHICLES.head(1)}, "highd/a: expected every vehicle .*, got 2 runs of others, .* vehicle 3"),
        ({"around": neighbors((3, 2, 5, TOP))}, "name a missing sample, for example vehicle 3 at tick 2"),
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


def test_a_history_longer_than_a_byte_counts_is_refused():
    long = Protocol(name="p", rate_hz=10, history_s=30.0)
    with pytest.raises(ValueError, match="at most 255 ticks"):
        build_tensors(protocol=long)


def test_an_empty_clock_gives_empty_arrays():
    arrays = build(sampled=samples(), clock=CLOCK.clear())
    assert {name: array.tolist() for name, array in arrays.items() if len(array)} == {
        "run_first_row": [0], "neighbor_offset": [0], "scene_offset": [0],
    }  # fmt: skip


def test_arrays_of_another_kind_are_not_written(tmp_path):
    tensors = build_tensors()
    wrong = (
        (tensors.arrays | {"lane": tensors.arrays["lane"].astype(np.int64)}, "`lane`: expected int16 of .*got int64"),
        ({name: values for name, values in tensors.arrays.items() if name != "run_subset"}, "`run_subset` is missing"),
        (tensors.arrays | {"sample_part": np.zeros(5, np.uint8)}, r"`sample_part`: expected uint8 of shape \(2,\)"),
    )
    for arrays, message in wrong:
        with pytest.raises(ValueError, match=message):
            write_tensors(tmp_path, [(FACTS, [replace(tensors, arrays=arrays)])], WHOLE, P, storage="float32")


def test_nothing_but_the_arrays_and_the_index_is_left(tmp_path):
    write_tensors(tmp_path, [(FACTS, [build_tensors()])], WHOLE, P, storage="float32")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["index.json", *(array.file for array in ARRAYS)])
