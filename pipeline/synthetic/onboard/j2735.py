"""Messages as the integers of SAE J2735, from which the formats of logs are written."""

from dataclasses import dataclass

import polars as pl


@dataclass(frozen=True)
class Element:
    """A quantity of J2735's core data.

    Args:
        column: column of the messages.
        per_unit: counts in one unit of the column.
        least: least count.
        greatest: greatest count that is a value.
        unavailable: count that stands for an unknown value.
        turn: counts of a full turn, for angles that wrap.
    """

    column: str
    per_unit: float
    least: int
    greatest: int
    unavailable: int
    turn: int = 0


ELEMENTS = {
    "lat": Element("lat_deg", 1e7, -900_000_000, 900_000_000, 900_000_001),
    "long": Element("lon_deg", 1e7, -1_799_999_999, 1_800_000_000, 1_800_000_001),
    "elev": Element("elevation_m", 10, -4095, 61_439, -4096),
    "semiMajor": Element("semi_major_m", 20, 0, 254, 255),
    "semiMinor": Element("semi_minor_m", 20, 0, 254, 255),
    "orientation": Element("orientation_deg", 65_535 / 360, 0, 65_534, 65_535, turn=65_535),
    "speed": Element("speed_mps", 50, 0, 8190, 8191),
    "heading": Element("heading_deg", 80, 0, 28_799, 28_800, turn=28_800),
    "angle": Element("steering_angle_deg", 2 / 3, -126, 126, 127),
    "accelLong": Element("accel_mps2", 100, -2000, 2000, 2001),
    "accelLat": Element("lateral_accel_mps2", 100, -2000, 2000, 2001),
    "accelVert": Element("vertical_accel_mps2", 50 / 9.80665, -126, 127, -127),
    "accelYaw": Element("yaw_rate_degps", 100, -32_767, 32_767, 0),
    "width": Element("width_m", 100, 1, 1023, 0),
    "length": Element("length_m", 100, 1, 4095, 0),
}
"""Elements by key; those of the acceleration have the keys of decoded logs. The yaw rate has no code: unknown is 0."""
NUMBERED_TRANSMISSIONS = {"neutral": 0, "park": 1, "forwardGears": 2, "reverseGears": 3}
"""Numbers of the states of a transmission."""
UNAVAILABLE_TRANSMISSION = 7
"""Number of an unknown state."""
MINUTE_MS = 60_000
"""Milliseconds in a minute."""


def encode_counts(messages: pl.DataFrame) -> pl.DataFrame:
    """Encode messages as counts, each limited to what J2735 can state.

    Returns:
        `msgCnt`, `id`, `secMark`, `transmission` and the keys of ELEMENTS, all Int64.
    """
    in_minute = pl.col("utc_us") // 1000 % MINUTE_MS
    return messages.select(
        pl.col("message_count").cast(pl.Int64).fill_null(0).alias("msgCnt"),
        pl.col("temporary_id").str.to_integer(base=16, dtype=pl.Int64).alias("id"),
        pl.coalesce(pl.col("second_mark_ms").cast(pl.Int64), in_minute, pl.lit(65_535)).alias("secMark"),
        pl.col("transmission")
        .replace_strict(NUMBERED_TRANSMISSIONS, default=UNAVAILABLE_TRANSMISSION, return_dtype=pl.Int64)
        .alias("transmission"),
        *(_count(element).alias(key) for key, element in ELEMENTS.items()),
    )


def _count(element: Element) -> pl.Expr:
    count = (pl.col(element.column).cast(pl.Float64) * element.per_unit).round()
    if element.turn:
        count = count % element.turn
    return count.clip(element.least, element.greatest).fill_null(element.unavailable).cast(pl.Int64)


def write_moments(moments_us: pl.Expr) -> pl.Expr:
    """Write microseconds since 1970 as UTC in ISO 8601, to the millisecond."""
    return pl.from_epoch(moments_us, time_unit="us").dt.strftime("%Y-%m-%dT%H:%M:%S%.3fZ")
