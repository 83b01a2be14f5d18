"""Convolutional social pooling against the published architecture stated once more, and its two steps to each other."""

import numpy as np
import published_social_pooling as published
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models import MODELS

SHORT = Protocol(name="short", rate_hz=2, history_s=1.5, horizon_s=2.0)
"""4 positions of history, 4 of future."""
H = F = 4


def build(name, *, seed=0, **parameters):
    torch.manual_seed(seed)
    return MODELS[name].build(SHORT, **parameters).double()


def draw(seed, neighbors):
    """Samples with so many neighbors each, and what came."""
    random = np.random.default_rng(seed)
    samples, around = len(neighbors), sum(neighbors)
    history = random.normal(0, 3, (samples, H, 2))
    history[:, -1] = 0
    cells = [np.sort(random.choice(39, count, replace=False)) for count in neighbors]
    observed = Observed(
        history=history,
        neighbor_history=random.normal(0, 3, (around, H, 2)),
        neighbor_mask=random.random((around, H)) < 0.8,
        neighbor_sample=np.repeat(np.arange(samples), neighbors),
        neighbor_cell=np.concatenate([np.array([], dtype=np.int8), *cells]).astype(np.int8),
    )
    truth = Truth(
        future=random.normal(0, 3, (samples, F, 2)),
        future_mask=random.random((samples, F)) < 0.8,
        lateral=random.integers(0, 3, samples).astype(np.uint8),
        longitudinal=random.integers(0, 2, samples).astype(np.uint8),
    )
    return observed, truth


def to_tensors(arrays):
    return arrays.each(torch.from_numpy)


def restate(model, observed, sample):
    """Encoding of a sample by the published architecture, and the weights as arrays."""
    weights = {name: value.numpy() for name, value in model.state_dict().items()}
    mine = np.flatnonzero(observed.neighbor_sample == sample)
    neighbors = [(observed.neighbor_cell[n], observed.neighbor_history[n]) for n in mine]
    return published.encode(weights, observed.history[sample], neighbors), weights


def straight_on(observed, sample):
    """(F, 2) constant velocity by hand: 0.2 s are less than a tick at 2 Hz, so over one tick."""
    step = observed.history[sample, -1] - observed.history[sample, -2]
    return np.array([step, 2 * step, 3 * step, 4 * step])


