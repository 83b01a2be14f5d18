"""What parts share, counted by SQL, against loops over small scenes; and that a planted leak stops the stage."""

import itertools
import math
import random

import duckdb
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.stages.split_leakage import Leakage, measure_leakage, refuse_leaks
from tracklake.pipeline.stages.stage import StageError
from tracklake.schemas import (
    NEIGHBORS,
    SAMPLES,
    SPLIT_CONTEXT,
    SPLIT_LEAKAGE,
    SPLIT_LEFT_OUT,
    SPLIT_SHIFTS,
    SPLITS,
    TRACKS,
)
from tracklake.schemas.columns import PARTS
from tracklake.schemas.split_recipes import SplitRecipe

FRAME_RATE_HZ = 5.0
"""On a clock of 2 Hz tick k lies at frame 1 + 2.5 k: every other one between two frames."""
RECIPE = SplitRecipe("time-blocks", rate_hz=2, history_s=1.0, horizon_s=2.0, min_future_s=0.5)
HISTORY_FRAMES, FUTURE_FRAMES = 5.0, 2.5
NAMES = ("a", "b")
SUBSETS = pl.DataFrame(
    {
        "dataset": ["highd", "highd"],
        "subset": NAMES,
        "frame_rate_hz": [FRAME_RATE_HZ] * 2,
        "subset_first_frame": [1, 1],
        "vehicles_per_lane_s": [0.2, 0.4],
    }
)


def fill(table, rows):
    return pl.DataFrame([{**dict.fromkeys(table.dtypes), **row} for row in rows], schema=table.dtypes)


def make_scene(seed):
    """Tracks, samples and neighbors of two subsets: a few vehicles for 40 frames."""
    draw = random.Random(seed)
    tracks, samples, neighbors = [], [], []
    for subset in NAMES:
        here = {"dataset": "highd", "subset": subset}
        for vehicle in range(1, 7):
            first = draw.randint(1, 25)
            tracks += [
                {**here, "vehicle_id": vehicle, "frame": frame, "speed_mps": draw.randint(0, 5) / 4}
                for frame in range(first, first + draw.randint(5, 20))
                if draw.random() < 0.9
            ]
        for vehicle, tick in itertools.product(range(1, 7), range(16)):
            if draw.random() < 0.4:
                lateral, longitudinal = draw.choice(["keep", "left", "right"]), draw.choice(["normal", "brake"])
                samples.append({**here, "protocol": "p", "vehicle_id": vehicle, "tick": tick, "lane": 1,
                                "lateral_maneuver": lateral, "longitudinal_maneuver": longitudinal})  # fmt: skip
                for cell, beside in enumerate(
                    draw.sample([v for v in range(1, 7) if v != vehicle], draw.randint(0, 3))
                ):
                    neighbors.append({**here, "protocol": "p", "vehicle_id": vehicle, "tick": tick, "cell": cell,
                                      "neighbor_id": beside, "dx_m": 1.0})  # fmt: skip
    other = [{**samples[0], "protocol": "another"}]
    return tracks, samples + other, neighbors


def make_split(kind, seed):
    """Rows of `splits` (subset, block, first, last, first id, last id, part), and (subset, vehicle) left out."""
    draw = random.Random(seed)
    if kind == "whole":
        return [("a", 0, 1, 60, None, None, "train"), ("b", 0, 1, 60, None, None, "eval")], set()
    if kind == "by id":
        return [
            (name, block, 1, 60, 1 + 2 * block, 2 + 2 * block, part)
            for name in NAMES
            for block, part in enumerate(PARTS)
        ], set()
    cut = draw.randint(10, 30)
    purge = draw.randint(0, 6)
    rows = [
        (name, block, first, last, None, None, draw.choice(PARTS))
        for name in NAMES
        for block, (first, last) in enumerate([(1, cut), (cut + purge + 1, 60)])
    ]
    return rows, {(name, vehicle) for name in NAMES for vehicle in range(1, 7) if draw.random() < 0.2}


