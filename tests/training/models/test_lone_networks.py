"""Networks that look at one vehicle alone: sizes, shapes, what they must not depend on, and that they learn."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lone_vehicles import TWO_SECONDS, observe, reveal, seeds, wander
from scipy.stats import multivariate_normal

from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import CSP
from tracklake.training.models import MODELS, find_model
from tracklake.training.models.network import Straight

LONE = ("lstm", "v-lstm", "stacked-lstm", "lstm-encoder-decoder")
PHASES = [(name, phase.loss) for name in LONE for phase in MODELS[name].recipe.phases]
PROTOCOLS = (CSP, TWO_SECONDS)
H, F = CSP.history_ticks, CSP.horizon_ticks


def build(name, protocol=CSP, seed=0, **parameters):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return find_model(name).build(protocol, **parameters)


def to_tensors(arrays):
    return arrays.each(torch.from_numpy)


def lstm(inputs, hidden):
    """Weights of one LSTM layer: four gates of each unit see the inputs, the units before, and have two biases."""
    return 4 * hidden * (inputs + hidden + 2)


def linear(inputs, outputs):
    return outputs * (inputs + 1)


SIZES = {
    "lstm": lstm(6, 48) + lstm(48, 48) + linear(48, 2),
    "v-lstm": linear(2, 32) + lstm(32, 64) + linear(64, 32) + lstm(32, 128) + linear(128, 5),
    "stacked-lstm": lstm(2, 128) + lstm(128, 128) + linear(128, 25 * 2),
    "lstm-encoder-decoder": linear(2, 256) + 4 * lstm(256, 256) + linear(256, 256) + linear(256, 2),
}


@pytest.mark.parametrize("name", LONE)
def test_layers_are_as_large_as_published(name):
    network = build(name)
    assert sum(weights.numel() for weights in network.parameters()) == SIZES[name]
    assert set(network.state_dict()) == {own for own, _ in network.named_parameters()}  # and checkpoints hold no more


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
@pytest.mark.parametrize("samples", [0, 1, 3])
@pytest.mark.parametrize("name", LONE)
def test_shapes(name, samples, protocol):
    history, _ = wander(np.random.default_rng(samples), protocol, samples)
    said, ticks = build(name, protocol).predict(observe(history)), protocol.horizon_ticks
    assert said.position_m.shape == (samples, ticks, 2)
    assert said.position_m.dtype == np.float32
    assert said.lateral is None
    assert said.longitudinal is None
    assert (said.density is not None) == (name == "v-lstm")
    if said.density is not None:
        assert said.density.weight.shape == (samples, 1)
        assert said.density.mean_m.shape == said.density.sigma_m.shape == (samples, 1, ticks, 2)
        assert said.density.correlation.shape == (samples, 1, ticks)
        np.testing.assert_array_equal(said.density.weight, 1)
        np.testing.assert_array_equal(said.density.mean_m[:, 0], said.position_m)


@settings(max_examples=10)
@given(seeds, st.sampled_from(LONE))
def test_every_sample_for_itself(seed, name):
    draw = np.random.default_rng(seed)
    history, _ = wander(draw, CSP, 5)
    network, order = build(name), draw.permutation(5)
    together = network.predict(observe(history)).position_m
    np.testing.assert_allclose(network.predict(observe(history[order])).position_m, together[order], atol=1e-4)
    alone = network.predict(observe(history[:1], neighbors=draw.normal(size=(3, H, 2)))).position_m
    np.testing.assert_allclose(alone, together[:1], atol=1e-4)


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
def test_straight_is_constant_velocity_or_nothing(protocol):
    history, _ = wander(np.random.default_rng(4), protocol, 6)
    plain = find_model("constant-velocity").build(protocol).predict(observe(history)).position_m
    straight = Straight(protocol, anchoring="both")
    np.testing.assert_array_equal(straight(torch.from_numpy(history)), plain)
    scene = torch.from_numpy(history).unflatten(0, (2, 3))  # vehicles of scenes
    np.testing.assert_array_equal(straight(scene), plain.reshape(2, 3, protocol.horizon_ticks, 2))
    nothing = Straight(protocol, anchoring="none")(torch.from_numpy(history))
    np.testing.assert_array_equal(nothing, np.zeros_like(plain))


def test_straight_takes_two_ticks_at_ten_hertz():
    """x = 0, 1, 3 in the last 0.2 s: 1.5 a tick."""
    history = torch.full((1, TWO_SECONDS.history_ticks, 2), 1e6)
    history[0, -3:] = torch.tensor([[-3.0, 0.5], [-2.0, 7.0], [0.0, 0.0]])
    places = Straight(TWO_SECONDS, anchoring="both")(history)[0]
    assert places[:2].tolist() == [[1.5, -0.25], [3.0, -0.5]]


@pytest.mark.parametrize("name", LONE)
def test_anchoring_shifts_the_places_on_its_axes_and_nothing_else(name):
    history, _ = wander(np.random.default_rng(5), CSP, 4)
    plain = find_model("constant-velocity").build(CSP).predict(observe(history)).position_m
    free = build(name, anchoring="none").predict(observe(history))
    assert np.abs(free.position_m).max() < 5  # untrained, it places next to nothing
    for anchoring, axes in (("both", (1, 1)), ("longitudinal", (1, 0)), ("lateral", (0, 1))):
        shifted = build(name, anchoring=anchoring).predict(observe(history))
        np.testing.assert_allclose(shifted.position_m, free.position_m + plain * axes, atol=1e-4)
        if free.density is not None:
            np.testing.assert_array_equal(shifted.density.sigma_m, free.density.sigma_m)
            np.testing.assert_array_equal(shifted.density.correlation, free.density.correlation)


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if "anchoring" in model.parameters])
def test_residual_is_the_former_name_of_anchoring(name):
    model = MODELS[name]
    assert [model.complete({"residual": own})["anchoring"] for own in (True, False)] == ["both", "none"]
    assert "residual" not in model.complete({"residual": True})
    for chosen, expected in (
        ({"residual": "yes"}, "`residual`: expected bool"),
        ({"residual": True, "anchoring": "both"}, "give one of them"),
        ({"anchoring": "sideways"}, "`anchoring`: expected one of both, longitudinal, lateral, none, got 'sideways'"),
    ):
        with pytest.raises(UsageError, match=expected):
            build(name, **chosen)


def test_the_lstm_is_at_first_constant_velocity():
    history, _ = wander(np.random.default_rng(6), CSP, 4)
    plain = find_model("constant-velocity").build(CSP).predict(observe(history)).position_m
    np.testing.assert_allclose(build("lstm").predict(observe(history)).position_m, plain, rtol=1e-5, atol=1e-5)


class Written:
    """A network's layers written out in NumPy, for one sample, one tick at a time."""

    def __init__(self, network):
        self.weight = {name: tensor.numpy().astype(float) for name, tensor in network.state_dict().items()}

    def dense(self, layer, values):
        return self.weight[f"{layer}.weight"] @ values + self.weight[f"{layer}.bias"]

    def cell(self, layer, fed, hidden, memory, number=0):
        gates = self.weight[f"{layer}.weight_ih_l{number}"] @ fed + self.weight[f"{layer}.bias_ih_l{number}"]
        gates = gates + self.weight[f"{layer}.weight_hh_l{number}"] @ hidden + self.weight[f"{layer}.bias_hh_l{number}"]
        enter, forget, new, leave = np.split(gates, 4)
        memory = sigmoid(forget) * memory + sigmoid(enter) * np.tanh(new)
        return sigmoid(leave) * np.tanh(memory), memory

    def stack(self, layer, fed, states):
        """Two layers, the second fed what the first puts out; their states (hidden, memory) are changed in place."""
        for number in (0, 1):
            states[number] = self.cell(layer, fed, *states[number], number=number)
            fed = states[number][0]
        return fed


