"""Traffic whose drivers differ: lane changes by hand and by their properties, and what SUMO makes of the settings."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lake_sources import SAMPLE
from raw_texts import read_ngsim

from tracklake.pipeline.synthetic import sumo, write_sample
from tracklake.pipeline.synthetic.build import TRUE_TRACKS_FILE, TRUTH_FILE
from tracklake.pipeline.synthetic.drivers import VARIED, VEHICLE_TYPES, draw_types, draw_waves
from tracklake.pipeline.synthetic.lane_changes import compute_course, draw_courses, move_across
from tracklake.pipeline.synthetic.scenarios import TWO_LANES, Traffic

RATE = 25.0


def crossings(*times, id="a", first=2):
    """Changes of one vehicle between lanes 1 and 2, from lane `first` on."""
    starts = [first if number % 2 == 0 else 3 - first for number in range(len(times))]
    return pl.DataFrame(
        {"id": [id] * len(times), "time": list(map(float, times)), "start": starts, "target": [3 - s for s in starts]}
    )


def drive(changes, seconds, x_mps=30.0):
    """Places of the vehicle of `changes` in SUMO's lanes: it is in the target lane from the crossing on."""
    time = np.round(np.arange(int(seconds * RATE) + 1) / RATE, 5)
    before = np.searchsorted(changes["time"].to_numpy(), time, side="right")
    lanes = np.append(changes["start"].to_numpy()[:1], changes["target"].to_numpy())
    return pl.DataFrame(
        {"id": [changes["id"][0]] * len(time), "time": time, "x": time * x_mps, "number": lanes[before]}
    )


@pytest.mark.parametrize(
    ("part", "lean", "blend", "way"),
    [
        (0, 0.5, 0.3, 0), (1, -0.5, 0.3, 1),
        (0.5, 0, 0, 0.5), (0.25, 0, 0, 0.15625),  # 3/16 - 2/64
        (0.25, 0, 1, 0.103515625),  # 10/64 - 15/256 + 6/1024
        (0.4, 0.1 / 0.24, 0, 0.5), (0.4, 0.1 / 0.24, 1, 0.5),  # its middle is reached after 0.4 of the time
    ],
)  # fmt: skip
def test_courses_by_hand(part, lean, blend, way):
    assert pl.select(compute_course(*(pl.lit(float(each)) for each in (part, lean, blend)))).item() == pytest.approx(
        way
    )


@given(
    st.lists(st.floats(0.5, 20), min_size=1, max_size=5), st.integers(0, 2**31), st.sampled_from([1, 2])
)  # fmt: skip
@settings(max_examples=30, deadline=None)
def test_changes_do_not_overlap_and_end_where_the_simulator_has_the_vehicle(pauses, seed, first):
    changes = crossings(*np.round(8 + np.cumsum(pauses), 2), first=first)
    courses = draw_courses(changes, np.random.default_rng(seed))
    begin, end = courses["begin"].to_numpy(), courses["end"].to_numpy()
    assert (begin < courses["time"].to_numpy()).all()
    assert (end > courses["time"].to_numpy()).all()
    assert (begin[1:] >= end[:-1] - 1e-9).all()
    placed = drive(changes, end[-1] + 1)
    moved = move_across(placed, courses, TWO_LANES, np.random.default_rng(seed))
    inside = moved["change_begin"].is_not_null().to_numpy()
    time, across = moved["time"].to_numpy(), moved["across"].to_numpy()
    within = ((time[:, None] >= begin) & (time[:, None] <= end)).any(axis=1)
    assert (inside == within).all()
    # Beside lane changes it is in its lane, at most 0.42 m aside; it never jumps.
    beside = np.abs(across - (moved["number"].to_numpy() - 1))
    assert beside[~inside].max(initial=0) <= 0.42 / TWO_LANES.lane_width_m + 1e-9
    shortest = (end - begin).min()
    assert np.abs(np.diff(across)).max() < 2.0 * 1.5 / (shortest * RATE) + 0.01
    assert set(moved["change_side"].drop_nulls()) <= {-1, 1}


def test_vehicles_without_changes_and_changes_of_others():
    placed = drive(crossings(5.0, id="b"), 1).with_columns(number=pl.lit(1, pl.Int64))
    random = np.random.default_rng(1)
    for changes in (crossings(5.0), crossings(5.0).clear()):
        moved = move_across(placed, draw_courses(changes, random), TWO_LANES, random)
        assert moved["across"].abs().max() < 0.12
        assert moved["change_side"].null_count() == moved.height


