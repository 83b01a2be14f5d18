"""Negative log-likelihoods against SciPy's bivariate normal density, place by place."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from tracklake.training.evaluation.scores import find_nll
from tracklake.training.models.prediction import Density


def random_density(draw, *, samples, alternatives, ticks):
    """Alternatives of random weight, place, width and slant; and places to judge."""
    weight = draw.uniform(0.05, 1.0, (samples, alternatives))
    shape = (samples, alternatives, ticks)
    density = Density(
        weight=(weight / weight.sum(axis=1, keepdims=True)).astype(np.float32),
        mean_m=draw.normal(0, 20, (*shape, 2)).astype(np.float32),
        sigma_m=draw.uniform(0.05, 5.0, (*shape, 2)).astype(np.float32),
        correlation=draw.uniform(-0.95, 0.95, shape).astype(np.float32),
    )
    return density, draw.normal(0, 20, (samples, ticks, 2)).astype(np.float32)


def look_up(density, place, sample, tick):
    """-ln of the weighted sum of SciPy's densities, its logarithms added so that none becomes 0."""
    logs = []
    for alternative in range(density.weight.shape[1]):
        mean = density.mean_m[sample, alternative, tick].astype(float)
        along, across = density.sigma_m[sample, alternative, tick].astype(float)
        between = float(density.correlation[sample, alternative, tick]) * along * across
        normal = multivariate_normal(mean, [[along**2, between], [between, across**2]])
        logs.append(math.log(float(density.weight[sample, alternative])) + normal.logpdf(place.astype(float)))
    return -np.logaddexp.reduce(logs)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), samples=st.integers(1, 3), alternatives=st.sampled_from([1, 6]))
def test_nll_is_scipys(seed, samples, alternatives):
    density, future = random_density(np.random.default_rng(seed), samples=samples, alternatives=alternatives, ticks=2)
    nll = find_nll(density, future)
    assert nll.shape == (samples, 2)
    for sample in range(samples):
        for tick in range(2):
            expected = look_up(density, future[sample, tick], sample, tick)
            assert nll[sample, tick] == pytest.approx(expected, rel=1e-6)


def one_place(*, weight=(1.0,), mean=((0.0, 0.0),), sigma=(1.0, 1.0), correlation=0.0):
    alternatives = len(weight)
    return Density(
        weight=np.array([weight], dtype=np.float32),
        mean_m=np.array(mean, dtype=np.float32).reshape(1, alternatives, 1, 2),
        sigma_m=np.tile(np.array(sigma, dtype=np.float32), (1, alternatives, 1, 1)),
        correlation=np.full((1, alternatives, 1), correlation, dtype=np.float32),
    )


HERE = np.zeros((1, 1, 2), dtype=np.float32)


def test_nll_by_hand():
    # At the mean the density is 1 / (2 pi sigma sigma).
    assert find_nll(one_place(sigma=(2.0, 0.5)), HERE).item() == pytest.approx(math.log(2 * math.pi))
    assert find_nll(one_place(sigma=(0.1, 0.1)), HERE).item() == pytest.approx(math.log(2 * math.pi * 0.01), rel=1e-6)
    # Half the weight here and half of it 1000 m away, where its share is nothing: twice as unlikely.
    half = one_place(weight=(0.5, 0.5), mean=((0.0, 0.0), (1000.0, 0.0)))
    assert find_nll(half, HERE).item() == pytest.approx(math.log(2 * math.pi) + math.log(2))


def test_a_place_far_out_is_unlikely_and_not_impossible():
    far = np.array([[[5000.0, 0.0]]], dtype=np.float32)
    # 5000 standard deviations: the density itself would be 0 in any floating-point number.
    assert find_nll(one_place(), far).item() == pytest.approx(0.5 * 5000**2 + math.log(2 * math.pi))
    unused = one_place(weight=(1.0, 0.0), mean=((0.0, 0.0), (0.0, 0.0)))
    assert find_nll(unused, HERE).item() == pytest.approx(math.log(2 * math.pi)), "an alternative of no weight"


@pytest.mark.parametrize(
    "wrong", [{"sigma": (0.0, 1.0)}, {"sigma": (-1.0, 1.0)}, {"correlation": 1.0}, {"weight": (0.0,)}]
)
def test_what_is_no_density_gives_no_number(wrong):
    assert not np.isfinite(find_nll(one_place(**wrong), HERE)).any()
