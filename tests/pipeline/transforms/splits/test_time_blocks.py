"""Blocks of time: their borders, who is in them, and who stands in two parts; against loops over frames."""

import itertools
import random

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.splits.allocation import (
    allocate_flow_balanced,
    leave_block_out,
    tabulate_allocation,
)
from tracklake.pipeline.transforms.splits.time_blocks import (
    VISITS,
    WEIGHTS,
    count_samples,
    cut_blocks,
    describe_blocks,
    find_left_out,
    find_visits,
    recount_blocks,
)
from tracklake.schemas.errors import UsageError
from tracklake.schemas.split_recipes import SplitRecipe
from tracklake.schemas.splits import SPLIT_LEFT_OUT, SPLITS

ENTRY = {"vehicle_id": pl.Int32, "tick": pl.Int32}


def subsets(*rows):
    """Rows of (subset, first frame, last frame, frames per second)."""
    schema = {"subset": pl.String, "first_frame": pl.Int32, "last_frame": pl.Int32, "frame_rate_hz": pl.Float64}
    frame = pl.DataFrame(rows, schema=schema, orient="row")
    facts = {"dataset": pl.lit("ngsim"), "site": pl.lit("S"), "direction": pl.lit("south"), "lanes": pl.lit(2)}
    return frame.with_columns(**facts)


def test_borders_by_hand():
    # 10 Hz: blocks of 120 s are 1,200 frames, purges 80. 15 minutes hold seven (8,880 frames), and the 120 left become
    # part of the last; 100 s are one block.
    cut = cut_blocks(subsets(("a", 1, 9000, 10.0), ("b", 11, 3330, 10.0), ("c", 5, 1004, 10.0)), block_s=120, purge_s=8)
    found = {name: rows.select("block", "first_frame", "last_frame").rows() for (name,), rows in cut.group_by("subset")}
    starts = [1 + 1280 * block for block in range(7)]
    assert found["a"] == [(k, start, start + 1199 if k < 6 else 9000) for k, start in enumerate(starts)]
    # 3,320 frames: two blocks and their purges take 2,560, which leaves 760: more than half a block.
    assert found["b"] == [(0, 11, 1210), (1, 1291, 2490), (2, 2571, 3330)]
    assert found["c"] == [(0, 5, 1004)]


@settings(max_examples=30, deadline=None)
@given(
    first=st.integers(0, 2**31 - 40_000),
    length=st.integers(1, 30_000),
    rate=st.sampled_from([5.0, 10.0, 25.0, 29.97]),
    block_s=st.floats(10, 300),
    purge_s=st.floats(0, 30),
)
def test_blocks_keep_their_distance_and_lose_nothing_but_purges(first, length, rate, block_s, purge_s):
    last = first + length - 1
    cut = cut_blocks(subsets(("a", first, last, rate)), block_s=block_s, purge_s=purge_s)
    rows = cut.select("first_frame", "last_frame").rows()
    assert cut["block"].to_list() == list(range(cut.height))
    assert (rows[0][0], rows[-1][1]) == (first, last)
    for (start, end), (next_start, _) in itertools.pairwise(rows):
        assert end >= start
        assert (next_start - end) / rate >= purge_s
        assert (next_start - end - 1) / rate < purge_s + 1 / rate, "no more is purged than must be"
        assert end - start + 1 == pytest.approx(block_s * rate, abs=1)
    seconds = (rows[-1][1] - rows[-1][0] + 1) / rate
    assert seconds < 1.5 * block_s + purge_s + 2 / rate
    if cut.height > 1:
        assert seconds >= block_s / 2 - 1 / rate


