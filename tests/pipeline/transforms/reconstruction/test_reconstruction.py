import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded import MAX_ID, make_tracks, make_vehicles, run_reconstruction

from tracklake.pipeline.transforms.reconstruction.config import BOUNDS, ReconstructionConfig


def test_constant_motion_stays_as_it_is():
    tracks = make_tracks((7, range(50), np.arange(50) * 2.0))
    done = run_reconstruction(tracks)
    np.testing.assert_allclose(done.entries["x_m"], tracks["x_m"], atol=1e-6)
    np.testing.assert_allclose(done.entries["speed_mps"], 20.0, atol=1e-4)
    np.testing.assert_allclose(done.entries["moved_m"], 0.0, atol=1e-6)
    assert not done.entries["constrained"].any()
    assert done.skips.is_empty()
    assert done.quality["bounds_not_kept"].item() == 0


def test_gaps_of_two_seconds_are_filled_and_longer_ones_are_not():
    frames = [*range(10), *range(29, 40), *range(60, 70)]
    done = run_reconstruction(make_tracks((1, frames, np.array(frames) * 1.0)))
    assert done.entries["frame"].to_list() == [*range(40), *range(60, 70)]
    assert done.entries.filter("imputed")["frame"].to_list() == list(range(10, 29))
    np.testing.assert_allclose(done.entries["x_m"], done.entries["frame"], atol=1e-6)
    np.testing.assert_allclose(done.entries["time_s"], done.entries["frame"] / 10)
    assert done.entries["moved_m"].null_count() == 19
    assert done.quality.select("entries", "imputed_entries").row(0) == (31, 19)


def test_bad_tracks_are_skipped_with_a_counted_reason():
    tracks = make_tracks(
        (1, [5], [1.0]),
        (2, range(0, 40, 2), np.arange(20.0)),
        (3, [1, 2, 3], [1.0, 2.0, 3.0]),
        (4, [*range(8), 60, 61], np.arange(10.0)),
    )
    done = run_reconstruction(tracks)
    assert done.entries["vehicle_id"].unique().to_list() == [4]
    assert done.entries["frame"].to_list() == list(range(8))
    found = {row["reason"]: (row["vehicles"], row["entries"]) for row in done.skips.iter_rows(named=True)}
    assert found == {"one_entry": (1, 1), "constant_gaps": (1, 20), "too_few_entries": (2, 5)}
    assert done.quality.select("vehicles", "vehicles_reconstructed").row(0) == (4, 1)


def test_arterials_are_skipped():
    done = run_reconstruction(make_tracks((1, range(20), np.arange(20.0))), freeway=False)
    assert done.entries.is_empty()
    assert done.skips["reason"].to_list() == ["arterial"]
    assert done.quality["noise_x_m"].item() is None


def test_an_empty_frame_gives_empty_tables():
    done = run_reconstruction(make_tracks((1, [], [])))
    assert done.entries.is_empty()
    assert done.skips.is_empty()
    assert done.quality["vehicles"].item() == 0


