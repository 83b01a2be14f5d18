"""Tracking noise: errors that a camera adds to the simulator's exact positions, speeds and accelerations."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.noise_models import (
    AUTOCORRELATED,
    HANDOVER,
    QUANTISED,
    DriftLevel,
    add_ngsim_noise,
    convolve_noise,
)
from tracklake.pipeline.synthetic.scenarios import Road
from tracklake.pipeline.synthetic.sumo import compute_lanes
from tracklake.schemas.arrays import Floats

SMOOTH = "smooth"
"""Noise that is normal and smooth over about half a second."""
NOISE_MODELS = (SMOOTH, AUTOCORRELATED, HANDOVER, QUANTISED)
"""Names of the noise models."""
CALM_MPS = 2.0
"""Speed below which the noise of speeds and accelerations fades out, in m/s; a standing vehicle has none."""
SLOW_MPS = 1.7
"""Speed below which accelerations are at least LEAST_ACCEL_MPS2, in m/s."""
LEAST_ACCEL_MPS2 = 0.02
"""Least acceleration of slow vehicles, in m/s2, so that only injected defects have exactly 0."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations; position noise is smooth over about half a second, as that of a tracker is.

    `drift` is the level of autocorrelated noise.
    """

    along_m: float
    across_m: float
    speed_mps: float
    accel_mps2: float
    drift: DriftLevel


DRONE = Noise(along_m=0.02, across_m=0.02, speed_mps=0.03, accel_mps2=0.04, drift=DriftLevel(0.06, 0.03))
MAST = Noise(along_m=0.08, across_m=0.06, speed_mps=0.10, accel_mps2=0.15, drift=DriftLevel(0.30, 0.10))


def add_noise(
    tracks: pl.DataFrame, road: Road, noise: Noise, models: Collection[str], random: np.random.Generator
) -> pl.DataFrame:
    """Add noise to tracks sorted by vehicle, frame; the lane is that of the noisy position, except on the on-ramp.

    `models` are some of NOISE_MODELS, whose errors of the positions add up. With any but SMOOTH, recorded speeds and
    accelerations are derived from the noisy positions.
    """
    rows = tracks.height
    width = max(3, round(road.rate_hz / 2))
    # Smooth noise is drawn in any case, so that the defects drawn after it are the same under every model.
    scale = float(SMOOTH in models)
    speed = tracks["speed"].to_numpy()
    calm = scale * np.clip(speed / CALM_MPS, 0, 1)
    accel = tracks["accel"].to_numpy() + noise.accel_mps2 * calm * _smooth(random, rows, width)
    noisy_speed = np.maximum(speed + noise.speed_mps * calm * _smooth(random, rows, width), 0)
    still = np.abs(accel) < LEAST_ACCEL_MPS2
    nudged = np.where((noisy_speed > 0) & (noisy_speed < SLOW_MPS) & still, LEAST_ACCEL_MPS2, accel)
    # SUMO lets vehicles creep below a millimetre per second; a recording has either 0 or a centimetre per second.
    noisy_speed = np.where(noisy_speed < 0.01, 0, noisy_speed)
    noisy = tracks.with_columns(
        pl.Series("x", tracks["x"].to_numpy() + scale * noise.along_m * _smooth(random, rows, width)),
        pl.Series("y", tracks["y"].to_numpy() + scale * noise.across_m * _smooth(random, rows, width)),
        pl.Series("speed", noisy_speed),
        pl.Series("accel", nudged),
        on_ramp=pl.lit(road.ramp) & (pl.col("lane") == road.lanes + 2),
    )
    if set(models) - {SMOOTH}:
        noisy = add_ngsim_noise(noisy, tracks, road.rate_hz, noise.drift, models, random.spawn(1)[0])
    return noisy.with_columns(lane=compute_lanes(road)).drop("on_ramp")


def _smooth(random: np.random.Generator, rows: int, width: int) -> Floats:
    """Draw normal noise of unit variance that is correlated over about `width` rows."""
    return convolve_noise(random, rows, np.hanning(2 * width + 3))
