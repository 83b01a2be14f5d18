"""Noise models of NGSIM's kind: drift, jumps between cameras, steps in slow traffic, speeds that contradict positions.

Punzo, Borzacchiello and Ciuffo (2011), Montanino and Punzo (2015) and Coifman and Li (2017) judge NGSIM's tracks and
find positions, speeds and accelerations that contradict each other and no vehicle's motion. The published rows of
US-101, 07:50, show the forms that are imitated here: below 1 m/s, 72 % of the positions are those of the frame before;
speeds stay the same for several frames; a fifth of the accelerations is exactly 0 and 8 % stand at the limit of
11.33 ft/s2. Eight cameras saw that road. The levels are ours: of this order, not fitted.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats, Integers, bound_runs

AUTOCORRELATED, HANDOVER, QUANTISED = "autocorrelated", "handover", "quantised"
DRIFT_S = 2.0
"""Time in which the correlation of drift falls to 1/e, in s."""
CAMERA_M = 80.0
"""Length of road that one camera covers, in m: NGSIM's eight cameras at US-101 cover 640 m."""
JUMP_M = (0.5, 3.0)
"""Range of the jumps between cameras, in m."""
CRAWL_MPS = 3.0
"""Speed below which a vehicle is recorded at rest until it has moved STEP_M, in m/s."""
STEP_M = 0.6
"""Distance that a crawling vehicle moves before it is recorded to have moved, in m (2 ft)."""
SPEED_STEP_MPS = 0.3048
"""Step of quantised speeds, in m/s (1 ft/s)."""
MOST_ACCEL_MPS2 = 3.4534
"""Limit at which NGSIM's accelerations are cut off, in m/s2 (11.33 ft/s2)."""
SPAN_S = 0.5
"""Half of the time over which recorded speeds and accelerations are averaged, in s."""


@dataclass(frozen=True)
class DriftLevel:
    """Standard deviations of autocorrelated noise."""

    along_m: float
    across_m: float


def add_ngsim_noise(
    noisy: pl.DataFrame,
    true: pl.DataFrame,
    rate_hz: float,
    drift: DriftLevel,
    models: Collection[str],
    random: np.random.Generator,
) -> pl.DataFrame:
    """Add the errors of some models to the positions, and record the speeds that follow from them.

    Both tables have the same rows, sorted by vehicle, frame; `true` has the true positions and speeds.
    """
    x, y = noisy["x"].to_numpy(), noisy["y"].to_numpy()
    first, last = bound_runs(true["vehicle"].to_numpy().astype(np.int64))
    if AUTOCORRELATED in models:
        # An autoregressive process of order one, as a moving average that is cut off where its weights are 1/20,000.
        weights = np.exp(-np.arange(round(10 * DRIFT_S * rate_hz)) / (DRIFT_S * rate_hz))
        x = x + drift.along_m * convolve_noise(random, len(x), weights)
        y = y + drift.across_m * convolve_noise(random, len(y), weights)
    if HANDOVER in models:
        x = x + _draw_camera_offsets(true["x"].to_numpy(), first, random)
    if QUANTISED in models:
        crawls = true["speed"].to_numpy() < CRAWL_MPS
        x = np.where(crawls, np.floor(x / STEP_M) * STEP_M, x)
    span = max(1, round(SPAN_S * rate_hz))
    speed = np.maximum(_find_slopes(x, first, last, span) * rate_hz, 0)
    if QUANTISED in models:
        speed = np.round(speed / SPEED_STEP_MPS) * SPEED_STEP_MPS
        accel = np.clip(_find_slopes(speed, first, last, 1) * rate_hz, -MOST_ACCEL_MPS2, MOST_ACCEL_MPS2)
    else:
        accel = _find_slopes(speed, first, last, span) * rate_hz
    return noisy.with_columns(
        pl.Series("x", x), pl.Series("y", y), pl.Series("speed", speed), pl.Series("accel", accel)
    )


def convolve_noise(random: np.random.Generator, rows: int, weights: Floats) -> Floats:
    """Draw normal noise of unit variance: a moving average of independent draws with the given weights."""
    kernel = weights / np.sqrt(np.sum(weights**2))
    noise: Floats = np.convolve(random.standard_normal(rows + len(kernel) - 1), kernel, mode="valid")
    return noise


def _draw_camera_offsets(x: Floats, first: Integers, random: np.random.Generator) -> Floats:
    """Draw each row's error along the road by vehicle and camera; `first` is the first row of its vehicle.

    A vehicle is placed right by its first camera, and jumps wherever it comes into the view of the next one: away from
    its true position if it was right, towards it and possibly beyond if not, so that errors stay below the widest jump.
    """
    camera = np.floor(np.maximum(x, 0) / CAMERA_M).astype(np.int64)
    begins, vehicle = np.unique(first, return_inverse=True)
    shape = (len(begins), int(camera.max(initial=0)) + 1)
    jumps, sides = random.uniform(*JUMP_M, shape), random.choice((-1.0, 1.0), shape)
    offsets = np.zeros(shape)
    for number in range(1, shape[1]):
        before = offsets[:, number - 1]
        side = np.where(before == 0, sides[:, number], -np.sign(before))
        offsets[:, number] = np.where(camera[begins] < number, before + side * jumps[:, number], 0)
    found: Floats = offsets[vehicle, camera]
    return found


def _find_slopes(values: Floats, first: Integers, last: Integers, span: int) -> Floats:
    """Find the change per row between `span` rows before and after each row, or up to the ends of its vehicle's."""
    rows = np.arange(len(values))
    before, after = np.maximum(rows - span, first), np.minimum(rows + span, last)
    slopes: Floats = (values[after] - values[before]) / np.maximum(after - before, 1)
    return slopes
