"""Methods and measures with which reconstructed tracks are compared, against slow loops and dense algebra."""

import numpy as np
import polars as pl
import pytest
from reconstruction_data import build_scene
from reconstruction_methods import (
    average_exponentially,
    average_moving,
    differentiate,
    find_runs,
    fit_savitzky_golay,
    smooth_kalman,
)
from reconstruction_page import Comparison, replace_tables
from reconstruction_scores import draw_weights, score_motion

RATE_HZ = 10.0


@pytest.fixture
def noisy():
    """Two vehicles, the second with a hole, and one of a single entry."""
    frames = [np.arange(40), np.r_[np.arange(12), np.arange(15, 31)], np.array([3])]
    vehicle = np.repeat(np.arange(3), [len(each) for each in frames])
    frame = np.concatenate(frames)
    x = 2.0 * frame + np.random.default_rng(1).normal(0, 0.3, len(frame))
    return x, find_runs(vehicle, frame, RATE_HZ)


def test_runs_end_at_vehicles_and_holes(noisy):
    assert noisy[1].begins.tolist() == [0, 40, 52, 68]
    assert noisy[1].lengths.tolist() == [40, 12, 16, 1]


def average_slowly(x, runs, weigh):
    found = np.empty(len(x))
    for begin, length in zip(runs.begins, runs.lengths, strict=True):
        for row in range(begin, begin + length):
            reach = min(row - begin, begin + length - 1 - row)
            weights = [weigh(abs(other - row)) for other in range(row - reach, row + reach + 1)]
            found[row] = np.dot(weights, x[row - reach : row + reach + 1]) / sum(weights)
    return found


def test_averages_are_symmetric_and_shrink_at_the_ends(noisy):
    x, runs = noisy
    moving = average_moving(x, runs, 1.0)
    assert np.allclose(moving.x, average_slowly(x, runs, lambda away: away <= 5))
    assert np.allclose(moving.speed, differentiate(moving.x, runs))
    # Width 3 rows, cut off at 9.
    weigh = lambda away: np.exp(-away / 3) * (away <= 9)  # noqa: E731 - one line says it
    assert np.allclose(average_exponentially(x, runs, 0.3), average_slowly(x, runs, weigh))


def test_savitzky_golay_keeps_cubic_motion(noisy):
    _, runs = noisy
    t = np.arange(40) / RATE_HZ
    x = np.r_[t**3 - t**2 + 5 * t, np.zeros(29)]
    found = fit_savitzky_golay(x, runs, 1.2)
    assert np.allclose(found.x[:40], x[:40])
    assert np.allclose(found.speed[:40], 3 * t**2 - 2 * t + 5)
    assert np.allclose(found.accel[:40], 6 * t - 2)


def test_the_kalman_smoother_is_the_least_squares_solution(noisy):
    x, runs = noisy
    density, step = 3.0, 1 / RATE_HZ
    found = smooth_kalman(x, runs, density)
    transition = np.array([[1, step, step**2 / 2], [0, 1, step], [0, 0, 1]])
    grid = np.linspace(0, step, 20_001)
    effect = np.stack([(step - grid) ** 2 / 2, step - grid, np.ones_like(grid)])
    process = density * np.trapezoid(effect[:, None] * effect[None], grid)
    for begin, length in zip(runs.begins, runs.lengths, strict=True):
        # Rows of a dense system: the first state, the measurements, the steps between states; unknown are all states.
        second = x[min(begin + 1, begin + length - 1)]
        first = np.array([x[begin], (second - x[begin]) / step, 0])
        rows, right = [np.eye(3, 3 * length) / np.sqrt([[1.0], [1e4], [1e2]])], [first / np.sqrt([1.0, 1e4, 1e2])]
        whiten = np.linalg.inv(np.linalg.cholesky(process))
        for number in range(1, length):
            measured, moved = np.zeros((1, 3 * length)), np.zeros((3, 3 * length))
            measured[0, 3 * number] = 1
            moved[:, 3 * number - 3 : 3 * number], moved[:, 3 * number : 3 * number + 3] = -transition, np.eye(3)
            rows += [measured, whiten @ moved]
            right += [x[begin + number : begin + number + 1], np.zeros(3)]
        states = np.linalg.lstsq(np.vstack(rows), np.concatenate(right))[0].reshape(-1, 3)
        own = slice(begin, begin + length)
        assert np.allclose(np.stack([found.x, found.speed, found.accel], axis=1)[own], states, atol=1e-4)