def expect(scene, split):
    """Everything that `measure` counts, one thing at a time."""
    (tracks, samples, neighbors), (rows, left_out) = scene, split

    def block_of(subset, vehicle, begins, ends):
        for number, (name, _, first, last, first_id, last_id, part) in enumerate(rows):
            inside = first - 1e-9 <= begins and ends <= last + 1e-9
            known = (first_id is None or vehicle >= first_id) and (last_id is None or vehicle <= last_id)
            missing = part != "train" and (subset, vehicle) in left_out
            if name == subset and inside and known and not missing:
                return number, part
        return None, None

    def sample_part(row):
        at = 1 + 2.5 * row["tick"]
        return block_of(row["subset"], row["vehicle_id"], at - HISTORY_FRAMES, at + FUTURE_FRAMES)

    vehicles, frames, scenes = ({part: set() for part in PARTS} for _ in range(3))
    speeds, rates, left, right, brake = ({part: [] for part in PARTS} for _ in range(5))
    for row in tracks:
        part = block_of(row["subset"], row["vehicle_id"], row["frame"], row["frame"])[1]
        if part is not None:
            vehicles[part].add((row["subset"], row["vehicle_id"]))
            frames[part].add((row["subset"], row["frame"]))
            speeds[part].append(row["speed_mps"])
    given_samples = dict.fromkeys(PARTS, 0)
    for row in samples:
        number, part = sample_part(row)
        if part is not None and row["protocol"] == "p":
            scenes[part].add((row["subset"], row["tick"]))
            given_samples[part] += 1
            rates[part].append({"a": 0.2, "b": 0.4}[row["subset"]])
            left[part].append(float(row["lateral_maneuver"] == "left"))
            right[part].append(float(row["lateral_maneuver"] == "right"))
            brake[part].append(float(row["longitudinal_maneuver"] == "brake"))
    context = dict.fromkeys(itertools.product(PARTS, [*PARTS, None]), 0)
    elsewhere = dict.fromkeys(PARTS, 0)
    for row in neighbors:
        number, part = sample_part(row)
        at = 1 + 2.5 * row["tick"]
        beside, its_part = block_of(row["subset"], row["neighbor_id"], at, at)
        if part is not None:
            context[part, its_part] += 1
            elsewhere[part] += its_part is not None and beside != number
    # As the table rounds them: to 0.1 m/s, halves away from zero.
    speeds = {part: [math.floor(10 * value + 0.5) / 10 for value in values] for part, values in speeds.items()}
    values = {"vehicles_per_lane_s": rates, "speed": speeds, "left": left, "right": right, "brake": brake}
    return vehicles, frames, scenes, context, elsewhere, given_samples, values


def cumulative_shift(one, other):
    return max(
        abs(sum(v <= at for v in one) / len(one) - sum(v <= at for v in other) / len(other)) for at in {*one, *other}
    )


