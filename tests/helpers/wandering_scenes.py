"""Scenes made by hand: vehicles on curves of their own, with short histories, empty rows and absent lanes."""

from dataclasses import fields

import numpy as np

from tracklake.schemas.protocols import CSP
from tracklake.training.data.observed import ObservedScene, Truth

H, F = CSP.history_ticks, CSP.horizon_ticks


def wander(seed, scenes, vehicles, *, present=0.8, protocol=CSP):
    """(ObservedScene, Truth) of NumPy arrays; the ego is always there, with a whole history."""
    random = np.random.default_rng(seed)
    history_ticks, horizon_ticks = protocol.history_ticks, protocol.horizon_ticks
    place = random.normal(0, (30, 4), (scenes, vehicles, 1, 2))
    place[:, :1] = 0
    velocity = random.normal((20, 0), (5, 0.5), (scenes, vehicles, 1, 2)) / protocol.rate_hz
    pull = random.normal(0, (0.02, 0.005), (scenes, vehicles, 1, 2))
    tick = np.arange(1 - history_ticks, horizon_ticks + 1, dtype=np.float64)[:, None]
    path = place + velocity * tick + pull * tick**2
    vehicle_mask = random.random((scenes, vehicles)) < present
    vehicle_mask[:, :1] = True
    known = random.integers(1, history_ticks + 1, (scenes, vehicles))
    known[:, :1] = history_ticks
    came = random.integers(0, horizon_ticks + 1, (scenes, vehicles))
    history_mask = np.arange(history_ticks) >= (history_ticks - known)[..., None]
    future_mask = np.arange(horizon_ticks) < came[..., None]
    first = np.maximum(np.arange(history_ticks), (history_ticks - known)[..., None])
    history = np.take_along_axis(path[:, :, :history_ticks], first[..., None], axis=2)
    there = vehicle_mask[..., None]
    exists = random.random((scenes, 3)) < 0.8
    lanes = np.stack([random.normal([-4, 0, 4], 0.5, (scenes, 3)), random.uniform(3, 4, (scenes, 3)), exists], axis=-1)
    observed = ObservedScene(
        history=(history * there[..., None]).astype(np.float32),
        history_mask=history_mask & there,
        vehicle_mask=vehicle_mask,
        size_m=(random.uniform((4, 1.6), (16, 2.5), (scenes, vehicles, 2)) * there).astype(np.float32),
        lanes=(lanes * exists[..., None]).astype(np.float32),
        all_lanes=np.concatenate([lanes - [8, 0, 0], lanes[:, :2] + [4, 0, 0]], axis=1).astype(np.float32)
        * np.concatenate([exists, exists[:, :2]], axis=1)[..., None],
    )
    truth = Truth(
        future=(path[:, :, history_ticks:] * there[..., None]).astype(np.float32),
        future_mask=future_mask & there,
        lateral=random.integers(0, 3, scenes).astype(np.uint8),
        longitudinal=random.integers(0, 2, scenes).astype(np.uint8),
    )
    return observed, truth


def change(arrays, **new):
    """The same with some arrays replaced."""
    return type(arrays)(**{**{own.name: getattr(arrays, own.name) for own in fields(arrays)}, **new})


def reorder(observed, order):
    """Vehicles in another order."""
    return change(
        observed,
        **{name: getattr(observed, name)[:, order] for name in ("history", "history_mask", "vehicle_mask", "size_m")},
    )


def pad(observed, rows, filling):
    """`rows` more vehicles that are not there, of whatever numbers, at the end."""
    scenes = len(observed.history)

    def more(array, value):
        return np.concatenate([array, np.full((scenes, rows, *array.shape[2:]), value, array.dtype)], axis=1)

    return change(
        observed,
        history=more(observed.history, filling),
        history_mask=more(observed.history_mask, True),
        vehicle_mask=more(observed.vehicle_mask, False),
        size_m=more(observed.size_m, filling),
    )