def make_scene(shift_m=0.0):
    """A leader of 5 m at 20 m/s, 7 m behind it a follower; recorded `shift_m` too far ahead."""
    frame = np.tile(np.arange(1, 31), 2)
    vehicle = np.repeat([1, 2], 30)
    true = pl.DataFrame(
        {
            "vehicle_id": pl.Series(vehicle, dtype=pl.Int32),
            "frame": pl.Series(frame, dtype=pl.Int32),
            "x_m": 2.0 * frame - np.where(vehicle == 2, 12.0, 0.0),
            "speed_mps": np.full(60, 20.0),
            "accel_mps2": np.zeros(60),
        }
    )
    tracks = true.with_columns(
        pl.col("x_m") + shift_m * (pl.col("vehicle_id") == 2),
        leader_id=pl.when(pl.col("vehicle_id") == 2).then(pl.lit(1, pl.Int32)),
    )
    vehicles = pl.DataFrame(
        {"vehicle_id": pl.Series([1, 2], dtype=pl.Int32), "length_m": [5.0, 5.0], "class": ["car", None]}
    )
    return build_scene(tracks, vehicles, true, [], RATE_HZ)


def test_a_shifted_follower_by_hand():
    scene = make_scene(shift_m=8.0)
    found = {name: float(value[0]) for name, value in score_motion(scene.recorded, scene).rate().items()}
    assert found["position"] == pytest.approx(np.sqrt(64 / 2))
    assert found["gap"] == pytest.approx(8)
    assert (found["overlaps"], found["speed"], found["backward"], found["out_of_bounds"]) == (1, 0, 0, 0)
    # The follower passes both cross sections 0.4 s too soon.
    assert found["travel_time"] == pytest.approx(0.0, abs=1e-9)
    none = score_motion(scene.true, scene).rate()
    assert all(float(value[0]) == 0 for value in none.values())


def test_changes_of_the_jerks_sign_are_counted_per_second():
    scene = make_scene()
    accel = np.tile([0.0, 1.0, 1.0, 0.0, 1.0], 12)  # jerk by five rows: + 0 - + -, then + again
    motion = type(scene.true)(scene.true.x, scene.true.speed, accel)
    # Per vehicle 30 rows: the signs + - + - repeat six times, the last time without the step to the next: 23 signs.
    assert score_motion(motion, scene).rate()["jerk_changes"][0] == pytest.approx(22 / 3.0)


def test_better_is_said_only_where_the_paired_differences_agree():
    weights = draw_weights(50)
    assert (weights.sum(axis=1) == 50).all()
    draws = {"tracklake": np.linspace(1, 2, 1000), "recorded values": np.linspace(1.1, 2.1, 1000)}
    shuffled = np.random.default_rng(1).permutation(draws["tracklake"])
    both = {name: {"speed": values} for name, values in {**draws, "moving average": shuffled}.items()}
    each = Comparison("smooth", "10 Hz", 50, 1000, {}, both, both)
    assert each.judge("speed", "recorded values") == "better"
    assert each.judge("speed", "moving average") == "no difference"
    assert each.find_best_other("speed") == "moving average"


def test_tables_replace_only_what_is_between_their_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- begin x -->\nold\n<!-- end x -->\nb\n")
    replace_tables(page, "x", "new")
    assert page.read_text() == "a\n<!-- begin x -->\n\nnew\n\n<!-- end x -->\nb\n"
    with pytest.raises(ValueError, match="expected the lines <!-- begin y -->"):
        replace_tables(page, "y", "new")
