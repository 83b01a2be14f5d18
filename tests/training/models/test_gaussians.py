"""Densities are SciPy's, limits hold, and gradients lead back from them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from tracklake.training.models.gaussians import (
    CORRELATION_LIMIT,
    SIGMA_LIMITS_M,
    gaussian_nll,
    keep_within,
    to_gaussian,
)


def scipy_log_density(mean, sigma, rho, place):
    """One position."""
    between = rho * sigma[0] * sigma[1]
    covariance = [[sigma[0] ** 2, between], [between, sigma[1] ** 2]]
    return multivariate_normal.logpdf(place, mean=mean, cov=covariance)


def draw(seed, *shape):
    random = np.random.default_rng(seed)
    raw = random.normal(0, 1, (*shape, 5))
    return torch.from_numpy(raw), torch.from_numpy(random.normal(0, 2, (*shape, 2)))


def test_five_numbers_by_hand():
    mean, sigma, rho = to_gaussian(torch.tensor([[1.0, -2.0, 0.0, math.log(4), math.atanh(0.5)]]))
    assert mean.tolist() == [[1.0, -2.0]]
    assert sigma.tolist() == [[1.0, pytest.approx(0.25)]]  # the logarithm of 1 / sigma is what a network gives
    assert rho.tolist() == [pytest.approx(0.5)]


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), batch=st.integers(1, 4), ticks=st.integers(1, 5))
def test_mean_negative_log_density_is_scipys(seed, batch, ticks):
    raw, future = draw(seed, batch, ticks)
    mask = torch.from_numpy(np.random.default_rng(seed).random((batch, ticks)) < 0.7)
    future[~mask] = math.nan  # what is not known is not looked at
    mean, sigma, rho = to_gaussian(raw)
    densities = [
        scipy_log_density(mean[b, t].numpy(), sigma[b, t].numpy(), rho[b, t].item(), future[b, t].numpy())
        for b in range(batch)
        for t in range(ticks)
        if mask[b, t]
    ]
    expected = -sum(densities) / len(densities) if densities else 0.0
    assert gaussian_nll(mean, sigma, rho, future, mask).item() == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_extreme_numbers_stay_finite_and_at_the_limits():
    raw = torch.tensor([[0.0, 0.0, 900.0, -900.0, 50.0], [0.0, 0.0, -900.0, 900.0, -50.0]], requires_grad=True)
    mean, sigma, rho = to_gaussian(raw)
    least, most = SIGMA_LIMITS_M
    np.testing.assert_allclose(sigma.detach(), [[least, most], [most, least]], rtol=1e-5)
    np.testing.assert_allclose(rho.detach(), [CORRELATION_LIMIT, -CORRELATION_LIMIT], rtol=1e-6)
    loss = gaussian_nll(mean, sigma, rho, torch.tensor([[40.0, -3.0], [1.0, 2.0]]), torch.ones(2, dtype=torch.bool))
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(raw.grad).all()


def test_single_precision_suffices_at_the_limits():
    place, sigma = np.array([0.013, -0.02]), np.array([SIGMA_LIMITS_M[0], 0.03])
    expected = scipy_log_density([0.0, 0.0], sigma, CORRELATION_LIMIT, place)
    found = gaussian_nll(
        torch.zeros(1, 2),
        torch.tensor(sigma).float()[None],
        torch.tensor([CORRELATION_LIMIT]),
        torch.tensor(place).float()[None],
        torch.ones(1, dtype=torch.bool),
    )
    assert found.item() == pytest.approx(-expected, rel=1e-3)


def test_gradients_pass_inside_and_back_inside_only():
    value = torch.tensor([-2.0, -2.0, 0.5, 0.5, 3.0, 3.0], requires_grad=True)
    kept = keep_within(value, -1.0, 1.0)
    assert kept.tolist() == [-1.0, -1.0, 0.5, 0.5, 1.0, 1.0]
    kept.backward(torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]))
    # a step is taken against the gradient: -2 is left alone by +1, which would lead it further down
    assert value.grad.tolist() == [0.0, -1.0, 1.0, -1.0, 1.0, 0.0]
    assert torch.autograd.gradcheck(
        lambda inside: keep_within(inside, -1.0, 1.0), torch.tensor([0.3], dtype=torch.float64, requires_grad=True)
    )


def test_masked_positions_have_no_gradient_and_no_positions_no_loss():
    raw, future = draw(5, 2, 3)
    raw.requires_grad_()
    future[0, 1:] = math.nan
    mask = torch.tensor([[True, False, False], [False, False, False]])
    gaussian_nll(*to_gaussian(raw), future, mask).backward()
    assert (raw.grad[0, 0] != 0).any()
    assert (raw.grad[~mask] == 0).all()
    assert gaussian_nll(*to_gaussian(raw), future, torch.zeros(2, 3, dtype=torch.bool)).item() == 0
