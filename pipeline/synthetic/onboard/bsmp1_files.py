"""Messages as a file of Safety Pilot's BsmP1, whose FileId says `synthetic` in every line."""

from pathlib import Path

import polars as pl

MARK = "synthetic"
"""Value of FileId; recorded files have a number there."""
EPOCH_US = 1_072_915_200_000_000
"""Microseconds from 1970 to 2004-01-01 UTC, from which Gentime counts."""
EGO_DEVICE = 1
"""Number of the receiving device where the messages do not name it."""
MEASURED = {
    "lat_deg": None,
    "lon_deg": None,
    "elevation_m": -409.6,
    "speed_mps": 163.82,
    "heading_deg": 360.0,
    "accel_mps2": 20.01,
    "lateral_accel_mps2": 20.01,
    "vertical_accel_mps2": -24.908891,
    "yaw_rate_degps": None,
}
"""Columns in the order of the file, and what stands for an unknown value: J2735's code in the unit; None: nothing."""


def write_bsmp1(path: Path, messages: pl.DataFrame) -> None:
    """Write messages, one a line, without a header.

    TxRandom is the temporary id, TxDevice the `sender` where one is given, else 0. What BsmP1 has no field for is lost:
    sizes, accuracy, steering, transmission, and when a message was received.

    Args:
        path: file to write.
        messages: rows of the columns that a reader of messages returns; `utc_us` is never null.
    """
    receiver = pl.coalesce(pl.col("receiver").cast(pl.Int64, strict=False), pl.lit(EGO_DEVICE))
    sender = pl.when("own").then(receiver).otherwise(pl.coalesce(pl.col("sender").cast(pl.Int64), pl.lit(0)))
    utc_ms = pl.col("utc_us") // 1000
    lines = messages.select(
        receiver.alias("RxDevice"),
        pl.lit(MARK).alias("FileId"),
        sender.alias("TxDevice"),
        (pl.col("utc_us") - EPOCH_US).alias("Gentime"),
        pl.col("temporary_id").str.to_integer(base=16, dtype=pl.Int64).alias("TxRandom"),
        pl.col("message_count").fill_null(0).alias("MsgCount"),
        pl.coalesce(pl.col("second_mark_ms").cast(pl.Int64), utc_ms % 60_000).alias("DSecond"),
        *(pl.col(name) if code is None else pl.col(name).fill_null(code) for name, code in MEASURED.items()),
        *(pl.lit(0).alias(name) for name in ("PathCount", "RadiusOfCurve", "Confidence")),
    )
    if ((lines["TxDevice"] == lines["RxDevice"]) & ~messages["own"]).any():
        raise ValueError(f"{path}: a message of another vehicle has the number of the receiver as its sender")
    lines.write_csv(path, include_header=False)
