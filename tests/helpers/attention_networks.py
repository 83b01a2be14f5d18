"""Attention networks of drawn weights, and comparisons with what they predict."""

from types import SimpleNamespace

import numpy as np
import torch

from tracklake.schemas.protocols import CSP
from tracklake.training.models import find_model


def build(heads=4, protocol=CSP, *, seed=0, wild=True, **parameters):
    """A network; `wild`: its last layer, which begins at zero, drawn as well, so that every part of it shows."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = find_model(f"attention-h{heads}").build(protocol, **parameters)
        if wild:
            torch.nn.init.normal_(network.out[-1].weight, std=0.1)
            torch.nn.init.normal_(network.out[-1].bias, std=0.3)
    return network


def forecast(network, observed):
    """Means and covariances of all vehicles (B, V) of scenes, and which are there."""
    mean, sigma, rho = (part.numpy() for part in network.infer(observed, network))
    covariance = sigma[..., :, None] * sigma[..., None, :]
    covariance[..., 0, 1] *= rho
    covariance[..., 1, 0] *= rho
    present = network.limit(observed).vehicle_mask
    assert np.array_equal(network.predict_vehicles(observed).position_m, mean[present])
    return SimpleNamespace(mean_m=mean, covariance_m2=covariance, vehicle_mask=present)


def to_tensors(arrays):
    return arrays.each(torch.from_numpy)


def close(left, right, atol=2e-4):
    np.testing.assert_allclose(left, right, rtol=2e-4, atol=atol)
