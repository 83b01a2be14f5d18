"""Noise models of NGSIM's kind, each on vehicles that drive as simply as possible."""

import numpy as np
import polars as pl
import pytest

from tracklake.pipeline.synthetic import NOISE_MODELS, write_sample
from tracklake.pipeline.synthetic.noise import DRONE, MAST, add_noise
from tracklake.pipeline.synthetic.scenarios import FREEWAY
from tracklake.schemas.errors import UsageError


def drive(vehicles=30, frames=400, speed=12.0):
    """Vehicles one after the other in lane 3 at 10 Hz, each at a constant speed."""
    vehicle, step = np.repeat(np.arange(1, vehicles + 1), frames), np.tile(np.arange(frames), vehicles)
    rows = len(vehicle)
    return pl.DataFrame(
        {
            "vehicle": pl.Series(vehicle, dtype=pl.Int32),
            "frame": pl.Series(step + 1, dtype=pl.Int32),
            "x": step * speed / 10,
            "y": np.full(rows, 2.5 * FREEWAY.lane_width_m),
            "speed": np.full(rows, speed),
            "accel": np.zeros(rows),
            "lane": pl.Series([3] * rows, dtype=pl.Int16),
        }
    )


def add(tracks, *models, noise=MAST):
    return add_noise(tracks, FREEWAY, noise, models, np.random.default_rng(1))


def find_error(tracks, *models, noise=MAST):
    return (add(tracks, *models, noise=noise)["x"] - tracks["x"]).to_numpy().reshape(-1, 400)


@pytest.mark.parametrize(("noise", "level_m"), [(MAST, 0.30), (DRONE, 0.06)])
def test_drift_is_correlated_over_seconds(noise, level_m):
    error = find_error(drive(vehicles=200), "autocorrelated", noise=noise)
    assert error.std() == pytest.approx(level_m, rel=0.1)
    # An autoregressive process: e^-1 after 2 s, e^-2 after 4 s.
    for lag, expected in ((20, 0.368), (40, 0.135)):
        assert np.mean(error[:, :-lag] * error[:, lag:]) / error.var() == pytest.approx(expected, abs=0.07)


def test_vehicles_jump_where_the_next_camera_takes_over_and_stay_off():
    tracks = drive()
    error = find_error(tracks, "handover")
    jumps = np.diff(error, axis=1)
    crosses = np.diff(tracks["x"].to_numpy().reshape(-1, 400) // 80, axis=1) > 0
    assert (error[:, 0] == 0).all()
    assert np.abs(jumps[~crosses]).max() < 1e-9
    assert np.abs(jumps[crosses]).min() >= 0.5
    assert np.abs(jumps[crosses]).max() <= 3
    assert np.abs(error).max() <= 3
    assert len(np.unique(jumps[crosses].round(6))) == crosses.sum(), "every vehicle and section has its own"
    assert 0.2 < (jumps[crosses] > 0).mean() < 0.8


def test_a_vehicle_that_begins_mid_road_is_placed_right_by_its_first_camera():
    late = drive(vehicles=1).filter(pl.col("x") >= 200)
    error = (add(late, "handover")["x"] - late["x"]).to_numpy()
    assert (error[late["x"].to_numpy() < 240] == 0).all()
    assert abs(error[-1]) > 0


def test_crawling_vehicles_move_in_steps_and_speeds_are_quantised():
    crawling = add(drive(speed=0.9), "quantised")
    moved = crawling["x"].to_numpy().reshape(-1, 400)
    assert np.unique(np.diff(moved, axis=1).round(9)).tolist() == [0, 0.6]
    assert (np.diff(moved, axis=1) == 0).mean() > 0.8
    swift = add(drive(), "quantised", "autocorrelated")
    assert np.abs(swift["speed"].to_numpy() / 0.3048 % 1 - 0.5).min() > 0.499
    assert swift["accel"].abs().max() == 3.4534
    assert (swift["accel"] == 0).mean() > 0.2
    assert add(drive(), "quantised")["x"].equals(drive()["x"]), "fast vehicles are where they are"


def test_recorded_speeds_follow_from_recorded_positions_except_under_smooth_noise():
    noisy = add(drive(), "autocorrelated")
    rate = (pl.col("x").shift(-5) - pl.col("x").shift(5)).over("vehicle")
    difference = noisy.select(rate - pl.col("speed")).to_series().drop_nulls()
    assert difference.abs().max() < 1e-9
    assert add(drive(), "smooth", "autocorrelated")["speed"].std() > noisy["speed"].std()


def test_errors_add_up_and_defects_are_drawn_alike_under_every_model():
    tracks, random = drive(vehicles=3), [np.random.default_rng(1) for _ in NOISE_MODELS]
    apart = sum(find_error(tracks, model) for model in ("smooth", "autocorrelated"))
    assert np.allclose(find_error(tracks, "autocorrelated", "smooth"), apart)
    for model, own in zip(NOISE_MODELS, random, strict=True):
        add_noise(tracks, FREEWAY, MAST, (model,), own)
    assert len({own.random() for own in random}) == 1


@pytest.mark.parametrize("rows", [1, 2])
def test_shortest_tables(rows):
    assert add(drive(vehicles=1).head(rows), *NOISE_MODELS).height == rows


def test_an_unknown_model_is_refused(tmp_path, command):
    with pytest.raises(
        UsageError, match="noise: expected some of smooth, autocorrelated, handover, quantised, got loud"
    ):
        write_sample(tmp_path / "out", noise=("loud",))
    done = command.here("sample", "--out", tmp_path / "out", "--noise", "loud", "--quiet")
    assert done.code == 2
    assert not list(tmp_path.iterdir())
