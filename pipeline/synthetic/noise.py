"""Tracking noise: errors that a camera adds to the simulator's exact positions, speeds and accelerations."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.scenarios import Road
from tracklake.pipeline.synthetic.sumo import compute_lanes
from tracklake.schemas.arrays import Floats

CALM_MPS = 2.0
"""Speed below which the noise of speeds and accelerations fades out, in m/s; a standing vehicle has none."""
SLOW_MPS = 1.7
"""Speed below which accelerations are at least LEAST_ACCEL_MPS2, in m/s."""
LEAST_ACCEL_MPS2 = 0.02
"""Least acceleration of slow vehicles, in m/s2, so that only injected defects have exactly 0."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations; position noise is smooth over about half a second, as that of a tracker is."""

    along_m: float
    across_m: float
    speed_mps: float
    accel_mps2: float


DRONE = Noise(along_m=0.02, across_m=0.02, speed_mps=0.03, accel_mps2=0.04)
MAST = Noise(along_m=0.08, across_m=0.06, speed_mps=0.10, accel_mps2=0.15)


def add_noise(tracks: pl.DataFrame, road: Road, noise: Noise, random: np.random.Generator) -> pl.DataFrame:
    """Add noise to tracks sorted by vehicle, frame; the lane is that of the noisy position, except on the on-ramp."""
    rows = tracks.height
    width = max(3, round(road.rate_hz / 2))
    speed = tracks["speed"].to_numpy()
    calm = np.clip(speed / CALM_MPS, 0, 1)
    accel = tracks["accel"].to_numpy() + noise.accel_mps2 * calm * _smooth(random, rows, width)
    noisy_speed = np.maximum(speed + noise.speed_mps * calm * _smooth(random, rows, width), 0)
    still = np.abs(accel) < LEAST_ACCEL_MPS2
    nudged = np.where((noisy_speed > 0) & (noisy_speed < SLOW_MPS) & still, LEAST_ACCEL_MPS2, accel)
    # SUMO lets vehicles creep below a millimetre per second; a recording has either 0 or a centimetre per second.
    noisy_speed = np.where(noisy_speed < 0.01, 0, noisy_speed)
    return tracks.with_columns(
        pl.Series("x", tracks["x"].to_numpy() + noise.along_m * _smooth(random, rows, width)),
        pl.Series("y", tracks["y"].to_numpy() + noise.across_m * _smooth(random, rows, width)),
        pl.Series("speed", noisy_speed),
        pl.Series("accel", nudged),
        on_ramp=pl.lit(road.ramp) & (pl.col("lane") == road.lanes + 2),
    ).with_columns(lane=compute_lanes(road)).drop("on_ramp")  # fmt: skip


def _smooth(random: np.random.Generator, rows: int, width: int) -> Floats:
    """Draw normal noise of unit variance that is correlated over about `width` rows."""
    window = np.hanning(2 * width + 3)
    kernel = window / np.sqrt(np.sum(window**2))
    noise: Floats = np.convolve(random.standard_normal(rows + len(kernel) - 1), kernel, mode="valid")
    return noise
