"""Vehicle and lane attention: a slow re-statement, whose order and padding do not matter, losses by hand, training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from attention_networks import build, close, forecast, to_tensors
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from slow_attention import restate
from wandering_scenes import change, pad, reorder, wander

from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import CSP
from tracklake.training.models import MODELS, find_model
from tracklake.training.models.attention import MultiHeadAttention, describe_vehicles
from tracklake.training.models.motion import count_velocity_ticks

H, F = CSP.history_ticks, CSP.horizon_ticks
TEN_HZ = replace(CSP, rate_hz=10)
PROTOCOLS = (CSP, TEN_HZ, replace(CSP, horizon_s=3.0))
HEADS = (2, 4, 8)
PARTS = ("vehicles", "lanes", "decoder")
seeds = st.integers(0, 2**31)


@pytest.mark.parametrize("heads", HEADS)
def test_layers_are_as_large_as_published(heads):
    def linear(inputs, outputs):
        return outputs * (inputs + 1)

    def attention(query, key, width):
        return linear(query, heads * width) + 2 * linear(key, heads * width) + linear(heads * width, query) + 2 * query

    layers = attention(16, 16, 8) + attention(16, 4, 32) + attention(32, 32, 8) + linear(3, 4)
    inputs = 2 + 2 + 2 * 16 + 16 + 2  # place, velocity, deviations and masks of 16 ticks, size
    plain = layers + linear(inputs, 16) + linear(32, 5 * 25)
    deeper = layers + linear(inputs, 128) + linear(128, 16) + linear(32, 128) + linear(128, 5 * 25)
    network = build(heads)
    assert sum(weights.numel() for weights in network.parameters()) == deeper
    assert sum(weights.numel() for weights in build(heads, hidden=0).parameters()) == plain
    assert set(network.state_dict()) == {name for name, _ in network.named_parameters()}  # checkpoints hold no more


def test_constructor_and_registry_have_the_same_defaults():
    from inspect import signature

    from tracklake.training.models.attention import SceneAttention

    own = {name: each.default for name, each in signature(SceneAttention).parameters.items() if name != "protocol"}
    for heads in HEADS:
        assert {**own, "heads": heads} == dict(MODELS[f"attention-h{heads}"].parameters)


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=["csp", "10 Hz", "3 s"])
@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize(("heads", "hidden"), [(2, 128), (4, 16), (8, 0)])
def test_equals_a_slow_restatement(heads, hidden, residual, protocol):
    observed, _ = wander(heads + residual, 3, 5, protocol=protocol)
    nowhere = observed.lanes.copy()
    nowhere[0] = 0  # in one scene no lane exists
    observed = change(observed, lanes=nowhere)
    network = build(heads, protocol, hidden=hidden, residual=residual)
    weights = {name: value.double().numpy() for name, value in network.state_dict().items()}
    slow = restate(
        weights,
        observed,
        heads,
        ticks=round(0.2 * protocol.rate_hz),
        rate_hz=protocol.rate_hz,
        horizon_ticks=protocol.horizon_ticks,
        residual=residual,
    )
    said, looks, predicted = (
        forecast(network, observed),
        network.read_attention(observed),
        network.predict(observed),
    )
    for scene, (there, means, covariances, weights_by_part) in enumerate(slow):
        close(said.mean_m[scene, there], means)
        close(said.covariance_m2[scene, there], covariances)
        close(predicted.position_m[scene], means[0])
        exists = np.flatnonzero(observed.lanes[scene, :, 2])
        for part, expected, keys in zip(PARTS, weights_by_part, (there, exists, there), strict=True):
            fast = getattr(looks, part)[scene]
            assert fast.shape[0] == heads
            close(fast[:, there][:, :, keys], np.array(expected).reshape(heads, len(there), len(keys)), atol=1e-5)


def test_anchoring_adds_constant_velocity_on_its_axes_to_every_vehicle():
    observed, _ = wander(3, 3, 5)
    free, both, *one = (
        forecast(build(2, anchoring=anchoring), observed).mean_m
        for anchoring in ("none", "both", "longitudinal", "lateral")
    )
    assert np.abs(both - free).max() > 5
    for axis, anchored in enumerate(one):
        close(anchored[..., axis], both[..., axis])
        close(anchored[..., 1 - axis], free[..., 1 - axis])


@settings(max_examples=25)
@given(seed=seeds, vehicles=st.integers(1, 9), order_seed=seeds)
def test_the_order_of_vehicles_does_not_matter(seed, vehicles, order_seed):
    observed, truth = wander(seed, 2, vehicles)
    order = np.random.default_rng(order_seed).permutation(vehicles)
    network = build(seed=seed % 7)
    said, again = forecast(network, observed), forecast(network, reorder(observed, order))
    close(again.mean_m, said.mean_m[:, order])
    close(again.covariance_m2, said.covariance_m2[:, order])
    looks, shuffled = network.read_attention(observed), network.read_attention(reorder(observed, order))
    close(shuffled.vehicles, looks.vehicles[:, :, order][..., order])
    close(shuffled.lanes, looks.lanes[:, :, order])
    close(shuffled.decoder, looks.decoder[:, :, order][..., order])
    network.eval()
    moved = change(truth, future=truth.future[:, order], future_mask=truth.future_mask[:, order])
    first = network.loss(to_tensors(observed), to_tensors(truth), "both")
    close(network.loss(to_tensors(reorder(observed, order)), to_tensors(moved), "both").item(), first.item())


@settings(max_examples=25)
@given(
    seed=seeds,
    vehicles=st.integers(1, 6),
    rows=st.integers(1, 12),
    filling=st.sampled_from([0.0, 3.0, -1e30, np.nan, np.inf]),
)
def test_vehicles_that_are_not_there_change_nothing(seed, vehicles, rows, filling):
    observed, truth = wander(seed, 2, vehicles)
    network = build(seed=seed % 7).eval()
    padded = pad(observed, rows, filling)
    said, again = forecast(network, observed), forecast(network, padded)
    close(again.mean_m[:, :vehicles], said.mean_m)
    close(again.covariance_m2[:, :vehicles], said.covariance_m2)
    absent = ~padded.vehicle_mask
    assert (again.mean_m[absent] == 0).all()
    assert (again.covariance_m2[absent] == np.eye(2)).all()
    assert (network.read_attention(padded).vehicles[:, :, vehicles:] == 0).all()

    longer = ((0, 0), (0, rows), (0, 0))
    known = change(
        truth,
        future=np.pad(truth.future, (*longer, (0, 0)), constant_values=filling),
        future_mask=np.pad(truth.future_mask, longer, constant_values=True),
    )
    first = network.loss(to_tensors(observed), to_tensors(truth), "both")
    second = network.loss(to_tensors(padded), to_tensors(known), "both")
    close(second.item(), first.item())
    second.backward()
    assert all(weights.grad.isfinite().all() for weights in network.parameters())


@settings(max_examples=15)
@given(seed=seeds, filling=st.sampled_from([7.0, np.nan]), protocol=st.sampled_from(PROTOCOLS[:2]))
def test_ticks_and_lanes_that_are_unknown_change_nothing(seed, filling, protocol):
    observed, truth = wander(seed, 3, 4, protocol=protocol)
    network = build(2, protocol, seed=seed % 7).eval()
    history, lanes, future = observed.history.copy(), observed.lanes.copy(), truth.future.copy()
    history[~observed.history_mask] = filling
    lanes[observed.lanes[..., 2] == 0, :2] = filling
    future[~truth.future_mask] = filling
    other = change(observed, history=history, lanes=lanes)
    assert np.array_equal(forecast(network, other).mean_m, forecast(network, observed).mean_m)
    first = network.loss(to_tensors(observed), to_tensors(truth), "both")
    second = network.loss(to_tensors(other), to_tensors(change(truth, future=future)), "both")
    assert first.item() == second.item()


@pytest.mark.parametrize("vehicles", [1, 3, 7, 11, 21, 30])
@pytest.mark.parametrize("scenes", [0, 1, 3])
def test_any_number_of_vehicles_is_predicted(scenes, vehicles):
    observed, truth = wander(vehicles, scenes, vehicles)
    network = build(8)
    said, all_of_them, looks = (
        network.predict(observed),
        forecast(network, observed),
        network.read_attention(observed),
    )
    assert said.position_m.shape == (scenes, F, 2)
    assert said.position_m.dtype == np.float32
    assert (said.lateral, said.longitudinal) == (None, None)
    assert said.density.weight.tolist() == [[1.0]] * scenes
    assert said.density.mean_m.shape == said.density.sigma_m.shape == (scenes, 1, F, 2)
    assert said.density.correlation.shape == (scenes, 1, F)
    assert all_of_them.mean_m.shape == (scenes, vehicles, F, 2)
    assert all_of_them.covariance_m2.shape == (scenes, vehicles, F, 2, 2)
    assert np.isfinite(all_of_them.covariance_m2).all()
    assert looks.vehicles.shape == looks.decoder.shape == (scenes, 8, vehicles, vehicles)
    assert looks.lanes.shape == (scenes, 8, vehicles, 3)
    assert np.isfinite(network.loss(to_tensors(observed), to_tensors(truth), "both").item())


def test_the_ego_is_told_as_in_the_whole_scene():
    observed, _ = wander(4, 5, 6)
    network = build()
    said, all_of_them = network.predict(observed), forecast(network, observed)
    along, across = said.density.sigma_m[:, 0, :, 0], said.density.sigma_m[:, 0, :, 1]
    assert np.array_equal(said.position_m, all_of_them.mean_m[:, 0])
    assert np.array_equal(said.density.mean_m[:, 0], said.position_m)
    close(all_of_them.covariance_m2[:, 0, :, 0, 0], along**2)
    close(all_of_them.covariance_m2[:, 0, :, 1, 1], across**2)
    shared = said.density.correlation[:, 0] * along * across
    close(all_of_them.covariance_m2[:, 0, :, 0, 1], shared)
    close(all_of_them.covariance_m2[:, 0, :, 1, 0], shared)
    assert (np.linalg.eigvalsh(all_of_them.covariance_m2) > 0).all()


@settings(max_examples=20)
@given(seed=seeds, vehicles=st.integers(1, 8), heads=st.sampled_from(HEADS))
def test_attention_goes_to_what_is_there_and_sums_to_one(seed, vehicles, heads):
    observed, _ = wander(seed, 4, vehicles, present=0.5)
    lanes = observed.lanes.copy()
    lanes[0] = 0
    observed = change(observed, lanes=lanes)
    looks = build(heads).read_attention(observed)
    there, exists = observed.vehicle_mask, lanes[..., 2] > 0
    for weights, keys in ((looks.vehicles, there), (looks.decoder, there), (looks.lanes, exists)):
        assert (weights >= 0).all()
        assert (np.swapaxes(weights, 1, 3)[~keys] == 0).all()  # as a key
        assert (np.swapaxes(weights, 1, 2)[~there] == 0).all()  # as a query
        expected = there & keys.any(axis=-1)[:, None]
        close(weights.sum(axis=-1), np.broadcast_to(expected[:, None], weights.shape[:-1]), atol=1e-5)


def test_an_untrained_network_predicts_constant_velocity_of_every_vehicle():
    observed, _ = wander(8, 6, 5, present=1.0)
    mean = forecast(build(wild=False), observed).mean_m
    step = observed.history[:, :, -1] - observed.history[:, :, -2]
    has = observed.history_mask[:, :, -2]
    assert not has.all()
    assert has[:, 0].all()
    for scene in range(6):
        common = step[scene][has[scene]].mean(axis=0)
        for v in range(5):
            velocity = step[scene, v] if has[scene, v] else common
            straight = observed.history[scene, v, -1] + np.arange(1, F + 1)[:, None] * velocity
            close(mean[scene, v], straight)


def test_velocities_are_taken_from_known_ticks():
    """10 Hz: two ticks. x of the three vehicles: 0 1 2 4 8, and its last 2, and its last 1."""
    protocol = replace(TEN_HZ, history_s=0.4)
    assert (protocol.history_ticks, count_velocity_ticks(protocol)) == (5, 2)
    observed, _ = wander(0, 1, 3, present=1.0, protocol=protocol)
    x = np.array([[0, 1, 2, 4, 8], [4, 4, 4, 4, 8], [8, 8, 8, 8, 8]], dtype=np.float32)
    history = np.stack([x, 0 * x], axis=-1)[None]
    mask = np.array([[1, 1, 1, 1, 1], [0, 0, 0, 1, 1], [0, 0, 0, 0, 1]], dtype=bool)[None]
    scene = to_tensors(change(observed, history=history, history_mask=mask))
    reported = describe_vehicles(scene, ticks=2, rate_hz=10)
    assert reported.velocity[0, :, 0].tolist() == [3.0, 4.0, 3.5]  # (8 - 2) / 2; (8 - 4) / 1; their mean
    assert reported.place_m[0].tolist() == [[8.0, 0.0]] * 3
    deviation = reported.features[0, 0, 4:14:2] * 5  # x of 5 ticks: 0 1 2 4 8 less -4 -1 2 5 8
    assert deviation.tolist() == pytest.approx([4, 2, 0, -1, 0])
    assert reported.features[0, :, 14:19].tolist() == mask[0].astype(float).tolist()
    assert reported.features[0, :, 2].tolist() == pytest.approx([2.0, 40 / 15, 35 / 15])  # m/s, divided by 15


def test_loss_equals_scipy_and_the_plain_distance():
    observed, truth = wander(3, 4, 5)
    network = build(nll_weight=0.7, distance_weight=2.5).eval()
    said = forecast(network, observed)
    densities, distances = [], []
    for scene, v, tick in np.argwhere(truth.future_mask):
        place, mean = truth.future[scene, v, tick].astype(float), said.mean_m[scene, v, tick].astype(float)
        densities.append(-multivariate_normal.logpdf(place, mean, said.covariance_m2[scene, v, tick].astype(float)))
        distances.append(np.hypot(*(place - mean)))
    expected = 0.7 * np.mean(densities) + 2.5 * np.mean(distances)
    assert network.loss(to_tensors(observed), to_tensors(truth), "both").item() == pytest.approx(expected, rel=1e-4)


def test_gradients_are_finite_where_a_prediction_hits_and_where_nothing_is_known():
    observed, truth = wander(5, 2, 3)
    network = build(wild=False)
    hit = change(truth, future=forecast(network, observed).mean_m)
    for known in (truth.future_mask, np.zeros_like(truth.future_mask)):
        network.zero_grad()
        loss = network.loss(to_tensors(observed), to_tensors(change(hit, future_mask=known)), "both")
        loss.backward()
        assert loss.isfinite()
        assert all(weights.grad.isfinite().all() for weights in network.parameters())


def test_dropout_is_of_what_is_added_and_only_in_training():
    layer = MultiHeadAttention(16, 16, heads=2, head_width=8, dropout=1.0)
    rows, present = torch.randn(3, 4, 16, generator=torch.Generator().manual_seed(1)), torch.ones(3, 4, dtype=bool)
    dropped, _ = layer(rows, rows, present)
    spread = rows.var(dim=-1, correction=0, keepdim=True)
    close(dropped.detach(), (rows - rows.mean(dim=-1, keepdim=True)) / (spread + 1e-6).sqrt())
    layer.eval()
    assert not torch.allclose(layer(rows, rows, present)[0], dropped, atol=0.01)


@pytest.mark.parametrize("name", [f"attention-h{heads}" for heads in HEADS])
def test_training_on_a_few_scenes_reduces_the_loss_and_repeats(name):
    observed, truth = (to_tensors(arrays) for arrays in wander(9, 16, 4))
    recipe = find_model(name).recipe
    assert [phase.loss for phase in recipe.phases] == ["both"]
    assert (recipe.batch_size, recipe.learning_rate, recipe.optimizer) == (128, 1e-3, "adam")

    def train():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            network = find_model(name).build(CSP)
            optimizer, losses = torch.optim.Adam(network.parameters(), lr=4e-3), []
            for _ in range(40):
                loss = network.loss(observed, truth, "both")
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(loss.item())
        return losses

    losses = train()
    assert losses[-1] < 0.6 * losses[0]
    assert train() == losses


def test_predicting_leaves_training_as_it_was():
    observed, _ = wander(2, 2, 3)
    network = build().train()
    for ask in (network.predict, network.predict_vehicles, network.read_attention):
        ask(observed)
        assert network.training
    assert np.array_equal(network.predict(observed).position_m, network.predict(observed).position_m)


def test_what_makes_no_sense_is_refused():
    observed, truth = (to_tensors(arrays) for arrays in wander(1, 1, 2))
    with pytest.raises(ValueError, match="unknown phase `mse`"):
        build().loss(observed, truth, "mse")
    with pytest.raises(UsageError, match="0 heads"):
        find_model("attention-h4").build(CSP, heads=0)
