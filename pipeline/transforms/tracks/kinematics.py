"""Speeds and accelerations recomputed from positions."""

import math

import polars as pl

CLOCK_HZ = 10.0
"""The rate on which the consistency rules compare recorded with recomputed motion (DESIGN section 4)."""


def central_difference(column: str, rate_hz: float) -> pl.Expr:
    """(value one frame later - value one frame earlier) / (their distance in time).

    Needs rows sorted by (vehicle_id, frame). Null at track ends and beside frame gaps.

    Args:
        column: what to differentiate.
        rate_hz: frames per second.
    """
    return _difference(pl.col(column), steps=1.0, rate_hz=rate_hz)


def _difference(value: pl.Expr, *, steps: float, rate_hz: float) -> pl.Expr:
    """Central difference over +-`steps` frames; half frames are linear between the two beside them."""
    low, high = math.floor(steps), math.ceil(steps)
    weight = steps - low
    ahead = value.shift(-low) * (1 - weight) + value.shift(-high) * weight
    behind = value.shift(low) * (1 - weight) + value.shift(high) * weight
    return pl.when(_is_contiguous(high)).then((ahead - behind) / (2 * steps / rate_hz))


def _is_contiguous(reach: int) -> pl.Expr:
    """True where the `reach` rows before and after are the same vehicle's, one frame apart each."""
    vehicle, frame = pl.col("vehicle_id"), pl.col("frame")
    return (
        (vehicle.shift(reach) == vehicle)
        & (vehicle.shift(-reach) == vehicle)
        & (frame - frame.shift(reach) == reach)
        & (frame.shift(-reach) - frame == reach)
    )


def add_kinematics(tracks: pl.DataFrame, rate_hz: float) -> pl.DataFrame:
    """Add speed_cd_mps, accel_cd_mps2, speed_10hz_mps and accel_10hz_mps2.

    On the 10 Hz clock the steps are 0.1 s before and after each entry; at 25 Hz those fall 2.5 frames away, where the
    position is linear between frames. The acceleration is the same difference of that speed, which comes to
    (x(t + 0.2 s) - 2 x(t) + x(t - 0.2 s)) / (0.2 s)^2. At 10 Hz both pairs are equal by definition.

    Args:
        tracks: vehicle_id, frame, x_m, sorted by the first two.
        rate_hz: the source's frames per second.
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
        # A slower camera has no entries 0.1 s apart; nothing is interpolated over a longer time than that.
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