def test_the_same_changes_are_drawn_for_the_same_seed_only():
    changes = pl.concat([crossings(5.0, 30.0), crossings(7.0, id="b")]).sort("time")
    one, again, other = (draw_courses(changes, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.equals(again)
    lasts = one.select("id", lasts=pl.col("end") - pl.col("begin"))
    assert lasts["lasts"].round(6).n_unique() == 2, "a driver has one duration"
    assert not one.equals(other)


@pytest.mark.parametrize("model", VARIED.values())
def test_drawn_drivers_differ_and_keep_their_kind(model):
    types = draw_types(model, np.random.default_rng(3))
    drawn = [ElementTree.fromstring(each.format_xml(0.1)).attrib for each in types]
    assert len({each["id"] for each in drawn}) == len(types)
    assert {each["carFollowModel"] for each in drawn} == {model}
    assert len({each["tau"] for each in drawn}) > 0.7 * len(types)
    for kind in VEHICLE_TYPES:
        own = [each for each in types if each.name.startswith(f"{kind.name}_")]
        assert sum(each.weight for each in own) == pytest.approx(kind.weight)
        assert {each.v_class for each in own} == {kind.v_class}
        assert max(abs(each.length_m / kind.length_m - 1) for each in own) < 0.2
        # SUMO refuses a distribution whose limits are not around its mean.
        assert all(least + spread < mean < most - spread for mean, spread, least, most in (each.speed for each in own))


def test_waves_come_at_random_and_one_after_another():
    waves = draw_waves(2000.0, 25.0, np.random.default_rng(5))
    begin, end, share = waves.T
    assert (begin < end).all()
    assert (begin[1:] - end[:-1] >= 8.0 - 0.02).all()
    assert np.std(np.diff(begin)) > 10
    assert begin[-1] < 2000 < begin[-1] + 500
    assert share.min() >= 0.05
    assert draw_waves(5.0, 25.0, np.random.default_rng(5)).shape == (0, 3)


@pytest.mark.parametrize("drivers", VARIED)
def test_free_traffic_is_as_fast_as_highd(drivers, tmp_path):
    road = TWO_LANES
    tracks = sumo.simulate(sumo.find_sumo(), tmp_path, road, Traffic(0.3, drivers=drivers), frames=1500, seed=2)
    assert tracks["speed"].mean() == pytest.approx(28, abs=1.5)
    assert tracks.group_by("vehicle").agg(pl.col("speed").mean())["speed"].std() > 2
    assert tracks["length"].n_unique() > 15
    assert tracks["lateral_speed"].abs().max() < 3
    assert tracks.select(pl.col("y").diff().abs().over("vehicle").max()).item() < 3 / road.rate_hz
    # SUMO's own motion along the road is untouched.
    moved = tracks.select((pl.col("x").diff().over("vehicle") * road.rate_hz - pl.col("speed")).abs().max()).item()
    assert moved < 0.1


def test_a_varied_sample_lists_its_lane_changes(tmp_path):
    out, seed = tmp_path / "raw", int(SAMPLE[3])
    write_sample(out, formats=("ngsim-csv",), minutes=0.6, seed=seed, traffic="varied-krauss")
    truth, true = (pl.read_parquet(out / name) for name in (TRUTH_FILE, TRUE_TRACKS_FILE))
    changes = truth.filter(kind="lane_change")
    assert changes.height >= 5
    assert set(changes["name"]) == {"left", "right"}
    assert changes["value"].n_unique() > 0.6 * changes.height
    # Every change of lane in the true tracks lies in a listed change to that side, and few lie beyond (at the ends).
    crossed = true.filter(pl.col("lane") <= 6).with_columns(step=pl.col("lane").diff().over("vehicle_id"))
    crossed = crossed.filter(pl.col("step") != 0)
    both = crossed.join(changes, on=["subset", "vehicle_id"]).filter(
        pl.col("frame").is_between(pl.col("first_frame"), pl.col("last_frame")),
        (pl.col("step") > 0) == (pl.col("name") == "right"),
    )
    assert both.height == crossed.height
    assert "varied-krauss traffic" in (out / "README.md").read_text()
    assert read_ngsim(tmp_path, out / "trajectories-us-101-1015.csv")


def test_unknown_traffic_is_refused(command, tmp_path):
    done = command.here("sample", "--out", tmp_path / "out", "--traffic", "heavy", "--quiet")
    assert done.code == 2
    assert not (tmp_path / "out").exists()