@settings(max_examples=25, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 30), min_size=1, max_size=4),
    seed=st.integers(0, 1000),
    rate_hz=st.sampled_from([10.0, 25.0, 30.0]),
)
def test_order_of_rows_does_not_matter(sizes, seed, rate_hz):
    random = np.random.default_rng(seed)
    ids = [0, 1, MAX_ID - 1, MAX_ID]
    vehicles = []
    for vehicle, size in zip(ids, sizes, strict=False):
        frames = np.sort(random.choice(size + size // 4, size, replace=False))
        vehicles.append((vehicle, frames, frames * 20 / rate_hz + random.normal(0, 0.05, size)))
    tracks = make_tracks(*vehicles, rate_hz=rate_hz)
    done = run_reconstruction(tracks, rate_hz=rate_hz)
    shuffled = run_reconstruction(
        tracks.sample(fraction=1.0, shuffle=True, seed=seed), make_vehicles(tracks), rate_hz=rate_hz
    )
    for name in ("entries", "quality", "skips", "unkept"):
        assert getattr(done, name).equals(getattr(shuffled, name))
    kept = done.entries.filter(~pl.col("imputed")).height
    assert kept + done.skips["entries"].sum() == tracks.height


def check_bounds(done, rate_hz, bounds=BOUNDS["car"]):
    """Check every written entry against the bounds, one track after the other, from the written positions."""
    unkept = {(row["vehicle_id"], row["bound"]) for row in done.unkept.iter_rows(named=True)}
    for track in done.entries.partition_by("vehicle_id"):
        x, frame = track["x_m"].to_list(), track["frame"].to_list()
        vehicle = track["vehicle_id"][0]
        for i in range(1, len(x) - 1):
            if frame[i + 1] - frame[i - 1] != 2:
                continue
            assert x[i + 1] >= x[i] >= x[i - 1] or (vehicle, "backward") in unkept
            speed = (x[i + 1] - x[i - 1]) * rate_hz / 2
            assert abs(track["speed_mps"][i] - speed) < 1e-3
        for speed, accel in track.select("speed_mps", "accel_mps2").iter_rows():
            fallen = bounds.accel_at_rest_mps2 - bounds.accel_fall_per_s * max(speed, 0)
            assert speed >= 0 or (vehicle, "backward") in unkept
            assert accel <= max(fallen, bounds.least_accel_mps2) + 1e-4 or (vehicle, "acceleration") in unkept
            assert accel >= -bounds.braking_mps2 - 1e-4 or (vehicle, "deceleration") in unkept


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 1000),
    rate_hz=st.sampled_from([10.0, 25.0, 30.0]),
    noise_m=st.sampled_from([0.0, 0.1, 1.0]),
    speed_mps=st.sampled_from([0.0, 0.5, 12.0, 40.0]),
)
def test_all_bounds_hold_whatever_was_recorded(seed, rate_hz, noise_m, speed_mps):
    random = np.random.default_rng(seed)
    frames = np.flatnonzero(random.random(90) < 0.9)
    x = frames / rate_hz * speed_mps + random.normal(0, noise_m, frames.size) + 3.0 * (frames > 45)
    done = run_reconstruction(make_tracks((3, frames, x), rate_hz=rate_hz), rate_hz=rate_hz)
    check_bounds(done, rate_hz)
    assert done.unkept.is_empty()


def test_a_vehicle_recorded_backward_stands_still():
    time_s = np.arange(100) / 10
    x = np.where(time_s < 5, 10 * time_s - time_s**2, 25 - 0.4 * np.minimum(time_s - 5, 1))
    done = run_reconstruction(make_tracks((1, range(100), x)))
    assert done.entries["speed_mps"].min() >= 0
    assert done.entries.filter("constrained").height > 10
    assert done.quality["constrained_entries"].item() == done.entries["constrained"].sum()
    assert done.entries["x_m"][-20:].is_between(24.6, 25.0).all()


def test_a_truck_accelerates_less_than_a_car():
    time_s = np.arange(80) / 10
    tracks = make_tracks((1, range(80), 1.7 * np.maximum(time_s - 2, 0) ** 2))
    fastest = {}
    for kind, bounds in (("car", BOUNDS["car"]), ("truck", BOUNDS["truck"]), (None, BOUNDS["car"])):
        done = run_reconstruction(tracks, make_vehicles(tracks, kind=kind))
        check_bounds(done, 10.0, bounds)
        fastest[kind] = done.entries["accel_mps2"].max()
    assert fastest["car"] > 3.0
    assert fastest["truck"] <= 2.7
    assert fastest[None] == fastest["car"]


def measure_gaps(done, follower, leader, length_m=4.0):
    x = dict(done.entries.filter(vehicle_id=leader).select("frame", "x_m").iter_rows())
    own = done.entries.filter(vehicle_id=follower).select("frame", "x_m").iter_rows()
    return [x[frame] - length_m - position for frame, position in own if frame in x]


