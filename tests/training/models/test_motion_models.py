"""Models that need no training: against hand-made motion, and a Kalman filter written out with matrices."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lone_vehicles import TWO_SECONDS, observe, seeds, wander
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import CSP
from tracklake.training.models import MODELS, find_model
from tracklake.training.models.motion import AXES, ConstantTurnRate

PROTOCOLS = (CSP, TWO_SECONDS)
UNTAUGHT = [name for name, model in MODELS.items() if not model.learns]


def times(protocol):
    """Seconds of a history's positions and of a future's; the sample is at 0."""
    ticks = np.arange(1 - protocol.history_ticks, protocol.horizon_ticks + 1) / protocol.rate_hz
    return ticks[: protocol.history_ticks], ticks[protocol.history_ticks :]


def circle(time_s, speed, heading, yaw_rate):
    """Where a vehicle is that passes (0, 0) at time 0 and turns right (across grows) where the yaw rate is positive."""
    radius = speed / yaw_rate
    angle = heading + yaw_rate * time_s
    return radius * np.stack([np.sin(angle) - np.sin(heading), np.cos(heading) - np.cos(angle)], axis=-1)


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
@pytest.mark.parametrize("samples", [0, 1, 7])
@pytest.mark.parametrize("name", UNTAUGHT)
def test_shapes(name, samples, protocol):
    history, _ = wander(np.random.default_rng(samples), protocol, samples)
    said = find_model(name).build(protocol).predict(observe(history))
    ticks = protocol.horizon_ticks
    assert said.position_m.shape == (samples, ticks, 2)
    assert said.position_m.dtype == np.float32
    if said.density is not None:
        assert said.density.weight.shape == (samples, 1)
        assert said.density.mean_m.shape == said.density.sigma_m.shape == (samples, 1, ticks, 2)
        assert said.density.correlation.shape == (samples, 1, ticks)
        assert {part.dtype for part in vars(said.density).values()} == {np.dtype(np.float32)}


@settings(max_examples=10)
@given(seeds, st.sampled_from(UNTAUGHT))
def test_every_sample_for_itself(seed, name):
    draw = np.random.default_rng(seed)
    history, _ = wander(draw, CSP, 9)
    model, order = find_model(name).build(CSP), draw.permutation(9)
    together = model.predict(observe(history)).position_m
    np.testing.assert_array_equal(model.predict(observe(history[order])).position_m, together[order])
    alone = model.predict(observe(history[:1], neighbors=draw.normal(size=(3, CSP.history_ticks, 2)))).position_m
    np.testing.assert_allclose(alone, together[:1], rtol=1e-6)


@settings(max_examples=20)
@given(seeds, st.sampled_from(UNTAUGHT), st.sampled_from(PROTOCOLS))
def test_the_mirrored_road_mirrors_the_prediction(seed, name, protocol):
    history, _ = wander(np.random.default_rng(seed), protocol, 4)
    mirror = np.array([1, -1], dtype=np.float32)
    model = find_model(name).build(protocol)
    here, there = (model.predict(observe(history * side)).position_m for side in (1, mirror))
    np.testing.assert_allclose(there, here * mirror, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.name)
@pytest.mark.parametrize("name", [name for name in UNTAUGHT if name != "damped-velocity"])
@pytest.mark.parametrize("velocity", [(25.0, 0.5), (3.0, -1.0), (0.0, 0.0), (-1.0, 0.0), (1e-6, 0.0)])
def test_what_keeps_its_velocity_goes_on(name, protocol, velocity):
    past, ahead = times(protocol)
    history = past[None, :, None] * np.array(velocity)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        said = find_model(name).build(protocol).predict(observe(history)).position_m
    np.testing.assert_allclose(said[0], ahead[:, None] * np.array(velocity), rtol=1e-4, atol=1e-4)


def test_at_ten_hertz_the_velocity_is_that_of_the_last_two_ticks():
    """x = 0, 1, 3 in the last 0.2 s: (3 - 0) / 2 = 1.5 a tick, neither the last step of 2 nor a longer mean."""
    history = np.zeros((1, TWO_SECONDS.history_ticks, 2))
    history[0, -3:, 0] = (-3, -2, 0)
    history[0, :-3, 0] = 1e6
    said = find_model("constant-velocity").build(TWO_SECONDS).predict(observe(history)).position_m[0]
    assert said[:3].tolist() == [[1.5, 0], [3.0, 0], [4.5, 0]]
    assert said[-1].tolist() == [30.0, 0]


# Constant turn rate


@settings(max_examples=30)
@given(
    st.floats(3, 40),
    st.floats(-np.pi, np.pi),
    st.floats(0.002, 0.5),
    st.sampled_from([-1, 1]),
    st.sampled_from(PROTOCOLS),
)
def test_a_circle_is_continued(speed, heading, turn, side, protocol):
    past, ahead = times(protocol)
    history = circle(past, speed, heading, side * turn)[None]
    said = ConstantTurnRate(protocol).predict(observe(history)).position_m[0]
    # float32 positions are off by up to 4 um: over a chord of 0.6 m or more, that is an angle of 1e-5 at most
    np.testing.assert_allclose(said, circle(ahead, speed, heading, side * turn), atol=5e-3)


def test_a_turn_to_the_right_goes_on_to_the_right():
    past, _ = times(CSP)
    said = ConstantTurnRate(CSP).predict(observe(circle(past, 10.0, 0.0, 0.1)[None])).position_m[0]
    # a quarter of 0.5 rad on a circle of 100 m: 100 sin(0.5) along, 100 (1 - cos(0.5)) to the right
    np.testing.assert_allclose(said[-1], (47.943, 12.242), atol=2e-3)


def test_the_yaw_rate_is_that_of_two_ways_of_a_second():
    """First 10 m straight on, then 10 m 0.2 rad to the right, with only the last chord different: 0.3 rad."""
    way, turn = np.full((16, 2), np.nan), 0.2
    way[15], way[10] = 0.0, -10 * np.array([np.cos(turn), np.sin(turn)])
    way[5] = way[10] - (10.0, 0.0)
    way[14] = -2 * np.array([np.cos(0.3), np.sin(0.3)])  # 0.2 s before: 10 m/s
    way[np.isnan(way)] = 1e6  # what is in between plays no part
    said = ConstantTurnRate(CSP).predict(observe(way[None])).position_m[0]
    heading = 0.3 + turn * 0.1  # that of the last chord's end
    speed = 2 / (2 * np.sin(turn * 0.1) / turn)  # of an arc of 0.2 s whose chord is 2 m
    np.testing.assert_allclose(said, circle(times(CSP)[1], speed, heading, turn), rtol=1e-5)


def test_slow_vehicles_do_not_turn():
    past, ahead = times(CSP)
    slow, quick = (circle(past, speed, 0.0, 0.4)[None] for speed in (1.9, 2.2))
    model, plain = ConstantTurnRate(CSP), find_model("constant-velocity").build(CSP)
    np.testing.assert_allclose(
        model.predict(observe(slow)).position_m, plain.predict(observe(slow)).position_m, rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(model.predict(observe(quick)).position_m[0], circle(ahead, 2.2, 0.0, 0.4), atol=5e-3)


def test_two_positions_tell_of_no_turn():
    short = replace(CSP, history_s=0.2)
    said = ConstantTurnRate(short).predict(observe([[(-2.0, -0.1), (0.0, 0.0)]])).position_m[0]
    np.testing.assert_allclose(said[-1], (50.0, 2.5), rtol=1e-5)


# Damped velocity


def test_a_damped_lateral_velocity_ends_after_its_decay_time():
    """10 m/s along, 0.5 m/s to the right, T = 2 s: 0.5 x 2 (1 - exp(-t / 2)) m to the right, at most 1 m."""
    past, ahead = times(CSP)
    model = find_model("damped-velocity").build(CSP, decay_s=2.0)
    said = model.predict(observe(past[None, :, None] * np.array([10.0, 0.5]))).position_m[0]
    np.testing.assert_allclose(said[:, 0], 10 * ahead, rtol=1e-5)
    np.testing.assert_allclose(said[4], (10.0, 1 - 0.60653), atol=1e-4)  # exp(-1 / 2) = 0.60653
    np.testing.assert_allclose(said[24], (50.0, 1 - 0.08208), atol=1e-4)  # exp(-5 / 2) = 0.08208


@pytest.mark.parametrize(("decay_s", "same"), [(1000.0, 1.0), (0.01, 0.0)])
def test_damping_lies_between_constant_lateral_velocity_and_none(decay_s, same):
    history, _ = wander(np.random.default_rng(0), CSP, 5)
    plain = find_model("constant-velocity").build(CSP).predict(observe(history)).position_m
    damped = find_model("damped-velocity").build(CSP, decay_s=decay_s).predict(observe(history)).position_m
    np.testing.assert_array_equal(damped[..., 0], plain[..., 0])
    np.testing.assert_allclose(damped[..., 1], same * plain[..., 1], rtol=0.01, atol=0.1 * (1 - same))


@pytest.mark.parametrize("model", ["damped-velocity", "kalman-cv"])
def test_parameters_that_allow_no_prediction_are_refused(model):
    for name in MODELS[model].parameters:
        with pytest.raises(UsageError, match=f"`{name}`: expected a number above 0, got 0"):
            find_model(model).build(CSP, **{name: 0.0})


# Kalman filter


def name_noise(measurement_m, acceleration_m2ps3):
    """Parameters of the filter from pairs, along and across the road."""
    return {
        **{f"measurement_{axis}_m": own for axis, own in zip(AXES, measurement_m, strict=True)},
        **{f"acceleration_{axis}_m2ps3": own for axis, own in zip(AXES, acceleration_m2ps3, strict=True)},
    }


def textbook(history, protocol, measurement, density):
    """One axis, with matrices, one position after the other: means and variances of the positions ahead."""
    tick_s = 1 / protocol.rate_hz
    drift = np.array([[0.0, 1.0], [0.0, 0.0]])
    kick = np.array([[0.0, 0.0], [0.0, density]])
    # Van Loan 1978: one exponential holds both the transition and the integral of the noise that passes through it
    both = expm(np.block([[-drift, kick], [np.zeros((2, 2)), drift.T]]) * tick_s)
    move = both[2:, 2:].T
    noise = move @ both[:2, 2:]
    look, r = np.array([[1.0, 0.0]]), np.array([[measurement**2]])
    # the state by the first two positions is a linear map of their errors
    start = np.array([[0.0, 1.0], [-1 / tick_s, 1 / tick_s]])
    state, covariance = start @ history[:2, None], start @ (np.eye(2) * measurement**2) @ start.T
    for position in history[2:]:
        state, covariance = move @ state, move @ covariance @ move.T + noise
        gain = covariance @ look.T @ np.linalg.inv(look @ covariance @ look.T + r)
        state = state + gain @ (position - look @ state)
        left = np.eye(2) - gain @ look
        covariance = left @ covariance @ left.T + gain @ r @ gain.T  # Joseph's form
    means, variances = [], []
    for _ in range(protocol.horizon_ticks):
        state, covariance = move @ state, move @ covariance @ move.T + noise
        means.append((look @ state).item())
        variances.append((look @ covariance @ look.T + r).item())
    return means, variances


@settings(max_examples=8)
@given(
    seeds,
    st.sampled_from((*PROTOCOLS, replace(CSP, history_s=0.2), replace(CSP, history_s=0.4, horizon_s=1.0))),
    st.tuples(st.floats(0.02, 1), st.floats(0.02, 1)),
    st.tuples(st.floats(0.01, 5), st.floats(0.01, 5)),
)
def test_kalman_filter_is_the_textbooks(seed, protocol, measurement, density):
    history, _ = wander(np.random.default_rng(seed), protocol, 2)
    model = find_model("kalman-cv").build(protocol, **name_noise(measurement, density))
    said = model.predict(observe(history))
    for sample in range(2):
        for axis in range(2):
            track = history[sample, :, axis].astype(float)
            means, variances = textbook(track, protocol, measurement[axis], density[axis])
            np.testing.assert_allclose(said.position_m[sample, :, axis], means, rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(said.density.sigma_m[sample, 0, :, axis] ** 2, variances, rtol=1e-5)
    np.testing.assert_array_equal(said.density.mean_m[:, 0], said.position_m)
    np.testing.assert_array_equal(said.density.weight, 1)
    np.testing.assert_array_equal(said.density.correlation, 0)


def test_kalman_densities_fit_what_its_model_makes():
    """Squared distances of the model's own tracks from the mean, in units of the density, are chi-squared."""
    past = CSP.history_ticks
    tracks = draw_tracks(np.random.default_rng(11), 4000, (0.15, 0.10), (1.0, 0.04))
    said = find_model("kalman-cv").build(CSP).predict(observe(tracks[:, :past]))
    away = (tracks[:, past:] - said.position_m) / said.density.sigma_m[:, 0]
    # the mean of 4000 squares of a standard normal is off by sqrt(2 / 4000) = 0.022; ticks and axes are 50 such means
    np.testing.assert_allclose((away**2).mean(axis=0), 1.0, atol=0.1)