def sigmoid(values):
    return 1 / (1 + np.exp(-values))


def leaky(values):
    return np.where(values < 0, 0.1 * values, values)


def step_by_step(network, history):
    """The vanilla LSTM: five raw numbers per step."""
    written = Written(network)
    hidden, memory = np.zeros(64), np.zeros(64)
    for position in history.astype(float):
        hidden, memory = written.cell("encoder", leaky(written.dense("embedding", position)), hidden, memory)
    encoding = leaky(written.dense("dynamics", hidden))
    hidden, memory, raw = np.zeros(128), np.zeros(128), []
    for _ in range(F):
        hidden, memory = written.cell("decoder", encoding, hidden, memory)
        raw.append(written.dense("out", hidden))
    return np.array(raw)


def step_through_stacked(network, history):
    """The stacked LSTM: all places at once, from the second layer's last state."""
    written, states = Written(network), [(np.zeros(128), np.zeros(128)) for _ in range(2)]
    for position in history.astype(float):
        last = written.stack("encoder", position, states)
    return written.dense("out", last).reshape(F, 2)


def step_through_encoder_decoder(network, history):
    """The encoder-decoder: a place per step, the decoder always fed the encoder's last output."""
    written, states = Written(network), [(np.zeros(256), np.zeros(256)) for _ in range(2)]
    for position in history.astype(float):
        last = written.stack("encoder", np.maximum(written.dense("embedding", position), 0), states)
    places = []
    for _ in range(F):
        decoded = written.stack("decoder", last, states)
        places.append(written.dense("place", np.maximum(written.dense("output", decoded), 0)))
    return np.array(places)


