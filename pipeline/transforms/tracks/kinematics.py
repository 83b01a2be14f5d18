"""Speeds and accelerations recomputed from positions."""

import math

import polars as pl

CLOCK_HZ = 10.0
"""Rate at which the consistency rules compare recorded with recomputed motion, in Hz (DESIGN section 4)."""


def central_difference(column: str, rate_hz: float) -> pl.Expr:
    """Differentiate a column: (value one frame later - value one frame earlier) / (time between them).

    Rows must be sorted by (vehicle_id, frame). The result is null at track ends and next to frame gaps.
    """
    return _difference(pl.col(column), steps=1.0, rate_hz=rate_hz)


def _difference(value: pl.Expr, *, steps: float, rate_hz: float) -> pl.Expr:
    """Compute the central difference over +-`steps` frames; values at half frames are interpolated linearly."""
    low, high = math.floor(steps), math.ceil(steps)
    weight = steps - low
    ahead = value.shift(-low) * (1 - weight) + value.shift(-high) * weight
    behind = value.shift(low) * (1 - weight) + value.shift(high) * weight
    return pl.when(_is_contiguous(high)).then((ahead - behind) / (2 * steps / rate_hz))


def _is_contiguous(reach: int) -> pl.Expr:
    """Test that the `reach` rows before and after belong to the same vehicle and skip no frame."""
    vehicle, frame = pl.col("vehicle_id"), pl.col("frame")
    return (
        (vehicle.shift(reach) == vehicle)
        & (vehicle.shift(-reach) == vehicle)
        & (frame - frame.shift(reach) == reach)
        & (frame.shift(-reach) - frame == reach)
    )


def add_kinematics(tracks: pl.DataFrame, rate_hz: float) -> pl.DataFrame:
    """Add speed_cd_mps, accel_cd_mps2, speed_10hz_mps and accel_10hz_mps2.

    On the 10 Hz clock the steps are 0.1 s before and after each entry; at 25 Hz these are 2.5 frames away, where the
    position is interpolated linearly. The acceleration is the same difference of that speed, which equals
    (x(t + 0.2 s) - 2 x(t) + x(t - 0.2 s)) / (0.2 s)^2. At 10 Hz both pairs are equal by definition.

    `tracks` have vehicle_id, frame, x_m, and are sorted by the first two.
    """
    step = rate_hz / CLOCK_HZ
    tracks = tracks.with_columns(central_difference("x_m", rate_hz).alias("speed_cd_mps")).with_columns(
        central_difference("speed_cd_mps", rate_hz).alias("accel_cd_mps2")
    )
    if step == 1.0:
        return tracks.with_columns(
            pl.col("speed_cd_mps").alias("speed_10hz_mps"), pl.col("accel_cd_mps2").alias("accel_10hz_mps2")
        )
    if step < 1.0 or (2 * step) % 1:
        # A slower camera has no entries 0.1 s apart, and nothing is interpolated over a longer time.
        return tracks.with_columns(
            pl.lit(None, pl.Float64).alias("speed_10hz_mps"), pl.lit(None, pl.Float64).alias("accel_10hz_mps2")
        )
    double = round(2 * step)
    x = pl.col("x_m")
    second = (x.shift(-double) - 2 * x + x.shift(double)) / (2 / CLOCK_HZ) ** 2
    return tracks.with_columns(
        _difference(x, steps=step, rate_hz=rate_hz).alias("speed_10hz_mps"),
        pl.when(_is_contiguous(double)).then(second).alias("accel_10hz_mps2"),
    )