@pytest.mark.parametrize("residual", [False, True])
def test_same_weights_same_density(residual):
    model = build("cs-lstm", residual=residual)
    observed, _ = draw(1, [5, 0, 39])
    said = model.predict(observed)
    assert said.lateral is None
    assert said.longitudinal is None
    np.testing.assert_array_equal(said.density.weight, np.ones((3, 1)))
    np.testing.assert_array_equal(said.position_m, said.density.mean_m[:, 0])
    for sample in range(3):
        encoding, weights = restate(model, observed, sample)
        expected = published.decode(weights, encoding, F)
        expected[:, :2] += straight_on(observed, sample) if residual else 0
        np.testing.assert_allclose(said.density.mean_m[sample, 0], expected[:, :2], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(said.density.sigma_m[sample, 0], expected[:, 2:4], rtol=1e-9)
        np.testing.assert_allclose(said.density.correlation[sample, 0], expected[:, 4], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("residual", [False, True])
def test_same_weights_same_densities_of_all_maneuvers(residual):
    model = build("cs-lstm-m", residual=residual)
    observed, _ = draw(2, [6, 0, 11])
    said = model.predict(observed)
    np.testing.assert_allclose(said.density.weight.sum(axis=1), 1)
    for sample in range(3):
        encoding, weights = restate(model, observed, sample)
        lateral = published.recognise(weights, encoding, "op_lat")
        longitudinal = published.recognise(weights, encoding, "op_lon")
        np.testing.assert_allclose(said.lateral[sample], lateral, rtol=1e-9)
        np.testing.assert_allclose(said.longitudinal[sample], longitudinal, rtol=1e-9)
        best, place = -1.0, None
        for across in range(3):
            for along in range(2):
                given = published.with_maneuver(encoding, across, along)
                expected = published.decode(weights, given, F)
                expected[:, :2] += straight_on(observed, sample) if residual else 0
                found = said.density
                which = sample, 2 * across + along
                assert found.weight[which] == pytest.approx(lateral[across] * longitudinal[along], rel=1e-9)
                np.testing.assert_allclose(found.mean_m[which], expected[:, :2], rtol=1e-9, atol=1e-9)
                np.testing.assert_allclose(found.sigma_m[which], expected[:, 2:4], rtol=1e-9)
                np.testing.assert_allclose(found.correlation[which], expected[:, 4], rtol=1e-9, atol=1e-9)
                if found.weight[which] > best:
                    best, place = found.weight[which], expected[:, :2]
        np.testing.assert_allclose(said.position_m[sample], place, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("fast", "residual"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("name", ["cs-lstm", "cs-lstm-m"])
def test_losses_are_those_of_the_true_maneuver(name, fast, residual):
    model = build(name, residual=residual)
    model.fast = fast
    observed, truth = draw(3, [4, 7])
    squares, densities, missed = [], [], []
    for sample in range(2):
        given, weights = restate(model, observed, sample)
        if name == "cs-lstm-m":
            lateral, longitudinal = truth.lateral[sample], truth.longitudinal[sample]
            missed.append(
                -np.log(published.recognise(weights, given, "op_lat")[lateral])
                - np.log(published.recognise(weights, given, "op_lon")[longitudinal])
            )
            given = published.with_maneuver(given, lateral, longitudinal)
        decoded = published.decode(weights, given, F)
        decoded[:, :2] += straight_on(observed, sample) if residual else 0
        for tick, (along, across, *sigma, rho) in enumerate(decoded):
            if truth.future_mask[sample, tick]:
                place = truth.future[sample, tick]
                squares.append((place[0] - along) ** 2 + (place[1] - across) ** 2)
                between = rho * sigma[0] * sigma[1]
                spread = [[sigma[0] ** 2, between], [between, sigma[1] ** 2]]
                densities.append(multivariate_normal.logpdf(place, [along, across], spread))
    asked = to_tensors(observed), to_tensors(truth)
    assert model.loss(*asked, "mse").item() == pytest.approx(np.mean(squares), rel=1e-9)
    expected = -np.mean(densities) + (np.mean(missed) if missed else 0.0)
    assert model.loss(*asked, "nll").item() == pytest.approx(expected, rel=1e-9)


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), neighbors=st.lists(st.integers(0, 8), max_size=4), fast=st.booleans())
def test_as_published_a_neighbor_with_a_short_history_is_an_empty_cell(seed, neighbors, fast):
    observed, truth = draw(seed, neighbors)
    whole = observed.neighbor_mask.all(axis=1)
    fewer = {name: values[whole] for name, values in vars(observed).items() if name.startswith("neighbor")}
    losses = []
    for model, seen in (
        (build("cs-lstm", as_published=True), observed),
        (build("cs-lstm", residual=False), Observed(observed.history, **fewer)),
    ):
        model.fast = fast
        losses.append(model.loss(to_tensors(seen), to_tensors(truth), "nll").item())
    assert losses[0] == losses[1]


def test_as_published_maneuvers_are_judged_by_binary_entropies():
    """The published code takes torch's BCELoss of softmaxed heads: the mean over samples and over classes."""
    model, plain = build("cs-lstm-m", as_published=True), build("cs-lstm-m", residual=False, short_histories=False)
    observed, truth = draw(3, [4, 7])
    said, asked = model.predict(observed), (to_tensors(observed), to_tensors(truth))
    entropies = {"binary": 0.0, "categorical": 0.0}
    for probability, true in ((said.lateral, truth.lateral), (said.longitudinal, truth.longitudinal)):
        for sample, klass in enumerate(true):
            right = np.delete(1 - probability[sample], klass)
            own = -np.log(probability[sample, klass])
            entropies["binary"] += (own - np.log(right).sum()) / probability.size
            entropies["categorical"] += own / len(true)
    apart = model.loss(*asked, "nll").item() - plain.loss(*asked, "nll").item()
    assert apart == pytest.approx(entropies["binary"] - entropies["categorical"], rel=1e-9)
    assert model.loss(*asked, "mse").item() == plain.loss(*asked, "mse").item()


@settings(max_examples=15)
@given(
    seed=st.integers(0, 1000),
    neighbors=st.lists(st.integers(0, 8), min_size=0, max_size=5),
    name=st.sampled_from(["cs-lstm", "cs-lstm-m"]),
    phase=st.sampled_from(["mse", "nll"]),
)
def test_the_quicker_step_is_the_same_step(seed, neighbors, name, phase):
    compare_steps(build(name, seed=seed), seed, neighbors, phase)


def compare_steps(model, seed, neighbors, phase):
    """Compare losses and gradients of the published step and of the one that leaves out empty cells."""
    observed, truth = (to_tensors(arrays) for arrays in draw(seed, neighbors))
    losses, gradients = [], []
    for fast in (False, True):
        model.fast = fast
        assert model.sparse == fast
        model.zero_grad()
        loss = model.loss(observed, truth, phase)
        loss.backward()
        losses.append(loss.item())
        gradients.append({name: value.grad for name, value in model.named_parameters() if value.grad is not None})
    assert losses[0] == pytest.approx(losses[1], rel=1e-10)
    assert gradients[0].keys() == gradients[1].keys()
    for each, expected in gradients[0].items():
        np.testing.assert_allclose(gradients[1][each], expected, rtol=1e-7, atol=1e-9 * float(1 + expected.abs().max()))


def test_the_quicker_step_in_single_precision():
    observed, truth = draw(4, [8] * 20)
    model = build("cs-lstm-m").float()
    gradients = []
    for fast in (False, True):
        model.fast = fast
        model.zero_grad()
        seen = to_tensors(observed).each(lambda tensor: tensor.float() if tensor.is_floating_point() else tensor)
        model.loss(seen, to_tensors(truth), "nll").backward()
        gradients.append(torch.cat([value.grad.flatten() for value in model.parameters()]))
    assert (gradients[0] - gradients[1]).abs().max() < 1e-5 * gradients[0].abs().max()


@pytest.mark.parametrize("name", ["cs-lstm", "cs-lstm-m"])
def test_number_of_weights(name):
    encoder = (2 * 32 + 32) + 4 * 64 * (32 + 64 + 2) + (64 * 32 + 32)
    convolutions = (64 * 64 * 9 + 64) + (64 * 16 * 3 + 16)
    decoder = 4 * 128 * (112 + 128 + 2) + (128 * 5 + 5)
    heads = 0 if name == "cs-lstm" else 4 * 128 * 5 + (112 * 3 + 3) + (112 * 2 + 2)
    model = build(name)
    assert sum(each.numel() for each in model.parameters()) == encoder + convolutions + decoder + heads
    layers = {"ip_emb", "enc_lstm", "dyn_emb", "soc_conv", "conv_3x1", "dec_lstm", "op"}
    assert {each.split(".")[0] for each in model.state_dict()} == layers | ({"op_lat", "op_lon"} if heads else set())


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("name", ["cs-lstm", "cs-lstm-m"])
def test_no_samples_and_no_neighbors(name, fast):
    model = build(name)
    model.fast = fast
    for neighbors in ([], [0], [0, 0]):
        observed, truth = draw(5, neighbors)
        said = model.predict(observed)
        assert said.position_m.shape == (len(neighbors), F, 2)
        assert said.density.weight.shape == (len(neighbors), 6 if name == "cs-lstm-m" else 1)
        assert np.isfinite(said.position_m).all()
        loss = model.loss(to_tensors(observed), to_tensors(truth), "nll")
        loss.backward()
        assert torch.isfinite(loss)
        assert neighbors or loss.item() == 0


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), neighbors=st.lists(st.integers(0, 6), min_size=2, max_size=5))
def test_samples_know_nothing_of_each_other(seed, neighbors):
    model = build("cs-lstm-m")
    observed, _ = draw(seed, neighbors)
    order = np.random.default_rng(seed).permutation(len(neighbors))
    mine = [np.flatnonzero(observed.neighbor_sample == sample) for sample in order]
    moved = Observed(
        history=observed.history[order],
        neighbor_history=observed.neighbor_history[np.concatenate(mine)],
        neighbor_mask=observed.neighbor_mask[np.concatenate(mine)],
        neighbor_sample=np.repeat(np.arange(len(order)), [len(each) for each in mine]),
        neighbor_cell=observed.neighbor_cell[np.concatenate(mine)],
    )
    before, after = model.predict(observed), model.predict(moved)
    np.testing.assert_allclose(after.position_m, before.position_m[order], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.density.sigma_m, before.density.sigma_m[order], rtol=1e-9)
    np.testing.assert_allclose(after.lateral, before.lateral[order], rtol=1e-9)