def step_through_recursive_decoder(network, history):
    """The encoder-decoder as published: the decoder is fed the place that it put out before, at first (0, 0)."""
    written, states = Written(network), [(np.zeros(256), np.zeros(256)) for _ in range(2)]
    for position in history.astype(float):
        written.stack("encoder", np.maximum(written.dense("embedding", position), 0), states)
    places = [np.zeros(2)]
    for _ in range(F):
        fed = np.maximum(written.dense("embedding_of_place", places[-1]), 0)
        decoded = written.stack("decoder", fed, states)
        places.append(written.dense("place", np.maximum(written.dense("output", decoded), 0)))
    return np.array(places[1:])


@pytest.mark.parametrize("residual", [False, True])
def test_recursive_decoder_is_its_description(residual):
    history, _ = wander(np.random.default_rng(13), CSP, 2)
    network = build("lstm-encoder-decoder", recursive=True, residual=residual)
    with torch.no_grad():
        for weights in network.parameters():
            weights *= 2
    said = network.predict(observe(history)).position_m
    for sample in range(2):
        straight = np.arange(1, F + 1)[:, None] * (history[sample, -1] - history[sample, -2]) if residual else 0
        written = step_through_recursive_decoder(network, history[sample])
        np.testing.assert_allclose(said[sample], straight + written, atol=1e-4)


def test_as_published_sets_the_parameters_of_the_publication():
    published = {
        "v-lstm": {"anchoring": "none"},
        "stacked-lstm": {"anchoring": "none", "hidden": 256},
        "lstm-encoder-decoder": {"anchoring": "none", "recursive": True},
        "cs-lstm-m": {
            "anchoring": "none",
            "short_histories": False,
            "maneuver_loss": "binary",
            "maneuvers": True,
        },
    }
    for name, expected in published.items():
        model = MODELS[name]
        assert model.complete({"as_published": True}) == expected
        assert model.complete({}) == model.complete({"as_published": False}) == dict(model.parameters)
        assert model.settings == {**model.parameters, "as_published": False, "residual": True}
    mixed = MODELS["stacked-lstm"].complete({"as_published": True, "hidden": 64})
    assert mixed == {"anchoring": "none", "hidden": 64}, "what is given itself counts"
    assert sum(each.numel() for each in build("stacked-lstm", as_published=True).parameters()) == (
        lstm(2, 256) + lstm(256, 256) + linear(256, 25 * 2)
    )
    for name, value in (("v-lstm", "yes"), ("ctrv", True)):
        with pytest.raises(UsageError, match="as_published"):
            build(name, as_published=value)


def test_what_as_published_sets_is_a_parameter_of_another_value():
    for model in MODELS.values():
        assert all(type(model.parameters[name]) is type(value) for name, value in model.published.items())
        assert all(model.parameters[name] != value for name, value in model.published.items())
        assert bool(model.published) == bool(model.differs)


@pytest.mark.parametrize(
    ("name", "written"),
    [("stacked-lstm", step_through_stacked), ("lstm-encoder-decoder", step_through_encoder_decoder)],
)
@pytest.mark.parametrize("residual", [False, True])
def test_stacked_networks_are_their_description(name, written, residual):
    history, _ = wander(np.random.default_rng(11), CSP, 2)
    network = build(name, residual=residual)
    with torch.no_grad():
        for weights in network.parameters():
            weights *= 2  # states far enough from 0 that nothing of it is nearly linear
    said = network.predict(observe(history)).position_m
    ahead = np.arange(1, F + 1)[:, None]
    for sample in range(2):
        straight = ahead * (history[sample, -1] - history[sample, -2]) if residual else 0  # 0.2 s are one tick at 5 Hz
        np.testing.assert_allclose(said[sample], straight + written(network, history[sample]), atol=1e-4)