def scene(seed):
    """Two subsets of 10 Hz, 200 s each, cut into blocks of 20 s; (subset, vehicle, frame) of vehicles with gaps."""
    draw = random.Random(seed)
    known = subsets(("a", 1, 2000, 10.0), ("b", 101, 2100, 10.0))
    entries = [
        (name, vehicle, frame)
        for name in ("a", "b")
        for vehicle in range(1, 25)
        for start in [draw.randint(1, 1800)]
        for frame in range(start, start + draw.choice([40, 300, 900]))
        if draw.random() < 0.3 and frame <= 2000
    ]
    return known, cut_blocks(known, block_s=20, purge_s=8), entries


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), validation=st.booleans())
def test_vehicles_in_two_parts_are_those_that_a_loop_finds(seed, validation):
    known, blocks, entries = scene(seed)
    frames = pl.DataFrame(
        entries, schema={"subset": pl.String, "vehicle_id": pl.Int32, "frame": pl.Int32}, orient="row"
    )
    visits = pl.concat(find_visits(frames.filter(subset=name), blocks.filter(subset=name)) for name in ("a", "b"))
    places = {(name, k): (first, last) for _, name, k, first, last in blocks.iter_rows()}
    inside = {}
    for name, vehicle, frame in entries:
        for (where, block), (first, last) in places.items():
            if where == name and first <= frame <= last:
                inside[name, block, vehicle] = inside.get((name, block, vehicle), 0) + 1
    assert {row[1:4]: row[4] for row in visits.iter_rows()} == inside

    weights = pl.DataFrame(schema=WEIGHTS)
    units = describe_blocks(blocks, known, visits, weights)
    for row in units.iter_rows(named=True):
        count = sum((row["subset"], row["block"]) == key[:2] for key in inside)
        seconds = (row["last_frame"] - row["first_frame"] + 1) / 10
        assert (row["vehicles"], row["weight"]) == (count, 0)
        assert row["vehicles_per_lane_s"] == pytest.approx(count / 2 / seconds)

    splits = allocate_flow_balanced(units, SplitRecipe("time-blocks", validation=validation, restarts=3)).splits
    SPLITS.validate(splits, where="test")
    part = {(row["subset"], row["block"]): row["part"] for row in splits.iter_rows(named=True)}
    found = find_left_out(visits, splits)
    SPLIT_LEFT_OUT.validate(found, where="test")
    expected = {}
    for name in ("a", "b"):
        for vehicle in range(1, 25):
            stands = {part[key[:2]] for key in inside if (key[0], key[2]) == (name, vehicle)}
            if len(stands) > 1:
                lost = sum(
                    n for key, n in inside.items() if (key[0], key[2]) == (name, vehicle) and part[key[:2]] != "train"
                )
                expected[name, vehicle] = (", ".join(p for p in ("train", "val", "eval") if p in stands), lost)
    assert {row[2:4]: row[4:] for row in found.iter_rows()} == expected


def test_a_subset_cut_into_blocks_may_stand_in_several_parts():
    known, blocks, entries = scene(1)
    frames = pl.DataFrame(
        entries, schema={"subset": pl.String, "vehicle_id": pl.Int32, "frame": pl.Int32}, orient="row"
    )
    visits = pl.concat(find_visits(frames.filter(subset=name), blocks.filter(subset=name)) for name in ("a", "b"))
    weights = blocks.select("dataset", "subset", "block", weight=pl.lit(10, pl.Int64))
    allocation = allocate_flow_balanced(describe_blocks(blocks, known, visits, weights), SplitRecipe("time-blocks"))
    assert allocation.splits.group_by("subset").agg(pl.col("part").n_unique())["part"].max() == 2
    assert allocation.splits.height == blocks.height
    assert allocation.balance["subsets"].to_list() == [2, 2]
    assert allocation.balance["samples"].sum() == 10 * blocks.height