def test_a_neighbor_counts_by_its_cell():
    model = build("cs-lstm")
    observed, _ = draw(6, [1])
    places = []
    for cell in range(39):
        seen = Observed(**{**vars(observed), "neighbor_cell": np.array([cell], dtype=np.int8)})
        places.append(model.predict(seen).position_m)
    different = {place.round(9).tobytes() for place in places}
    # the pool keeps only the greater of two rows, so that not every cell tells; most do
    assert len(different) > 30


def test_a_residual_network_that_says_nothing_goes_on_straight():
    model = build("cs-lstm-m")
    torch.nn.init.zeros_(model.op.weight)
    torch.nn.init.zeros_(model.op.bias)
    observed, _ = draw(7, [3, 2])
    said = model.predict(observed)
    step = -observed.history[:, -2]  # 0.5 s of displacement: one tick at 2 Hz
    straight = np.stack([step * ahead for ahead in range(1, F + 1)], axis=1)
    np.testing.assert_allclose(said.position_m, straight, rtol=1e-6)
    np.testing.assert_allclose(said.density.mean_m, np.repeat(straight[:, None], 6, axis=1), rtol=1e-6)
    np.testing.assert_allclose(said.density.sigma_m, 1.0)


def test_pretraining_leaves_the_heads_alone():
    model = build("cs-lstm-m")
    observed, truth = (to_tensors(arrays) for arrays in draw(8, [3, 2]))
    model.loss(observed, truth, "mse").backward()
    assert model.op_lat.weight.grad is None
    model.loss(observed, truth, "nll").backward()
    assert model.op_lat.weight.grad.abs().max() > 0


def test_an_unknown_phase_is_refused():
    observed, truth = (to_tensors(arrays) for arrays in draw(9, [1]))
    with pytest.raises(ValueError, match="unknown phase `both`"):
        build("cs-lstm").loss(observed, truth, "both")