def test_followers_keep_behind_their_leaders_which_are_solved_first():
    time_s = np.arange(120) / 10
    bump = 3.0 * np.exp(-(((time_s - 6) / 1.5) ** 2))
    first, second, third = 50 + 8 * time_s, 44 + 8 * time_s + bump, 38 + 8 * time_s + bump / 2
    tracks = make_tracks((9, range(120), first, None), (5, range(120), second, 9), (1, range(120), third, 5))
    done = run_reconstruction(tracks)
    assert done.unkept.is_empty()
    assert min(measure_gaps(done, 5, 9)) > 0
    assert min(measure_gaps(done, 1, 5)) > 0
    np.testing.assert_allclose(done.entries.filter(vehicle_id=9)["x_m"], first, atol=0.01)
    unknown = run_reconstruction(tracks, make_vehicles(tracks, length_m=None))
    assert min(measure_gaps(unknown, 5, 9)) < 0
    assert unknown.skips.select("reason", "vehicles", "entries").rows() == [("no_length", 2, 240)]


def test_overlaps_that_motion_cannot_avoid_are_listed():
    frames, time_s = range(60), np.arange(60) / 10
    leader, follower = 20 + 0 * time_s, 10 + 10 * np.minimum(time_s, 0.9)
    tracks = make_tracks((1, frames, leader, 2), (2, frames, follower, 1))
    done = run_reconstruction(tracks)
    check_bounds(done, 10.0)
    found = done.unkept.filter(bound="overlap")
    assert found["vehicle_id"].to_list() == [1]
    assert found["entries"].item() == 60
    assert found["worst"].item() < -4


def test_overlaps_of_vehicles_that_are_not_recorded_as_leader_and_follower_are_listed():
    frames, way = range(30), np.arange(30.0)
    tracks = make_tracks((1, frames, 100 + way), (2, frames, 97 + way))
    found = run_reconstruction(tracks).unkept
    assert found.select("vehicle_id", "bound", "first_frame", "entries").rows() == [(2, "overlap", 0, 30)]
    assert found["worst"].item() == pytest.approx(100 - 97 - 4)

    def move(sideways_m):
        return tracks.with_columns(y_m=pl.col("y_m") + sideways_m * (pl.col("vehicle_id") == 2))

    assert run_reconstruction(move(2.0)).unkept.is_empty()
    assert run_reconstruction(move(1.5)).unkept["worst"].item() == pytest.approx(-0.3, abs=1e-3)
    unknown = make_vehicles(tracks).with_columns(width_m=pl.lit(None, pl.Float64))
    assert run_reconstruction(move(2.0), unknown).unkept.height == 1
    other_lane = pl.when(pl.col("vehicle_id") == 2).then(2).otherwise(1).cast(pl.Int16)
    assert run_reconstruction(move(2.0).with_columns(lane=other_lane), unknown).unkept.is_empty()


def test_overlaps_beyond_a_vehicle_in_another_lane_are_found():
    """By position, the vehicle beside them comes between the two."""
    frames, way = range(30), np.arange(30.0)
    tracks = make_tracks((1, frames, 100 + way), (2, frames, 97 + way), (3, frames, 98 + way))
    beside = tracks.with_columns(y_m=pl.col("y_m") + 3.6 * (pl.col("vehicle_id") == 3))
    found = run_reconstruction(beside).unkept
    assert found.select("vehicle_id", "entries", "worst").rows() == [(2, 30, pytest.approx(-1.0))]


def test_a_recording_without_lanes_is_smoothed_and_says_what_is_left_out():
    tracks = make_tracks((1, range(40), np.arange(40.0))).with_columns(lane=pl.lit(None, pl.Int16))
    done = run_reconstruction(tracks)
    assert done.entries.height == 40
    assert done.skips.select("reason", "vehicles", "entries").rows() == [("no_lanes", 1, 40)]
    assert "overlaps" in done.skips["left_out"].item()