def run(scene, split):
    (tracks, samples, neighbors), (rows, left_out) = scene, split
    splits = pl.DataFrame([("time-blocks", "highd", *row) for row in rows], schema=SPLITS.dtypes, orient="row")
    missing = [("time-blocks", "highd", name, vehicle, "train, eval", 1) for name, vehicle in sorted(left_out)]
    with duckdb.connect(":memory:") as connection:
        for table, given_rows in ((TRACKS, tracks), (SAMPLES, samples), (NEIGHBORS, neighbors)):
            connection.register(table.name, fill(table, given_rows))
        found = measure_leakage(
            connection,
            splits,
            pl.DataFrame(missing, schema=SPLIT_LEFT_OUT.dtypes, orient="row"),
            SUBSETS,
            recipe=RECIPE,
            protocol="p",
        )
    SPLIT_LEAKAGE.validate(found.leakage, where="test")
    SPLIT_CONTEXT.validate(found.context, where="test")
    SPLIT_SHIFTS.validate(found.shifts, where="test")
    return found


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.sampled_from(["whole", "by id", "in time"]))
def test_counts_equal_a_loop_over_entries_samples_and_neighbors(seed, kind):
    scene, split = make_scene(seed), make_split(kind, seed)
    found = run(scene, split)
    vehicles, frames, scenes, context, elsewhere, given_samples, values = expect(scene, split)
    parts = [part for part in PARTS if part in {row[-1] for row in split[0]}]
    pairs = list(itertools.combinations(parts, 2))
    assert {(row["part"], row["other_part"]) for row in found.leakage.iter_rows(named=True)} == set(pairs)
    for row in found.leakage.iter_rows(named=True):
        one, other = row["part"], row["other_part"]
        for name, held in (("vehicles", vehicles), ("frames", frames), ("scenes", scenes)):
            assert (row[f"{name}_shared"], row[name]) == (len(held[one] & held[other]), len(held[other])), name
        assert row["context_shared"] == context[one, other] + context[other, one]
        assert row["context"] == sum(count for (part, _), count in context.items() if part in (one, other))
        apart = [abs(a - b) / FRAME_RATE_HZ for s, a in frames[one] for t, b in frames[other] if s == t]
        assert row["nearest_s"] == (pytest.approx(min(apart)) if apart else None)
    for row in found.context.iter_rows(named=True):
        assert row["samples"] == given_samples[row["part"]]
        assert row["neighbors"] == sum(context[row["part"], other] for other in (*PARTS, None))
        assert row["neighbors_elsewhere"] == elsewhere[row["part"]]
        assert row["neighbors_left_out"] == context[row["part"], None]
    assert set(found.context["part"]) == {part for part in PARTS if given_samples[part]}
    compared = {(row["part"], row["other_part"], row["quantity"]): row for row in found.shifts.iter_rows(named=True)}
    wanted = {(*pair, name) for pair in pairs for name, of in values.items() if of[pair[0]] and of[pair[1]]}
    assert set(compared) == wanted
    for (one, other, name), row in compared.items():
        a, b = values[name][one], values[name][other]
        assert row["shift"] == pytest.approx(cumulative_shift(a, b), abs=1e-8)
        assert (row["mean"], row["other_mean"]) == pytest.approx((sum(a) / len(a), sum(b) / len(b)), abs=1e-6)
        deviation = math.sqrt(sum((v - sum(a) / len(a)) ** 2 for v in a) / len(a))
        assert row["std"] == pytest.approx(deviation, abs=1e-6)


def a_row(**values):
    nothing = {name: 0 for name in SPLIT_LEAKAGE.dtypes if name not in ("split", "dataset", "part", "other_part")}
    row = {"split": "s", "dataset": "highd", "part": "train", "other_part": "eval", **nothing, "nearest_s": None}
    return Leakage(fill(SPLIT_LEAKAGE, [{**row, **values}]), SPLIT_CONTEXT.empty(), SPLIT_SHIFTS.empty())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"vehicles_shared": 3}, "train and eval share 3 vehicles"),
        ({"frames_shared": 1200}, "share 1,200 frames"),
        ({"scenes_shared": 2}, "share 2 scenes"),
        ({"context_shared": 1}, "share 1 neighbors"),
        ({"nearest_s": 7.96}, "share entries 7.96 s apart, expected at least 8 s"),
    ],
)
def test_whatever_is_shared_stops_a_split_that_claims_otherwise(values, message):
    for name in ("flow-balanced", "time-blocks", "by-recording-random"):
        with pytest.raises(StageError, match=f"split {name} claims .*{message}.*No split was written"):
            refuse_leaks({SplitRecipe(name): a_row(**values)})
    refuse_leaks({SplitRecipe("csp-2018"): a_row(**values)})


def test_nothing_shared_and_far_enough_apart_passes():
    refuse_leaks({SplitRecipe("time-blocks"): a_row(nearest_s=8.04, vehicles=5, frames=9, scenes=4, context=7)})
    assert a_row(nearest_s=8.0).find_leaks(8.0) == []


def test_parts_that_never_meet_are_compared_all_the_same():
    scene = make_scene(3)
    found = run(scene, make_split("whole", 0))
    (row,) = found.leakage.iter_rows(named=True)
    assert row["nearest_s"] is None
    assert (row["vehicles_shared"], row["frames_shared"], row["scenes_shared"], row["context_shared"]) == (0, 0, 0, 0)
    assert row["vehicles"] == 6
    (rate,) = found.shifts.filter(pl.col("quantity") == "vehicles_per_lane_s").iter_rows(named=True)
    assert (rate["mean"], rate["other_mean"], rate["std"], rate["shift"]) == (0.2, 0.4, 0.0, 1.0)
