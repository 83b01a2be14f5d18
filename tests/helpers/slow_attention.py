"""The attention network once more, in float64: loops over scenes, heads, vehicles and lanes, and nothing else."""

import math

import numpy as np


def linear(weights, name, row):
    return weights[f"{name}.weight"] @ row + weights[f"{name}.bias"]


def perceptron(weights, name, row):
    if f"{name}.2.weight" not in weights:
        return linear(weights, f"{name}.0", row)
    return linear(weights, f"{name}.2", np.maximum(linear(weights, f"{name}.0", row), 0))


def attend(weights, name, heads, width, queries, keys):
    """Rows after attention, residual and normalisation, and the weights [head][query][key]."""
    out, maps = [], [[] for _ in range(heads)]
    for row in queries:
        joined = []
        for head in range(heads):
            cut = slice(head * width, (head + 1) * width)
            query = linear(weights, f"{name}.query", row)[cut]
            scores = [query @ linear(weights, f"{name}.key", key)[cut] / math.sqrt(width) for key in keys]
            powers = [math.exp(score - max(scores)) for score in scores]
            attention = [each / sum(powers) for each in powers]
            maps[head].append(attention)
            values = [linear(weights, f"{name}.value", key)[cut] for key in keys]
            joined.extend(sum((share * value for share, value in zip(attention, values, strict=True)), np.zeros(width)))
        found = linear(weights, f"{name}.back", np.array(joined)) if keys else 0
        summed = row + found
        scaled = (summed - summed.mean()) / math.sqrt(summed.var() + 1e-6)
        out.append(scaled * weights[f"{name}.norm.weight"] + weights[f"{name}.norm.bias"])
    return out, maps


def find_velocity(history, known, ticks):
    """m per tick over the last `ticks` ticks, or as many as are known; None where none is."""
    steps = 0
    while steps < ticks and known[-2 - steps]:
        steps += 1
    return None if steps == 0 else (history[-1] - history[-1 - steps]) / steps


def restate(weights, observed, heads, *, ticks, rate_hz, horizon_ticks, residual, positions=False):
    """Per scene: (vehicles that are there, their means (n, F, 2), covariances (n, F, 2, 2), three lists of weights)."""
    reported = []
    for scene in range(len(observed.history)):
        there = np.flatnonzero(observed.vehicle_mask[scene])
        histories = [observed.history[scene, v].astype(np.float64) for v in there]
        known = [observed.history_mask[scene, v] for v in there]
        own = [find_velocity(history, mask, ticks) for history, mask in zip(histories, known, strict=True)]
        others = [each for each in own if each is not None]
        velocities = [sum(others) / len(others) if each is None else each for each in own]
        embedded = []
        for v, history, mask, velocity in zip(there, histories, known, velocities, strict=True):
            numbers = [history[-1][0] / 50, history[-1][1] / 5, velocity[0] * rate_hz / 15, velocity[1] * rate_hz]
            for k in range(len(history)):
                away = history[k] - (history[-1] + (k - len(history) + 1) * velocity)
                numbers += [away[0] / 5, away[1]] if mask[k] else [0, 0]
            numbers += [float(each) for each in mask]
            numbers += [observed.size_m[scene, v, 0] / 5, observed.size_m[scene, v, 1] / 2]
            if positions:  # in m; before it came, the first one that is known
                first = list(mask).index(True)
                numbers = [each for k in range(len(history)) for each in history[max(k, first)]]
                numbers += list(observed.size_m[scene, v])
            embedded.append(perceptron(weights, "embed_vehicle", np.array(numbers, dtype=np.float64)))
        lanes = [
            linear(weights, "embed_lane", np.array([offset / 4, width / 4, 1.0]))
            for offset, width, exists in observed.lanes[scene].astype(np.float64)
            if exists
        ]
        to_vehicles, first = attend(weights, "vehicle_attention", heads, 8, embedded, embedded)
        to_lanes, second = attend(weights, "lane_attention", heads, 32, embedded, lanes)
        encoded = [np.concatenate(pair) for pair in zip(to_vehicles, to_lanes, strict=True)]
        decoded, third = attend(weights, "decoder", heads, 8, encoded, encoded)
        means, covariances = [], []
        for row, history, velocity in zip(decoded, histories, velocities, strict=True):
            raw = perceptron(weights, "out", row).reshape(horizon_ticks, 5)
            mean, covariance = [], []
            for step in range(horizon_ticks):
                along, across, sharp_along, sharp_across, tilt = raw[step]
                straight = history[-1] + (step + 1) * velocity if residual else 0
                mean.append(straight + np.array([along, across]))
                sx, sy, rho = math.exp(-sharp_along), math.exp(-sharp_across), math.tanh(tilt)
                covariance.append([[sx * sx, rho * sx * sy], [rho * sx * sy, sy * sy]])
            means.append(mean)
            covariances.append(covariance)
        reported.append((there, np.array(means), np.array(covariances), (first, second, third)))
    return reported
