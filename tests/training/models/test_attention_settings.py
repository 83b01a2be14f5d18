"""Attention on raw positions and its ablations: each is the network that is shown less."""

import numpy as np
import pytest
from attention_networks import build, close, forecast, to_tensors
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_attention import restate
from wandering_scenes import F, change, wander

from tracklake.schemas.errors import UsageError

seeds = st.integers(0, 2**31)


def test_raw_positions_equal_a_slow_restatement():
    observed, _ = wander(6, 3, 5)
    network = build(2, inputs="positions", residual=False)
    weights = {name: value.double().numpy() for name, value in network.state_dict().items()}
    slow = restate(weights, observed, 2, ticks=1, rate_hz=5, horizon_ticks=F, residual=False, positions=True)
    said = forecast(network, observed)
    assert not observed.history_mask.all()
    for scene, (there, means, covariances, _) in enumerate(slow):
        close(said.mean_m[scene, there], means)
        close(said.covariance_m2[scene, there], covariances)


def without(observed, away):
    """The same with some vehicles (B, V) away, and garbage in their rows."""
    return change(
        observed,
        vehicle_mask=observed.vehicle_mask & ~away,
        history=np.where(away[..., None, None], np.float32(1e9), observed.history),
        size_m=np.where(away[..., None], np.float32(1e9), observed.size_m),
    )


RANGE_M = 27.432


@pytest.mark.parametrize(
    ("parameters", "shown"),
    [
        ({"sizes": False}, lambda scene: change(scene, size_m=0 * scene.size_m)),
        ({"lanes": "none"}, lambda scene: change(scene, lanes=0 * scene.lanes)),
        ({"lanes": "all"}, lambda scene: change(scene, lanes=scene.all_lanes)),
        ({"range_m": RANGE_M}, lambda scene: without(scene, np.abs(scene.history[:, :, -1, 0]) >= RANGE_M)),
        ({"ego_only": True, "nearest": 2}, lambda scene: scene),  # in training alone
    ],
    ids=["sizes", "no lanes", "all lanes", "range", "training"],
)
def test_an_ablation_is_the_network_that_is_shown_less(parameters, shown):
    observed, _ = wander(12, 4, 7)
    same = shown(observed)
    ablated, network = build(**parameters), build()
    said, expected = forecast(ablated, observed), forecast(network, same)
    assert np.array_equal(said.vehicle_mask, same.vehicle_mask)
    close(said.mean_m, expected.mean_m)
    close(said.covariance_m2, expected.covariance_m2)
    close(ablated.read_attention(observed).lanes, network.read_attention(same).lanes)
    if same is not observed:
        assert np.abs(said.mean_m[:, 0] - forecast(network, observed).mean_m[:, 0]).max() > 1e-3


@settings(max_examples=20)
@given(seed=seeds, vehicles=st.integers(1, 6), nearest=st.integers(0, 10), ego_only=st.booleans())
def test_a_training_sees_the_nearest_and_may_learn_from_the_ego_alone(seed, vehicles, nearest, ego_only):
    observed, truth = wander(seed, 3, vehicles)
    beyond = np.broadcast_to(np.arange(vehicles) > nearest, (3, vehicles))
    taught = truth.future_mask & observed.vehicle_mask[..., None] & ~beyond[..., None]
    taught &= (np.arange(vehicles) == 0)[:, None] if ego_only else True
    network, whole = build(nearest=nearest, ego_only=ego_only).eval(), build().eval()
    given_all = to_tensors(observed), to_tensors(truth)
    assert np.array_equal(network.supervised(*given_all), taught)
    expected = whole.loss(to_tensors(without(observed, beyond)), to_tensors(change(truth, future_mask=taught)), "both")
    close(network.loss(*given_all, "both").item(), expected.item())


@pytest.mark.parametrize(
    ("parameters", "reported"),
    [
        ({"inputs": "speeds"}, "parameter `inputs`: expected one of deviations, positions, got 'speeds'"),
        ({"lanes": "own"}, "parameter `lanes`: expected one of adjacent, all, none, got 'own'"),
        ({"nearest": 11}, "parameter `nearest`: expected 0 to 10, the most that a training reads, got 11"),
        ({"range_m": -1.0}, "parameter `range_m`: expected float from 0 to 2,048"),
    ],
)
def test_settings_that_mean_nothing_are_refused(parameters, reported):
    with pytest.raises(UsageError, match=reported):
        build(**parameters)