def test_vanilla_lstm_is_its_description():
    history, future = wander(np.random.default_rng(7), CSP, 2)
    network = build("v-lstm", residual=False)
    with torch.no_grad():
        network.out.weight *= 5  # far enough from 0 to tell logarithm and tanh apart
    said = network.predict(observe(history))
    logs = []
    for sample in range(2):
        raw = step_by_step(network, history[sample])
        sigma, rho = 1 / np.exp(raw[:, 2:4]), np.tanh(raw[:, 4])
        np.testing.assert_allclose(said.position_m[sample], raw[:, :2], atol=1e-4)
        np.testing.assert_allclose(said.density.sigma_m[sample, 0], sigma, rtol=1e-4)
        np.testing.assert_allclose(said.density.correlation[sample, 0], rho, atol=1e-4)
        for tick in range(F):
            (a, b), c = sigma[tick], rho[tick] * sigma[tick].prod()
            logs.append(multivariate_normal([*raw[tick, :2]], [[a * a, c], [c, b * b]]).logpdf(future[sample, tick]))
    truth = reveal(future, np.random.default_rng(0), known=1.0)
    loss = network.loss(to_tensors(observe(history)), to_tensors(truth), "nll")
    np.testing.assert_allclose(loss.item(), -np.mean(logs), rtol=1e-4)


@pytest.mark.parametrize(("name", "phase"), PHASES)
def test_gradients_are_finite_and_reach_every_weight(name, phase):
    draw = np.random.default_rng(8)
    history, future = wander(draw, CSP, 6)
    history[0], future[0] = 0.0, 0.0  # a vehicle at a standstill
    network = build(name)
    with torch.no_grad():  # the small one starts with a last layer of zeros, behind which nothing gets a gradient
        for weights in network.parameters():
            weights += 0.01
    network.loss(to_tensors(observe(history)), to_tensors(reveal(future, draw, known=0.5)), phase).backward()
    gradients = {own: weights.grad for own, weights in network.named_parameters()}
    if (name, phase) == ("v-lstm", "mse"):  # sigma and rho wait for the second phase
        assert not gradients["out.weight"][2:].any()
        gradients["out.weight"], gradients["out.bias"] = gradients["out.weight"][:2], gradients["out.bias"][:2]
    for own, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), own
        assert gradient.any(), own


@pytest.mark.parametrize("name", LONE)
def test_what_is_not_known_of_the_future_teaches_nothing(name):
    draw = np.random.default_rng(9)
    history, future = wander(draw, CSP, 6)
    truth = reveal(future, draw, known=0.0)
    garbled = replace(truth, future=np.where(truth.future_mask[..., None], future, np.float32(1e4)))
    network, seen = build(name), to_tensors(observe(history))
    for phase in MODELS[name].recipe.phases:
        true, other = (network.loss(seen, to_tensors(reported), phase.loss).item() for reported in (truth, garbled))
        assert true == other


@pytest.mark.parametrize("name", LONE)
def test_an_unknown_phase_is_refused(name):
    history, future = wander(np.random.default_rng(10), CSP, 2)
    truth = reveal(future, np.random.default_rng(0))
    with pytest.raises(ValueError, match="unknown phase `both` of training: expected one of mse"):
        build(name).loss(to_tensors(observe(history)), to_tensors(truth), "both")


def change_speed(samples):
    """Histories and futures of vehicles that brake where they are fast and accelerate where they are slow."""
    speed = np.linspace(5, 30, samples)[:, None]
    acceleration = np.where(speed > 17, -1.5, 1.0)
    time_s = np.arange(1 - H, F + 1) / CSP.rate_hz
    along = speed * time_s + acceleration / 2 * time_s**2
    track = np.stack([along, np.zeros_like(along)], axis=-1).astype(np.float32)
    return track[:, :H], track[:, H:]


def course(name, phase, *, steps, seed=0):
    """Losses of a few steps on the same 8 samples."""
    history, future = change_speed(8)
    seen, truth = to_tensors(observe(history)), to_tensors(reveal(future, np.random.default_rng(12)))
    network = build(name, seed=seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    losses = []
    for _ in range(steps):
        loss = network.loss(seen, truth, phase)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
        losses.append(loss.item())
    return losses


@pytest.mark.parametrize(("name", "phase"), PHASES)
def test_training_makes_the_loss_smaller(name, phase):
    losses = course(name, phase, steps=30)
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("name", LONE)
def test_the_seed_decides_everything(name):
    one, again = (course(name, "mse", steps=2, seed=1) for _ in range(2))
    other = course(name, "mse", steps=2, seed=2)
    assert one == again
    assert one[1] != other[1]  # the first loss of the small one is that of constant velocity, whatever the seed
