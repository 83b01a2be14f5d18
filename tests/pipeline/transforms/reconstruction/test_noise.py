import numpy as np
import pytest

from tracklake.pipeline.transforms.reconstruction.noise import LEAST_HZ, compute_cutoff, compute_weight, estimate_noise
from tracklake.pipeline.transforms.reconstruction.smoothing import Series


def make_positions(rate_hz, noise_m, tracks=12, seconds=60):
    """Tracks with a slowly varying speed, and noise that is correlated over half a second."""
    random = np.random.default_rng(3)
    count = int(seconds * rate_hz)
    time_s = np.arange(count) / rate_hz
    width = max(3, round(rate_hz / 2))
    kernel = np.hanning(2 * width + 3)
    kernel /= np.sqrt(np.sum(kernel**2))
    parts = []
    for _ in range(tracks):
        phase = random.uniform(0, 6, 3)
        motion = 20 * time_s + sum(8 / k**2 * np.sin(2 * np.pi * 0.03 * k * time_s + phase[k - 1]) for k in (1, 2, 3))
        parts.append(motion + noise_m * np.convolve(random.standard_normal(count + len(kernel) - 1), kernel, "valid"))
    return Series(np.arange(tracks) * count, np.full(tracks, count), rate_hz), np.concatenate(parts)


@pytest.mark.parametrize("rate_hz", [10.0, 25.0])
@pytest.mark.parametrize("noise_m", [0.02, 0.2])
def test_correlated_noise_is_found(rate_hz, noise_m):
    series, z = make_positions(rate_hz, noise_m)
    found = estimate_noise(series, z, np.ones(len(z), bool), None, None, LEAST_HZ["x_m"])
    assert found.noise_m == pytest.approx(noise_m, rel=0.3)
    assert 0.1 < compute_cutoff(found.weight_s6) < 0.45


def test_jumps_between_cameras_are_no_noise():
    series, z = make_positions(10.0, 0.05)
    jumped = z + 2.0 * (np.arange(len(z)) % 600 > 400)
    plain, other = (estimate_noise(series, x, np.ones(len(z), bool), None, None, 0.15) for x in (z, jumped))
    assert other.noise_m == pytest.approx(plain.noise_m, rel=0.15)


def test_what_is_set_is_used_and_more_noise_means_more_weight():
    series, z = make_positions(10.0, 0.05)
    known = np.ones(len(z), bool)
    assert estimate_noise(series, z, known, 0.3, 0.7, 0.15).weight_s6 == 0.7
    free = estimate_noise(series, z, known, None, None, 0.15)
    doubled = estimate_noise(series, z, known, 2 * free.noise_m, None, 0.15)
    assert doubled.noise_m == 2 * free.noise_m
    assert doubled.weight_s6 == pytest.approx(4 * free.weight_s6)
    assert estimate_noise(series, z, known, None, 0.7, 0.15).weight_s6 == 0.7


def test_weight_and_cutoff_are_inverse():
    assert compute_weight(0.5) == pytest.approx(1 / np.pi**6)
    assert compute_cutoff(compute_weight(0.2)) == pytest.approx(0.2)


def test_tracks_too_short_for_blocks_get_a_middle_weight():
    series = Series(np.array([0, 5]), np.array([5, 6]), 10.0)
    found = estimate_noise(series, np.arange(11.0), np.ones(11, bool), None, None, 0.15)
    assert 0 <= found.noise_m < 1e-6
    assert 0.15 < compute_cutoff(found.weight_s6) < 0.5
