import numpy as np
import pytest

from tracklake.pipeline.transforms.reconstruction.smoothing import (
    Series,
    differentiate,
    make_penalty,
    smooth,
    smooth_robustly,
)


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


def test_an_outlier_moves_the_track_no_more_than_a_residual_of_one_metre():
    penalty, way = make_penalty(Series(np.array([0]), np.array([60]), 10.0), 0.01), np.arange(60) * 2.0
    outlier = np.where(np.arange(60) == 30, 1.0, 0.0)
    share = smooth(penalty, way + outlier, np.ones(60))[30] - 60.0  # how far a position that is 1 m off moves the track
    for off_m in (5.0, 50.0):
        x, weights = smooth_robustly(penalty, way + off_m * outlier, np.ones(60), 1.0)
        # The force of the residual is that of 1 m: the rest of the track alone would move by share / (1 - share).
        assert x[30] - 60.0 == pytest.approx(share / (1 - share), rel=0.02)
        assert weights[30] == pytest.approx(1.0 / (off_m - share / (1 - share)), rel=0.02)
        assert weights[0] == 1.0


def test_residuals_below_the_limit_count_in_full():
    penalty, way = make_penalty(Series(np.array([0]), np.array([60]), 10.0), 0.01), np.arange(60) * 2.0
    z = way + np.where(np.arange(60) == 30, 0.9, 0.0)
    x, weights = smooth_robustly(penalty, z, np.ones(60), 1.0)
    np.testing.assert_array_equal(weights, np.ones(60))
    np.testing.assert_array_equal(x, smooth(penalty, z, np.ones(60)))
