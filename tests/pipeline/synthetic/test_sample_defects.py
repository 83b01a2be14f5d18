"""Noise and injected defects on made-up tracks, each defect against what was declared of it."""

import numpy as np
import polars as pl
import pytest

from tracklake.pipeline.synthetic.defects import inject_defects
from tracklake.pipeline.synthetic.neighbors import find_surroundings
from tracklake.pipeline.synthetic.noise import DRONE, add_noise
from tracklake.pipeline.synthetic.recording_errors import select_recorded_leaders
from tracklake.pipeline.synthetic.scenarios import FREEWAY, TWO_LANES, Plan

RATE = 10.0
NOTHING = Plan(late_starts=0, overlaps=0, backward_share=0, spikes=0, frozen=0, gaps=0)


def platoon(vehicles=40, frames=200, speed=20.0, spacing=20.0):
    """A lane of equally fast vehicles entering one after another; x of the front, 0 to 400 m."""
    rows = []
    for vehicle in range(vehicles):
        for frame in range(1, frames * 3 + 1):
            x = (frame - 1) * speed / RATE - vehicle * spacing + 100.0
            if 0 <= x < 400:
                rows.append((vehicle + 1, frame, x))
    frame = pl.DataFrame(rows, schema={"vehicle": pl.Int32, "frame": pl.Int32, "x": pl.Float64}, orient="row")
    return frame.with_columns(
        y=pl.lit(1.8), speed=pl.lit(speed), accel=pl.lit(0.1), lateral_speed=pl.lit(0.0), lane=pl.lit(1, pl.Int16),
        v_class=pl.lit(2, pl.Int8), length=pl.lit(4.5), width=pl.lit(1.8),
    )  # fmt: skip


def damage(plan, *, tracks=None, seed=1, unseen=False, ramp=None):
    before = platoon() if tracks is None else tracks
    done = inject_defects(
        before,
        plan,
        rate_hz=RATE,
        on_ramp_lane=ramp,
        unseen_leaders=unseen,
        random=np.random.default_rng(seed),
    )
    return before, done


def rows_of(frame, defect):
    return frame.filter(
        (pl.col("vehicle") == defect.vehicle) & pl.col("frame").is_between(defect.first_frame, defect.last_frame)
    )


def test_nothing_is_injected_where_nothing_is_planned():
    before, done = damage(NOTHING)
    assert done.defects == []
    assert done.tracks.drop("lost", "leader_skipped", "headway_error").equals(before)
    assert done.tracks["headway_error"].abs().sum() == done.tracks["leader_skipped"].sum() == 0
    assert not done.tracks["lost"].any()


@pytest.mark.parametrize("seed", range(4))
def test_late_starts_lose_exactly_the_first_part(seed):
    before, done = damage(Plan(late_starts=3, overlaps=0, spikes=0, frozen=0, gaps=0), seed=seed)
    assert [defect.name for defect in done.defects] == ["late_start"] * 3
    for defect in done.defects:
        lost = rows_of(before, defect)
        assert lost.height == defect.entries
        assert rows_of(done.tracks, defect).is_empty()
        kept = done.tracks.filter(pl.col("vehicle") == defect.vehicle)
        assert kept["frame"][0] == defect.last_frame + 1
        assert kept["x"][0] == defect.value
        assert 20 <= defect.value < 202
        assert defect.first_frame > RATE + 1
    assert before.height - done.tracks.height == sum(defect.entries for defect in done.defects)


def test_ramp_vehicles_cannot_start_late():
    tracks = platoon().with_columns(lane=pl.lit(7, pl.Int16))
    _, done = damage(Plan(late_starts=3, overlaps=0, spikes=0, frozen=0, gaps=0), tracks=tracks, ramp=7)
    assert done.defects == []


@pytest.mark.parametrize("seed", range(4))
def test_overlaps_are_as_deep_as_declared(seed):
    _, done = damage(Plan(late_starts=0, overlaps=2, spikes=0, frozen=0, gaps=0), seed=seed)
    assert [defect.name for defect in done.defects] == ["overlap"] * 2
    for defect in done.defects:
        own = done.tracks.filter(pl.col("vehicle") == defect.vehicle)
        leader = done.tracks.filter(pl.col("vehicle") == defect.vehicle - 1)
        both = own.join(leader, on="frame", suffix="_leader").sort("frame")
        both = both.with_columns(gap=pl.col("x_leader") - pl.col("length_leader") - pl.col("x"))
        inside = both.filter(pl.col("gap") < 0)
        assert inside["frame"].to_list() == list(range(defect.first_frame, defect.last_frame + 1))
        assert inside.height == defect.entries
        assert inside["gap"].min() == pytest.approx(-defect.value)
        assert 0.4 <= defect.value <= 2.0
        # It drifts in and out: nothing jumps by more than the car drives in a frame (2 m) and the drift adds (2 m).
        assert own["x"].diff().drop_nulls().is_between(0, 4).all()


