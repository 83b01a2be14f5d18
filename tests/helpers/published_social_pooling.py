"""Convolutional social pooling as it was published, stated once more: one sample at a time, with loops, in NumPy.

Written from the paper and the layers' definitions; it shares no code with the model, only the names of the weights.
"""

import numpy as np

ROWS, COLUMNS = 13, 3


def sigmoid(value):
    return 1 / (1 + np.exp(-value))


def leaky(value):
    return np.where(value > 0, value, 0.1 * value)


def run_lstm(weights, name, inputs):
    """The state after each tick; gates stand as in, forget, candidate, out."""
    of_input, of_state = weights[f"{name}.weight_ih_l0"], weights[f"{name}.weight_hh_l0"]
    bias = weights[f"{name}.bias_ih_l0"] + weights[f"{name}.bias_hh_l0"]
    size = of_state.shape[1]
    state, cell, states = np.zeros(size), np.zeros(size), []
    for given in inputs:
        gates = of_input @ given + of_state @ state + bias
        into, forget = sigmoid(gates[:size]), sigmoid(gates[size : 2 * size])
        candidate, out = np.tanh(gates[2 * size : 3 * size]), sigmoid(gates[3 * size :])
        cell = forget * cell + into * candidate
        state = out * np.tanh(cell)
        states.append(state)
    return states


def convolve(image, kernel, bias):
    """(C, h, w), (D, C, kh, kw), (D,) -> (D, h - kh + 1, w - kw + 1)."""
    depth, _, high, wide = kernel.shape
    made = np.zeros((depth, image.shape[1] - high + 1, image.shape[2] - wide + 1))
    for top in range(made.shape[1]):
        for left in range(made.shape[2]):
            seen = image[:, top : top + high, left : left + wide]
            for output in range(depth):
                made[output, top, left] = (seen * kernel[output]).sum() + bias[output]
    return made


def pool_by_two_rows(image):
    """Greatest of two rows after one row of nothing above and below."""
    edge = np.full((image.shape[0], 1, image.shape[2]), -np.inf)
    padded = np.concatenate([edge, image, edge], axis=1)
    return np.stack([padded[:, at : at + 2].max(axis=1) for at in range(0, padded.shape[1] - 1, 2)], axis=1)


def encode(weights, history, neighbors):
    """112 numbers of one sample; `neighbors` are (cell, history)."""

    def last_state(positions):
        embedded = [leaky(weights["ip_emb.weight"] @ position + weights["ip_emb.bias"]) for position in positions]
        return run_lstm(weights, "enc_lstm", embedded)[-1]

    lanes = np.zeros((COLUMNS, ROWS, 64))  # as the published reader lays them out: lane by lane, from behind
    for cell, positions in neighbors:
        lanes[cell // ROWS, cell % ROWS] = last_state(positions)
    image = lanes.transpose(2, 1, 0)  # features, 13 rows along the road, 3 lanes
    image = leaky(convolve(image, weights["soc_conv.weight"], weights["soc_conv.bias"]))
    image = leaky(convolve(image, weights["conv_3x1.weight"], weights["conv_3x1.bias"]))
    own = leaky(weights["dyn_emb.weight"] @ last_state(history) + weights["dyn_emb.bias"])
    return np.concatenate([pool_by_two_rows(image).reshape(-1), own])


def decode(weights, given, steps):
    """(F, 5): means, standard deviations and correlation; the network says the logarithm of 1 / sigma."""
    raw = [
        weights["op.weight"] @ state + weights["op.bias"] for state in run_lstm(weights, "dec_lstm", [given] * steps)
    ]
    return np.array([[r[0], r[1], 1 / np.exp(r[2]), 1 / np.exp(r[3]), np.tanh(r[4])] for r in raw])


def recognise(weights, encoding, head):
    """Probabilities of the maneuvers of one kind."""
    powers = np.exp(weights[f"{head}.weight"] @ encoding + weights[f"{head}.bias"])
    return powers / powers.sum()


def with_maneuver(encoding, lateral, longitudinal):
    return np.concatenate([encoding, np.eye(3)[lateral], np.eye(2)[longitudinal]])