def test_lane_changes_go_one_way_with_bounded_acceleration():
    random = np.random.default_rng(2)
    time_s = np.arange(300) / 10
    share = np.clip((time_s - 13) / 4, 0, 1)
    y = 2 + 3.6 * (3 * share**2 - 2 * share**3) + random.normal(0, 0.15, 300)
    tracks = make_tracks((1, range(300), 20 * time_s)).with_columns(
        y_m=pl.Series(y), lane=pl.Series(np.where(time_s < 15, 1, 2), dtype=pl.Int16)
    )
    done = run_reconstruction(tracks)
    smoothed = done.entries["y_m"].to_numpy()
    assert (np.diff(smoothed[135:166]) >= -1e-6).all()
    assert np.abs(smoothed - (2 + 3.6 * (3 * share**2 - 2 * share**3))).max() < 0.3
    jumped = tracks.with_columns(y_m=pl.when(pl.col("lane") == 1).then(1.8).otherwise(5.4))
    strict = run_reconstruction(jumped, config=ReconstructionConfig(lateral_accel_mps2=1.5, weight_y_s6=1e-4))
    lateral = np.diff(strict.entries["y_m"].to_numpy(), 2) * 100
    assert np.abs(lateral).max() <= 1.5
    assert strict.unkept.is_empty()
    assert (np.diff(strict.entries["y_m"].to_numpy())[112:188] >= -1e-6).all()


def test_the_noise_can_be_set():
    tracks = make_tracks((1, range(80), np.arange(80) + np.random.default_rng(0).normal(0, 0.1, 80)))
    done = run_reconstruction(tracks, config=ReconstructionConfig(noise_x_m=0.2, noise_y_m=0.1, weight_x_s6=0.03))
    row = done.quality.row(0, named=True)
    assert (row["noise_x_m"], row["noise_y_m"], row["weight_x_s6"]) == (0.2, 0.1, 0.03)
    assert row["noise_is_set"]


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 30.0])
@pytest.mark.parametrize("kind", ["car", "truck"])
def test_bounds_are_kept_at_any_frame_rate_beside_a_track_of_nonsense(rate_hz, kind):
    rng = np.random.default_rng(2)
    t = np.arange(30 * int(rate_hz)) / rate_hz
    start = np.cumsum(np.clip(4 * (t - 5), 0, 30)) / rate_hz + rng.normal(0, 0.2, len(t))
    nonsense = rng.uniform(0, 500, len(t))
    tracks = make_tracks((1, range(len(t)), start), (2, range(len(t)), nonsense), rate_hz=rate_hz)
    done = run_reconstruction(tracks, make_vehicles(tracks, kind=kind), rate_hz)
    assert done.unkept.filter(pl.col("bound") != "overlap").is_empty()
    assert (done.entries["speed_mps"] >= 0).all()


def test_a_follower_behind_a_leader_keeps_the_acceleration_of_its_speed():
    t = np.arange(400) / 10
    tracks = make_tracks((1, range(400), 200 + 3 * t), (2, range(400), 100 + 10 * t, 1))
    done = run_reconstruction(tracks)
    assert done.unkept["bound"].unique().to_list() == ["overlap"]


def test_a_piece_of_impossible_speed_is_skipped_and_spares_the_others():
    tracks = make_tracks((1, range(50), 2.0 * np.arange(50)), (2, range(4), [0.0, 100.0, 101.0, 102.0]))
    done = run_reconstruction(tracks)
    assert done.entries["vehicle_id"].unique().to_list() == [1]
    assert done.skips.select("reason", "vehicles", "entries").rows() == [("out_of_range", 1, 4)]
    assert done.quality.select("vehicles_reconstructed", "entries").row(0) == (1, 50)
    assert done.unkept.is_empty()
