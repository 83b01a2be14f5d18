"""The filter and smoother over many vehicles against a plain one, vehicle by vehicle and step by step."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.onboard.kalman import (
    STATES,
    compute_smoother_gains,
    make_noise,
    make_transition,
    predict,
    smooth,
    update,
)


def filter_plainly(x, p, f, q, measurements):
    """The textbook's filter and RTS smoother of one vehicle; None = no measurement at a step."""
    states, covariances, predicted = [], [], []
    for step, found in enumerate(measurements):
        if step:
            x, p = f @ x, f @ p @ f.T + q
        predicted.append((x, p))
        if found is not None:
            z, h, r = found
            s = h @ p @ h.T + r
            k = p @ h.T @ np.linalg.inv(s)
            x = x + k @ (z - h @ x)
            p = (np.eye(len(x)) - k @ h) @ p
        states.append(x)
        covariances.append(p)
    smoothed = [states[-1]]
    for step in range(len(states) - 2, -1, -1):
        c = covariances[step] @ f.T @ np.linalg.inv(predicted[step + 1][1])
        smoothed.insert(0, states[step] + c @ (smoothed[0] - predicted[step + 1][0]))
    return np.array(states), np.array(covariances), np.array(smoothed)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), vehicles=st.integers(1, 4), steps=st.integers(1, 12))
def test_all_vehicles_at_once_are_each_vehicle_alone(seed, vehicles, steps):
    draw = np.random.default_rng(seed)
    f, q = make_transition(0.1), make_noise(0.1, np.full(vehicles, 2.0), draw.uniform(0.01, 0.1, vehicles))
    x, root = draw.normal(0, 3, (vehicles, STATES)), draw.normal(0, 1, (vehicles, STATES, STATES))
    p = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(STATES)
    h, r = draw.normal(0, 1, (vehicles, 2, STATES)), np.tile(np.diag([0.04, 0.09]), (vehicles, 1, 1))
    z, given_at = draw.normal(0, 5, (steps, vehicles, 2)), draw.random((steps, vehicles)) < 0.6
    first, covariance = x.copy(), p.copy()
    states, covariances = [], []
    for step in range(steps):
        if step:
            x, p = predict(x, p, f, q)
        rows = np.flatnonzero(given_at[step])
        x[rows], p[rows], _ = update(x[rows], p[rows], z[step, rows], h[rows], r[rows])
        states.append(x.copy())
        covariances.append(p.copy())
    rows_x, rows_p = np.concatenate(states), np.concatenate(covariances)
    gains = compute_smoother_gains(rows_p, f, np.tile(q, (steps, 1, 1)))
    later = smooth(rows_x, gains, f, np.repeat(np.arange(steps), vehicles), np.tile(np.arange(vehicles), steps))
    for one in range(vehicles):
        found = [(z[k, one], h[one], r[one]) if given_at[k, one] else None for k in range(steps)]
        plain_x, plain_p, plain_s = filter_plainly(first[one], covariance[one], f, q[one], found)
        np.testing.assert_allclose(rows_x.reshape(steps, vehicles, -1)[:, one], plain_x, atol=1e-6)
        np.testing.assert_allclose(rows_p.reshape(steps, vehicles, STATES, STATES)[:, one], plain_p, atol=1e-6)
        np.testing.assert_allclose(later.reshape(steps, vehicles, -1)[:, one], plain_s, atol=1e-5)


def test_smoother_keeps_chains_apart():
    """Chain 7 ends at step 1 and chain 9 begins at step 2; a gap of steps is not bridged."""
    f = make_transition(0.1)
    step, chain = np.array([0, 0, 1, 1, 2, 2, 5]), np.array([3, 7, 3, 7, 3, 9, 3])
    state = np.arange(7 * STATES, dtype=float).reshape(7, STATES)
    p = np.tile(np.eye(STATES), (7, 1, 1))
    gains = compute_smoother_gains(p, f, make_noise(0.1, np.full(7, 2.0), np.full(7, 0.1)))
    later = smooth(state, gains, f, step, chain)
    assert np.array_equal(later[[4, 5, 6]], state[[4, 5, 6]])  # nothing follows them at the next step
    assert np.array_equal(later[3], state[3])  # the end of chain 7
    expected = state[2] + gains[2] @ (state[4] - f @ state[2])
    np.testing.assert_allclose(later[2], expected)
    np.testing.assert_allclose(later[1], state[1] + gains[1] @ (state[3] - f @ state[1]))


def test_step_by_hand():
    """At 10 m/s and 2 m/s2, 0.1 s on: 1.01 m further, 10.2 m/s; the acceleration fades by exp(-0.05)."""
    state = np.zeros((1, STATES))
    state[0, [2, 4, 6]] = 10.0, 2.0, 1.5
    after, _ = predict(state, np.zeros((1, STATES, STATES)), make_transition(0.1), np.zeros((1, STATES, STATES)))
    assert np.allclose(after[0, [0, 2, 4, 6]], [1.01, 10.2, 2 * np.exp(-0.05), 1.5 * np.exp(-0.1 / 45)])


def test_outlier_counts_less():
    state, p = np.zeros((2, STATES)), np.tile(np.eye(STATES), (2, 1, 1))
    h, r = np.tile(np.eye(1, STATES), (2, 1, 1)), np.ones((2, 1, 1))
    free, _, distance = update(state, p, np.array([[1.0], [100.0]]), h, r)
    held, _, _ = update(state, p, np.array([[1.0], [100.0]]), h, r, limit=9.0)
    assert np.allclose(free[:, 0], [0.5, 50.0])
    assert np.allclose(distance, [0.5, 5000.0])
    assert held[0, 0] == free[0, 0]
    assert held[1, 0] < 1.0


def test_no_vehicles():
    none, covariance = np.empty((0, STATES)), np.empty((0, STATES, STATES))
    x, p = predict(none, covariance, make_transition(0.1), make_noise(0.1, np.empty(0), np.empty(0)))
    x, p, _ = update(x, p, np.empty((0, 2)), np.empty((0, 2, STATES)), np.empty((0, 2, 2)))
    assert x.shape == (0, STATES)
    assert p.shape == (0, STATES, STATES)
