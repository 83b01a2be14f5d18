"""Messages as JSON lines of the connected-vehicle pilots; `metadata.logFileName` says `synthetic` in every line."""

from pathlib import Path
from typing import Literal

import polars as pl

from tracklake.pipeline.synthetic.onboard.j2735 import (
    ELEMENTS,
    NUMBERED_TRANSMISSIONS,
    encode_counts,
    write_moments,
)

Dialect = Literal["wyoming", "tampa"]
MARK = "synthetic"
"""Value of `metadata.logFileName`; recorded messages have the name of a file there, or nothing."""
DECIMALS = {"lat": 7, "long": 7, "elev": 1, "heading": 4, "orientation": 4, "angle": 1}
"""Decimals of decoded values; the others have two."""


def describe_records(messages: pl.DataFrame, payload_type: str, schema_version: int) -> pl.DataFrame:
    """Describe each message's record, as the column `metadata`: its times to the millisecond, whose message, the mark.

    A message without a time of reception was logged when it was generated.
    """
    own = pl.col("own")
    logged = write_moments(pl.coalesce("received_us", "utc_us"))
    metadata = pl.struct(
        pl.when(own).then(pl.lit("EV")).otherwise(pl.lit("RV")).alias("bsmSource"),
        pl.lit(MARK).alias("logFileName"),
        pl.lit("bsmLogDuringEvent").alias("recordType"),
        pl.struct(pl.when(own).then(pl.lit("NA")).otherwise(pl.lit("RV")).alias("rxSource")).alias(
            "receivedMessageDetails"
        ),
        pl.lit(payload_type).alias("payloadType"),
        logged.alias("odeReceivedAt"),
        pl.lit(schema_version).alias("schemaVersion"),
        logged.alias("recordGeneratedAt"),
        pl.lit("OBU").alias("recordGeneratedBy"),
        pl.lit(value=False).alias("sanitized"),
    )
    return messages.select(metadata.alias("metadata"))


def write_pilot(path: Path, messages: pl.DataFrame, dialect: Dialect) -> None:
    """Write messages as JSON lines.

    Args:
        path: file to write.
        messages: rows of the columns that a reader of messages returns.
        dialect: `wyoming` for decoded SI values (sizes in cm), `tampa` for J2735's integers as text.
    """
    counts = encode_counts(messages)
    core = _describe_decoded(counts, messages) if dialect == "wyoming" else _describe_raw(counts, messages)
    if dialect == "wyoming":
        records = describe_records(messages, "us.dot.its.jpo.ode.model.OdeBsmPayload", 6)
        data = pl.struct(pl.struct(pl.all()).alias("coreData"))
        data_type = "us.dot.its.jpo.ode.plugin.j2735.J2735Bsm"
    else:
        records = describe_records(messages, "us.dot.its.jpo.ode.model.OdeMessageFramePayload", 9)
        frame = pl.struct(pl.struct(pl.struct(pl.all()).alias("coreData")).alias("BasicSafetyMessage"))
        data = pl.struct(pl.lit("20").alias("messageId"), frame.alias("value"))
        data_type = "us.dot.its.jpo.asn.j2735.r2024.BasicSafetyMessage.BasicSafetyMessageMessageFrame"
    payload = core.select(pl.struct(pl.lit(data_type).alias("dataType"), data.alias("data")).alias("payload"))
    records.hstack(payload).write_ndjson(path)


def _describe_decoded(counts: pl.DataFrame, messages: pl.DataFrame) -> pl.DataFrame:
    """Return core data in SI units; what is unknown is null."""

    def decode(key: str, name: str) -> pl.Expr:
        element = ELEMENTS[key]
        per_unit = 50 if key == "accelVert" else element.per_unit  # g
        value = (pl.col(key) / per_unit).round(DECIMALS.get(key, 2))
        return pl.when((pl.col(key) != element.unavailable) | (key == "accelYaw")).then(value).alias(name)

    def known(key: str) -> pl.Expr:
        return pl.when(pl.col(key) != ELEMENTS[key].unavailable).then(pl.col(key)).alias(key)

    states = {number: name.upper() for name, number in NUMBERED_TRANSMISSIONS.items()}
    return counts.select(
        "msgCnt",
        messages["temporary_id"].alias("id"),
        "secMark",
        pl.struct(decode("lat", "latitude"), decode("long", "longitude"), decode("elev", "elevation")).alias(
            "position"
        ),
        pl.struct(decode(key, key) for key in ("accelLat", "accelLong", "accelVert", "accelYaw")).alias("accelSet"),
        pl.struct(decode(key, key) for key in ("semiMajor", "semiMinor", "orientation")).alias("accuracy"),
        pl.col("transmission").replace_strict(states, default="UNAVAILABLE").alias("transmission"),
        *(decode(key, key) for key in ("speed", "heading", "angle")),
        pl.struct(known("width"), known("length")).alias("size"),
    )


def _describe_raw(counts: pl.DataFrame, messages: pl.DataFrame) -> pl.DataFrame:
    """Return core data as J2735's integers, in text; what is unknown has its code."""

    def text(key: str, name: str) -> pl.Expr:
        return pl.col(key).cast(pl.String).alias(name)

    def gather(keys: dict[str, str], name: str) -> pl.Expr:
        return pl.struct(text(key, inner) for key, inner in keys.items()).alias(name)

    states = {number: name for name, number in NUMBERED_TRANSMISSIONS.items()}
    return counts.select(
        text("msgCnt", "msgCnt"),
        messages["temporary_id"].alias("id"),
        *(text(key, key) for key in ("secMark", "lat", "long", "elev")),
        gather({key: key for key in ("semiMajor", "semiMinor", "orientation")}, "accuracy"),
        pl.col("transmission").replace_strict(states, default="unavailable").alias("transmission"),
        *(text(key, key) for key in ("speed", "heading", "angle")),
        gather({"accelLong": "long", "accelLat": "lat", "accelVert": "vert", "accelYaw": "yaw"}, "accelSet"),
        gather({"width": "width", "length": "length"}, "size"),
    )
