"""Histories without neighbors, as models that look at one vehicle alone are given them."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from tracklake.schemas.protocols import CSP
from tracklake.training.data.observed import Observed, Truth

TWO_SECONDS = replace(CSP, name="two-seconds", rate_hz=10, history_s=2.0, horizon_s=2.0)
"""2 s of history and of future at 10 Hz: H = 21, F = 20."""

seeds = st.integers(0, 2**32 - 1)


def observe(history, neighbors=None):
    """Samples of histories (B, H, 2); neighbors, where given, are (K, H, 2), all of the first sample."""
    history = np.asarray(history, dtype=np.float32)
    ticks = history.shape[1]
    around = np.zeros((0, ticks, 2), dtype=np.float32) if neighbors is None else neighbors.astype(np.float32)
    return Observed(
        history=history,
        neighbor_history=around,
        neighbor_mask=np.ones(around.shape[:2], dtype=bool),
        neighbor_sample=np.zeros(len(around), dtype=np.int64),
        neighbor_cell=np.arange(len(around), dtype=np.int8),
    )


def wander(draw, protocol, samples):
    """Histories (B, H, 2) and futures (B, F, 2) of vehicles that accelerate, drift and jitter; ends in (0, 0)."""
    ticks = protocol.history_ticks + protocol.horizon_ticks
    time_s = (np.arange(ticks) - protocol.history_ticks + 1) / protocol.rate_hz
    velocity, acceleration = draw.normal((12, 0), (6, 0.4), (samples, 1, 2)), draw.normal(0, (1, 0.1), (samples, 1, 2))
    track = velocity * time_s[:, None] + acceleration / 2 * time_s[:, None] ** 2
    track = track + draw.normal(0, 0.05, track.shape)
    track = (track - track[:, protocol.history_ticks - 1][:, None]).astype(np.float32)
    return track[:, : protocol.history_ticks], track[:, protocol.history_ticks :]


def reveal(future, draw, known=0.9):
    """The truth of futures (B, F, 2), of which positions beyond a tick are unknown."""
    samples, ticks, _ = future.shape
    last = np.where(draw.random(samples) < known, ticks, draw.integers(1, ticks + 1, samples))
    classes = np.zeros(samples, dtype=np.uint8)
    return Truth(future, np.arange(ticks) < last[:, None], classes, classes)
