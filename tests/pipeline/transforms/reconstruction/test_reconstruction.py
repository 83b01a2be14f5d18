import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.reconstruction import Reconstruction, reconstruct
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, differentiate, make_penalty, smooth
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

MAX_ID = 2**31 - 1


def make_facts(rate_hz=10.0, **others):
    return {"dataset": "custom", "subset": "s", "frame_rate_hz": rate_hz, "first_frame": 0, "freeway": True, **others}


def make_tracks(*vehicles, rate_hz=10.0):
    """Each vehicle is (id, frames, x_m) or (id, frames, x_m, leader_id)."""
    parts = [
        pl.DataFrame(
            {"vehicle_id": vehicle, "frame": list(frames), "x_m": x, "leader_id": leader[0] if leader else None}
        )
        for vehicle, frames, x, *leader in vehicles
    ]
    return pl.concat(
        [
            part.select(
                pl.col("vehicle_id", "frame", "leader_id").cast(pl.Int32),
                pl.col("x_m").cast(pl.Float64),
                time_s=pl.col("frame") / rate_hz,
                y_m=pl.lit(2.0),
                lane=pl.lit(1, pl.Int16),
            )
            for part in parts
        ]
    )


def make_vehicles(tracks, length_m=4.0, kind="car"):
    return tracks.select(pl.col("vehicle_id").unique().sort()).with_columns(
        pl.lit(kind, pl.String).alias("class"),
        length_m=pl.lit(length_m, pl.Float32),
        width_m=pl.lit(1.8, pl.Float32),
    )


def run(tracks, vehicles=None, rate_hz=10.0, config=None, **facts) -> Reconstruction:
    vehicles = make_vehicles(tracks) if vehicles is None else vehicles
    done = reconstruct(tracks, vehicles, make_facts(rate_hz, **facts), config or ReconstructionConfig())
    for table, frame in (
        (RECONSTRUCTED, done.entries),
        (RECONSTRUCTION_QUALITY, done.quality),
        (RECONSTRUCTION_SKIPS, done.skips),
        (UNKEPT_BOUNDS, done.unkept),
    ):
        table.validate(frame, where="test")
    return done


@pytest.mark.parametrize("rate_hz", [10.0, 25.0])
def test_smoothing_solves_the_normal_equations_of_each_piece(rate_hz):
    random = np.random.default_rng(1)
    sizes = np.array([4, 9, 15])
    series = Series(np.cumsum(sizes) - sizes, sizes, rate_hz)
    z, w, weight = random.normal(500, 10, sizes.sum()), random.uniform(0.1, 1, sizes.sum()), 1e-3
    w[6] = 0.0
    x = smooth(make_penalty(series, weight), z, w)
    for first, size in zip(series.first, sizes, strict=True):
        own = slice(first, first + size)
        third = np.diff(np.eye(size), 3, axis=0) * rate_hz**3
        expected = np.linalg.solve(np.diag(w[own]) + weight * third.T @ third, w[own] * z[own])
        np.testing.assert_allclose(x[own], expected, atol=1e-6)


def test_the_weight_means_the_same_at_any_frame_rate():
    smoothed = {}
    for rate_hz in (10, 25):
        time_s = np.arange(20 * rate_hz + 1) / rate_hz
        series = Series(np.array([0]), np.array([time_s.size]), float(rate_hz))
        x = smooth(make_penalty(series, 0.05), np.sin(2 * np.pi * 0.25 * time_s), np.ones(time_s.size))
        smoothed[rate_hz] = np.interp([8.0, 9.0, 10.0, 11.0, 12.0], time_s, x)
    np.testing.assert_allclose(smoothed[10], smoothed[25], atol=0.01)
    share = 1 / (1 + 0.05 * (2 * np.pi * 0.25) ** 6)
    np.testing.assert_allclose(smoothed[25], share * np.sin(2 * np.pi * 0.25 * np.arange(8, 13)), atol=0.02)


def test_speed_and_acceleration_are_central_differences_that_go_on_as_a_parabola():
    series = Series(np.array([0, 5]), np.array([5, 5]), 10.0)
    time_s = np.arange(5) / 10
    x = np.concatenate([3 + 2 * time_s + 0.5 * 1.5 * time_s**2, 100 - 1.0 * time_s])
    speed, accel = differentiate(series, x)
    np.testing.assert_allclose(speed, np.concatenate([2 + 1.5 * time_s, np.full(5, -1.0)]))
    np.testing.assert_allclose(accel, np.repeat([1.5, 0.0], 5), atol=1e-10)


def test_constant_motion_stays_as_it_is():
    tracks = make_tracks((7, range(50), np.arange(50) * 2.0))
    done = run(tracks)
    np.testing.assert_allclose(done.entries["x_m"], tracks["x_m"], atol=1e-6)
    np.testing.assert_allclose(done.entries["speed_mps"], 20.0, atol=1e-4)
    np.testing.assert_allclose(done.entries["moved_m"], 0.0, atol=1e-6)
    assert not done.entries["constrained"].any()
    assert done.skips.is_empty()
    assert done.quality["bounds_not_kept"].item() == 0


def test_gaps_of_two_seconds_are_filled_and_longer_ones_are_not():
    frames = [*range(10), *range(29, 40), *range(60, 70)]
    done = run(make_tracks((1, frames, np.array(frames) * 1.0)))
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
    done = run(tracks)
    assert done.entries["vehicle_id"].unique().to_list() == [4]
    assert done.entries["frame"].to_list() == list(range(8))
    found = {row["reason"]: (row["vehicles"], row["entries"]) for row in done.skips.iter_rows(named=True)}
    assert found == {"one_entry": (1, 1), "constant_gaps": (1, 20), "too_few_entries": (2, 5)}
    assert done.quality.select("vehicles", "vehicles_reconstructed").row(0) == (4, 1)


def test_arterials_are_skipped():
    done = run(make_tracks((1, range(20), np.arange(20.0))), freeway=False)
    assert done.entries.is_empty()
    assert done.skips["reason"].to_list() == ["arterial"]
    assert done.quality["noise_x_m"].item() is None


def test_an_empty_frame_gives_empty_tables():
    done = run(make_tracks((1, [], [])))
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
    done = run(tracks, rate_hz=rate_hz)
    shuffled = run(tracks.sample(fraction=1.0, shuffle=True, seed=seed), make_vehicles(tracks), rate_hz=rate_hz)
    for name in ("entries", "quality", "skips", "unkept"):
        assert getattr(done, name).equals(getattr(shuffled, name))
    kept = done.entries.filter(~pl.col("imputed")).height
    assert kept + done.skips["entries"].sum() == tracks.height