def draw_tracks(draw, samples, measurement_m, acceleration_m2ps3):
    """Tracks (S, H + F, 2) drawn from the filter's very model, relative to the last position of the history."""
    tick_s, ticks = 0.2, CSP.history_ticks + CSP.horizon_ticks
    tracks = np.empty((samples, ticks, 2))
    for axis in range(2):
        density = acceleration_m2ps3[axis]
        noise = density * np.array([[tick_s**3 / 3, tick_s**2 / 2], [tick_s**2 / 2, tick_s]])
        kicks = multivariate_normal(cov=noise).rvs((samples, ticks), random_state=draw)
        velocity = 20 + np.cumsum(kicks[..., 1], axis=1)
        before = np.concatenate([np.full((samples, 1), 20.0), velocity[:, :-1]], axis=1)
        tracks[..., axis] = np.cumsum(before * tick_s + kicks[..., 0], axis=1)
    tracks += draw.normal(size=tracks.shape) * measurement_m
    return tracks - tracks[:, CSP.history_ticks - 1][:, None]


def test_kalman_uncertainty_grows():
    sigma = find_model("kalman-cv").build(CSP).sigma_m
    assert (np.diff(sigma, axis=0) > 0).all()
    assert (sigma[:, 0] > sigma[:, 1]).all()
    # of the acceleration alone, q T^3 / 3 after 5 s: 6.5 m and 1.3 m; the rest comes from the state and the measurement
    np.testing.assert_allclose(sigma[-1], (6.9, 1.45), atol=0.4)
    assert (sigma[-1] > (6.45, 1.29)).all()