@settings(max_examples=20, deadline=None)
@given(counts=st.lists(st.integers(1, 9), min_size=1, max_size=4), validation=st.booleans(), order=st.randoms())
def test_each_block_is_left_out_of_training_once(counts, validation, order):
    """Recordings of unequal numbers of blocks, in any order of rows."""
    rows = [(f"r{name}", block) for name, count in enumerate(counts) for block in range(count)]
    order.shuffle(rows)
    known = {
        "dataset": "ngsim",
        "site": "S",
        "direction": "south",
        "vehicles": 5,
        "weight": 2,
        "vehicles_per_lane_s": 0.5,
    }
    units = pl.DataFrame(rows, schema={"subset": pl.String, "block": pl.Int32}, orient="row").with_columns(
        **{name: pl.lit(value) for name, value in known.items()},
        first_frame=200 * pl.col("block"),
        last_frame=200 * pl.col("block") + 99,
    )
    seen = []
    for left_out in range(max(counts)):
        allocation = leave_block_out(units, SplitRecipe("time-blocks", validation=validation, eval_block=left_out))
        SPLITS.validate(allocation.splits, where="test")
        assert not allocation.relaxations
        part = {
            (subset, block): own for subset, block, own in allocation.splits.select("subset", "block", "part").rows()
        }
        assert part.keys() == set(rows)
        assert {key for key, own in part.items() if own == "eval"} == {key for key in rows if key[1] == left_out}
        seen += [key for key, own in part.items() if own == "eval"]
        for name, count in enumerate(counts):
            validated = [block for block in range(count) if part[f"r{name}", block] == "val"]
            assert validated == ([(left_out + count // 2) % count] if validation and count > 2 else [])
    assert sorted(seen) == sorted(rows)
    with pytest.raises(UsageError, match=rf"split_eval_block: expected 0 to {max(counts) - 1}.*got {max(counts)}"):
        leave_block_out(units, SplitRecipe("time-blocks", eval_block=max(counts)))


def test_samples_count_where_history_and_least_future_fit():
    # 25 Hz, ticks of 5 Hz: tick k at frame 1 + 5 k; 15 ticks of history, one of future. Blocks 1 to 500, 701 to 1200.
    blocks = cut_blocks(subsets(("a", 1, 1200, 25.0)), block_s=20, purge_s=8)
    assert blocks.select("first_frame", "last_frame").rows() == [(1, 500), (701, 1200)]
    fits = {0: [*range(15, 99)], 1: [*range(155, 239)]}  # 1 + 5 * 98 + 5 = 496; 1 + 5 * 155 - 75 = 701; 1191 + 5
    ticks = pl.DataFrame({"vehicle_id": [2**31 - 1] * 240, "tick": range(240)}, schema_overrides=ENTRY)
    counted = count_samples(ticks, blocks, stride=5.0, first_frame=1, history=75.0, future=5.0)
    assert counted.rows() == [("ngsim", "a", block, 2**31 - 1, len(found)) for block, found in fits.items()]
    # 10 Hz: tick k at 1 + 2.5 k; the last that fits ends at frame 498.5, between two frames.
    (found,) = count_samples(ticks.head(201), blocks, stride=2.5, first_frame=1, history=75.0, future=2.5).rows()
    assert found == ("ngsim", "a", 0, 2**31 - 1, len(range(30, 199)))


def test_empty_tracks_visit_nothing():
    blocks = cut_blocks(subsets(("a", 1, 1200, 25.0)), block_s=20, purge_s=8)
    empty = pl.DataFrame(schema={"vehicle_id": pl.Int32, "frame": pl.Int32})
    assert find_visits(empty, blocks).equals(pl.DataFrame(schema=VISITS))
    one = pl.DataFrame({"vehicle_id": [2**31 - 1], "frame": [701]}, schema=empty.schema)
    assert find_visits(one, blocks).rows() == [("ngsim", "a", 1, 2**31 - 1, 1)]
    purged = pl.DataFrame({"vehicle_id": [1, 1], "frame": [501, 700]}, schema=empty.schema)
    assert find_visits(purged, blocks).is_empty()


def test_parts_count_vehicles_once_and_no_samples_of_those_left_out():
    # Five blocks of one subset. Vehicle 1 is in two of train; 2 in train and eval; 3 in val and eval; 4 in two of eval.
    key = {"dataset": "d", "subset": "a"}
    parts = ["train", "train", "val", "eval", "eval"]
    inside = [(0, 1), (1, 1), (1, 2), (3, 2), (2, 3), (3, 3), (3, 4), (4, 4)]
    rows = [{**key, "block": block, "vehicle_id": vehicle} for block, vehicle in inside]
    visits = pl.DataFrame([{**row, "entries": 9} for row in rows], schema=VISITS)
    # One sample of the first, two of the second, four of the third ...: every sum names its terms.
    weights = pl.DataFrame([{**row, "weight": 2**place} for place, row in enumerate(rows)], schema=WEIGHTS)
    blocks = pl.DataFrame({"block": range(5), "part": parts}, schema={"block": pl.Int32, "part": pl.String})
    known = {"site": "S", "direction": "south", "vehicles_per_lane_s": 0.5, "first_frame": 1, "last_frame": 2}
    units = blocks.drop("part").with_columns(
        **{name: pl.lit(value) for name, value in {**key, **known}.items()}, vehicles=pl.lit(7), weight=pl.lit(7)
    )
    splits = blocks.with_columns(split=pl.lit("time-blocks"), dataset=pl.lit("d"), subset=pl.lit("a"))
    left_out = find_left_out(visits, splits)
    assert left_out["vehicle_id"].to_list() == [2, 3]
    found = recount_blocks(units, splits, left_out, visits, weights)
    expected = [("train", 1, 1), ("train", 1, 2 + 4), ("val", 0, 0), ("eval", 1, 64), ("eval", 0, 128)]
    assert found.select("part", "vehicles", "weight").rows() == expected
    allocation = tabulate_allocation(found, SplitRecipe("time-blocks", validation=True))
    columns = ("part", "vehicles", "vehicle_share", "samples")
    assert {row[0]: row[1:] for row in allocation.balance.select(columns).iter_rows()} == {
        "train": (2, 2 / 3, 7), "val": (0, 0.0, 0), "eval": (1, 1 / 3, 192),
    }  # fmt: skip
    (reason,) = allocation.relaxations.values()
    assert "val without samples" in reason
    assert "train holds 0.667 of the vehicles instead of 0.700" in reason


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_sums_of_recounted_blocks_are_those_of_a_loop(seed):
    known, blocks, entries = scene(seed)
    frames = pl.DataFrame(
        entries, schema={"subset": pl.String, "vehicle_id": pl.Int32, "frame": pl.Int32}, orient="row"
    )
    visits = pl.concat(find_visits(frames.filter(subset=name), blocks.filter(subset=name)) for name in ("a", "b"))
    draw = random.Random(seed)
    weights = visits.select(
        "dataset", "subset", "block", "vehicle_id",
        weight=pl.Series([draw.randint(1, 9) for _ in range(visits.height)], dtype=pl.Int64),
    )  # fmt: skip
    drawn = [draw.choice(["train", "val", "eval"]) for _ in range(blocks.height)]
    splits = blocks.with_columns(split=pl.lit("s"), part=pl.Series(drawn, dtype=pl.String))
    part = {(row["subset"], row["block"]): row["part"] for row in splits.iter_rows(named=True)}
    stands = {}
    for _, name, block, vehicle, _ in visits.iter_rows():
        stands.setdefault((name, vehicle), set()).add(part[name, block])
    vehicles, samples = {}, {}
    for _, name, block, vehicle, weight in weights.iter_rows():
        if part[name, block] == "train" or len(stands[name, vehicle]) == 1:
            vehicles.setdefault(part[name, block], set()).add((name, vehicle))
            samples[name, block] = samples.get((name, block), 0) + weight
    units = describe_blocks(blocks, known, visits, weights)
    found = recount_blocks(
        units, splits, find_left_out(visits, splits), visits, weights.sample(fraction=1, shuffle=True)
    )
    assert found.select("subset", "block").rows() == blocks.select("subset", "block").rows()
    counted = dict(found.group_by("part").agg(pl.col("vehicles").sum()).iter_rows())
    assert counted == {name: len(vehicles.get(name, ())) for name in set(drawn)}
    assert {row[:2]: row[2] for row in found.select("subset", "block", "weight").iter_rows() if row[2]} == samples
    assert found["vehicles_per_lane_s"].to_list() == units["vehicles_per_lane_s"].to_list()
