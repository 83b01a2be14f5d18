import numpy as np
import pytest

from tracklake.pipeline.transforms.number_store import MemoryStore
from tracklake.pipeline.transforms.reconstruction.jumps import find_displacements, find_least_jump, measure_differences
from tracklake.pipeline.transforms.reconstruction.smoothing import Series


def find(z, rate_hz=10.0, recorded=None, sizes=None):
    sizes = np.array([len(z)] if sizes is None else sizes)
    series = Series(np.cumsum(sizes) - sizes, sizes, rate_hz)
    recorded = np.ones(len(z), bool) if recorded is None else recorded
    differences = MemoryStore("float64")
    differences.append(measure_differences(series, z, recorded))
    return find_displacements(series, z, recorded, find_least_jump(differences, len(z)))[0]


@pytest.mark.parametrize("rate_hz", [10.0, 25.0])
def test_a_jump_between_cameras_displaces_the_lesser_part_of_the_track(rate_hz):
    frame = np.arange(300)
    noise = 0.02 * np.random.default_rng(0).standard_normal(300)
    z = 15 * frame / rate_hz + noise + 1.5 * (frame >= 100)
    found = find(z, rate_hz)
    np.testing.assert_allclose(found[100:], 0, atol=1e-9)
    np.testing.assert_allclose(found[:100], -1.5, atol=0.15)


def test_a_wrong_position_for_some_frames_is_put_back():
    frame = np.arange(100)
    z = 2.0 * frame + 6.0 * ((frame >= 40) & (frame < 43))
    np.testing.assert_allclose(find(z), 6.0 * ((frame >= 40) & (frame < 43)), atol=1e-9)
    single = 2.0 * frame - 1.0 * (frame == 70)
    np.testing.assert_allclose(find(single), -1.0 * (frame == 70), atol=1e-9)


def test_hard_braking_and_crawling_in_steps_are_no_jumps():
    time_s = np.arange(150) / 10
    braking = np.where(time_s < 5, 20 * time_s, 100 + 20 * (time_s - 5) - 4 * np.minimum(time_s - 5, 2.5) ** 2)
    braking = np.where(time_s > 7.5, 125.0, braking)
    assert not find(braking).any()
    crawling = np.floor(1.5 * time_s / 0.6) * 0.6
    assert not find(crawling).any()


def test_ends_of_pieces_and_gaps_are_no_jumps():
    z = np.concatenate([2.0 * np.arange(50), 500 + 2.0 * np.arange(50)])
    assert not find(z, sizes=[50, 50]).any()
    recorded = np.ones(100, bool)
    recorded[50:53] = False
    gap = 2.0 * np.arange(100)
    gap[50:53] += 5.0
    assert not find(gap, recorded=recorded).any()
    assert not find(np.array([0.0, 5.0, 6.0, 7.0])).any()