def test_an_unseen_leader_is_lost_for_part_of_the_overlap():
    _, done = damage(Plan(late_starts=0, overlaps=2, spikes=0, frozen=0, gaps=0), unseen=True)
    names = [defect.name for defect in done.defects]
    assert names == ["overlap", "frame_gap", "overlap_unseen", "overlap"]
    overlap, gap, unseen, _ = done.defects
    assert gap.vehicle == overlap.vehicle - 1
    assert (unseen.first_frame, unseen.last_frame) == (gap.first_frame, gap.last_frame)
    assert overlap.first_frame == gap.first_frame
    assert gap.entries == max(1, overlap.entries // 2)
    assert rows_of(done.tracks, gap)["lost"].all()
    assert done.tracks["lost"].sum() == gap.entries


def test_spikes_frozen_speeds_and_gaps_stand_where_declared():
    before, done = damage(Plan(late_starts=0, overlaps=0, spikes=3, frozen=3, gaps=3))
    count = {name: [d for d in done.defects if d.name == name] for name in {d.name for d in done.defects}}
    assert {name: len(found) for name, found in count.items()} == {
        "acceleration_spike": 3,
        "frozen_slow_speed": 3,
        "frame_gap": 3,
    }
    hits = {
        "acceleration_spike": pl.col("accel") > 3.05,
        "frozen_slow_speed": (pl.col("speed") <= 1.52) & (pl.col("accel") == 0),
        "frame_gap": pl.col("lost"),
    }
    for name, condition in hits.items():
        assert done.tracks.filter(condition).height == sum(defect.entries for defect in count[name])
        for defect in count[name]:
            assert rows_of(done.tracks, defect).filter(condition).height == defect.entries
    assert len({defect.vehicle for defect in done.defects}) == 9
    assert done.tracks.height == before.height


@pytest.mark.parametrize(("speed", "spacing"), [(20.0, 25.0), (1.0, 8.0)])
def test_backward_share_is_a_greatest_share(speed, spacing):
    tracks = platoon(speed=speed, spacing=spacing)
    vehicles = tracks["vehicle"].n_unique()
    _, done = damage(Plan(late_starts=0, overlaps=0, backward_share=0.1, spikes=0, frozen=0, gaps=0), tracks=tracks)
    backward = done.tracks.filter(pl.col("speed") < 0)
    assert backward["vehicle"].n_unique() == vehicles // 10
    assert backward.height == sum(defect.entries for defect in done.defects)
    assert done.tracks["accel"].max() <= 3.05
    for defect in done.defects:
        assert rows_of(done.tracks, defect)["speed"].min() == defect.value


def test_a_slow_vehicle_rolls_back_in_its_positions_as_well():
    tracks = platoon(speed=1.0, spacing=8.0)
    plan = Plan(late_starts=0, overlaps=0, backward_share=0.1, spikes=0, frozen=0, gaps=0)
    _, done = damage(plan, tracks=tracks)
    for defect in done.defects:
        x = rows_of(done.tracks, defect)["x"].to_numpy()
        assert x[-1] < x[0]


NONE = {"late_starts": 0, "overlaps": 0, "spikes": 0, "frozen": 0, "gaps": 0}


def only(**planned):
    return Plan(**{**NONE, **planned})


def test_skipped_leaders_and_wrong_headways_stand_where_declared():
    before, done = damage(only(wrong_leaders=2, wrong_headways=2))
    leaders, headways = ([d for d in done.defects if d.name == name] for name in ("wrong_leader", "wrong_headway"))
    assert (len(leaders), len(headways)) == (2, 2)
    assert done.tracks["leader_skipped"].sum() == sum(defect.entries for defect in leaders)
    assert (done.tracks["headway_error"] != 0).sum() == sum(defect.entries for defect in headways)
    assert all(rows_of(done.tracks, defect)["leader_skipped"].all() for defect in leaders)
    for defect in headways:
        assert set(rows_of(done.tracks, defect)["headway_error"]) == {defect.value}
        assert 1.5 <= defect.value <= 4.0
    assert done.tracks.select(before.columns).equals(before)
    # Vehicle v follows v - 1 in the lane: recorded is v - 2, wherever the two are there.
    around = find_surroundings(done.tracks)
    recorded = select_recorded_leaders(around.leader, done.tracks)
    vehicle = done.tracks["vehicle"].to_numpy()
    for defect in leaders:
        rows = (vehicle == defect.vehicle) & done.tracks["leader_skipped"].to_numpy()
        assert set(vehicle[recorded[rows]]) == {defect.vehicle - 2}
    untouched = ~done.tracks["leader_skipped"].to_numpy()
    assert (recorded[untouched] == around.leader[untouched]).all()


def test_positions_jump_where_declared():
    before, done = damage(only(jumps=2), tracks=platoon(spacing=60.0))
    assert [defect.name for defect in done.defects] == ["position_jump"] * 2
    moved = done.tracks["x"] - before["x"]
    assert (moved != 0).sum() == sum(defect.entries for defect in done.defects)
    for defect in done.defects:
        steps = (rows_of(done.tracks, defect)["x"] - rows_of(before, defect)["x"]).to_numpy()
        assert steps == pytest.approx(np.full(defect.entries, defect.value))
        assert 2.5 <= defect.value <= 4.0
    # Where vehicles follow each other at 20 m, only those without a leader have room.
    before, done = damage(only(jumps=2))
    assert len(done.defects) == 2
    for defect in done.defects:
        for frame, x in rows_of(before, defect).select("frame", "x").iter_rows():
            assert before.filter((pl.col("frame") == frame) & (pl.col("x") > x)).is_empty()


def test_lanes_flicker_where_declared_and_no_vehicle_is_beside():
    before, done = damage(only(lane_flickers=2))
    assert [(defect.name, defect.value) for defect in done.defects] == [("lane_flicker", 2.0)] * 2
    assert (done.tracks["lane"] == 2).sum() == sum(defect.entries for defect in done.defects)
    for defect in done.defects:
        assert (rows_of(done.tracks, defect)["lane"] == 2).all()
        assert defect.entries <= 2 * RATE
    assert done.tracks["y"].equals(before["y"])
    # Where the other lane is as full, there is no room.
    beside = before.with_columns(vehicle=pl.col("vehicle") + 1000, lane=pl.lit(2, pl.Int16))
    full = pl.concat([before, beside]).sort("vehicle", "frame")
    assert damage(only(lane_flickers=2), tracks=full)[1].defects == []


def test_errors_of_tracking_stand_where_declared():
    plan = only(hard_brakings=1, sideways_speeds=1, size_changes=1, early_ends=2, second_tracks=1)
    before, done = damage(plan)
    found = {defect.name: defect for defect in done.defects}
    assert sorted(defect.name for defect in done.defects) == sorted(["early_end", *found])
    braking, sliding, longer = (found[name] for name in ("hard_braking", "sideways_speed", "size_change"))
    assert set(rows_of(done.tracks, braking)["accel"]) == {braking.value}
    assert (done.tracks["accel"] < -8).sum() == braking.entries
    assert rows_of(done.tracks, sliding)["lateral_speed"].to_list() == [sliding.value] == [4.0]
    assert (done.tracks["lateral_speed"] != 0).sum() == 1
    assert rows_of(done.tracks, longer)["length"].to_list() == pytest.approx([4.5 + longer.value] * longer.entries)
    assert (done.tracks["length"] != 4.5).sum() == longer.entries
    for defect in (defect for defect in done.defects if defect.name == "early_end"):
        track = done.tracks.filter(vehicle=defect.vehicle)
        assert (track["frame"][-1], track["x"][-1]) == (defect.first_frame - 1, defect.value)
        assert before.filter(vehicle=defect.vehicle)["frame"][-1] == defect.last_frame
    second = found["second_track"]
    assert second.vehicle == 41, "there are 40 vehicles"
    copy = done.tracks.filter(vehicle=41)
    original = done.tracks.filter(vehicle=int(second.value)).filter(pl.col("frame") <= second.last_frame)
    assert copy.height == second.entries == original.height
    assert (copy["x"] - original["x"]).to_list() == pytest.approx([-0.3] * copy.height)


def test_too_short_tracks_are_skipped():
    tracks = platoon().filter(pl.col("frame") <= 4)
    _, done = damage(Plan(backward_share=0.5), tracks=tracks)
    assert {defect.name for defect in done.defects} <= {"acceleration_spike"}


def test_the_same_seed_damages_the_same_vehicles():
    plan = Plan(backward_share=0.05)
    assert damage(plan, seed=5)[1].tracks.equals(damage(plan, seed=5)[1].tracks)
    assert damage(plan, seed=5)[1].defects != damage(plan, seed=6)[1].defects


def test_noise_is_small_and_leaves_standing_vehicles_standing():
    tracks = platoon().with_columns(speed=pl.when(pl.col("vehicle") == 3).then(0.0).otherwise(20.0))
    noisy = add_noise(tracks, TWO_LANES, DRONE, ("smooth",), np.random.default_rng(1))
    error = (noisy["x"] - tracks["x"]).to_numpy()
    assert 0.015 < error.std() < 0.025
    assert (noisy.filter(pl.col("vehicle") == 3)["speed"] == 0).all()
    assert noisy["accel"].max() < 3.05
    assert noisy.columns == tracks.columns


def test_noise_makes_no_slow_speed_constant():
    tracks = platoon().with_columns(speed=pl.lit(1.0), accel=pl.lit(0.0))
    noisy = add_noise(tracks, TWO_LANES, DRONE, ("smooth",), np.random.default_rng(1))
    assert (noisy["accel"].abs().round(2) > 0).all()


def test_noise_keeps_ramp_vehicles_on_the_ramp():
    tracks = platoon().with_columns(lane=pl.lit(7, pl.Int16), y=pl.lit(6.5 * FREEWAY.lane_width_m))
    assert add_noise(tracks, FREEWAY, DRONE, ("smooth",), np.random.default_rng(1))["lane"].unique().to_list() == [7]
