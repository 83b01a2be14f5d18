"""Messages as the connected-vehicle pilots publish them: one JSON object a line, or a single one over several lines.

The keys of a message's core data name its dialect; the size of numbers never does. `position` with `latitude` and
`longitude` holds SI values (Wyoming; speeds in m/s, sizes in cm, vertical acceleration in g). `lat` and `long` hold the
integers of SAE J2735, as numbers or text (Tampa, schema 9). Objects without core data but with hex digits
(`payload.data.bytes`, `metadata.asn1`) are decoded from these.

The time of the record (`recordGeneratedAt`, else `odeReceivedAt`) is when a message was logged; `secMark` tells when in
the minute it was generated. A vehicle's own messages have `bsmSource` EV or `recordType` bsmTx, unless a roadside unit
logged them (`rxSource` RSU), which is then the receiver. Path histories and brakes are not kept.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import duckdb
import polars as pl

from tracklake.pipeline.sources.csv import BOM, LINE, NULL_WORDS, map_lines
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.messages import (
    J2735,
    STANDARD_GRAVITY_MPS2,
    TRANSMISSIONS,
    Lines,
    RawMessages,
    collect_messages,
    read_times,
    screen_lines,
    split_impossible,
)
from tracklake.pipeline.sources.v2v.uper import convert_hex_lines, decode_hex

CORE_DATA = {
    **dict.fromkeys(("msgCnt", "id", "secMark", "lat", "long", "elev", "transmission"), "VARCHAR"),
    **dict.fromkeys(("speed", "heading", "angle"), "VARCHAR"),
    "position": dict.fromkeys(("latitude", "longitude", "elevation"), "VARCHAR"),
    "accelSet": dict.fromkeys(
        ("accelLat", "accelLong", "accelVert", "accelYaw", "lat", "long", "vert", "yaw"), "VARCHAR"
    ),
    "accuracy": dict.fromkeys(("semiMajor", "semiMinor", "orientation"), "VARCHAR"),
    "size": dict.fromkeys(("width", "length"), "VARCHAR"),
}
"""Keys of the core data in both dialects; every value is read as text."""
MESSAGE = {"BasicSafetyMessage": {"coreData": "JSON"}}
"""Where a message frame has its core data."""
METADATA = ("bsmSource", "recordType", "recordGeneratedAt", "odeReceivedAt", "logFileName", "originIp", "asn1")
STRUCTURE = {
    "metadata": {**dict.fromkeys(METADATA, "VARCHAR"), "receivedMessageDetails": {"rxSource": "VARCHAR"}},
    "payload": {"data": {"coreData": "JSON", "value": MESSAGE, "MessageFrame": {"value": MESSAGE}, "bytes": "VARCHAR"}},
}
"""Keys of a record that are read, in each of the places where a pilot has its core data."""
QUANTITIES: Mapping[str, tuple[str, str, float]] = {
    "lat_deg": ("position.latitude", "lat", 1),
    "lon_deg": ("position.longitude", "long", 1),
    "elevation_m": ("position.elevation", "elev", 1),
    "speed_mps": ("speed", "speed", 1),
    "heading_deg": ("heading", "heading", 1),
    "accel_mps2": ("accelSet.accelLong", "accelSet.long", 1),
    "lateral_accel_mps2": ("accelSet.accelLat", "accelSet.lat", 1),
    "vertical_accel_mps2": ("accelSet.accelVert", "accelSet.vert", STANDARD_GRAVITY_MPS2),
    "yaw_rate_degps": ("accelSet.accelYaw", "accelSet.yaw", 1),
    "steering_angle_deg": ("angle", "angle", 1),
    "semi_major_m": ("accuracy.semiMajor", "accuracy.semiMajor", 1),
    "semi_minor_m": ("accuracy.semiMinor", "accuracy.semiMinor", 1),
    "orientation_deg": ("accuracy.orientation", "accuracy.orientation", 1),
    "length_m": ("size.length", "size.length", 0.01),
    "width_m": ("size.width", "size.width", 0.01),
}
"""Keys of each column in decoded and in raw core data, and the column's units in one unit of the decoded value."""
SYNTHETIC_LOG_NAME = "synthetic"
"""Value of `metadata.logFileName` in generated messages; recorded ones have the name of a file there, or nothing."""
UNKNOWN_WORDS = ("", "unavailable", *NULL_WORDS)
"""Texts in lower case that stand for a number that is not known."""
PARSING_THREADS = 2
"""Chunks of lines that are parsed at once."""
SERIAL: dict[str, str | bool | int | float | list[str]] = {"threads": 1}
"""Settings of DuckDB, which parses the JSON: a chunk in one thread."""


def _write_query(*, checked: bool) -> str:
    """Write the statement that turns lines of JSON into columns of text; unchecked, it fails where one is no JSON."""
    record = f"json_transform(text, '{json.dumps(STRUCTURE)}')"
    cells = dict.fromkeys([key for decoded, raw, _ in QUANTITIES.values() for key in (decoded, raw)])
    core = [f'core.{cell} AS "{cell}"' for cell in (*cells, "msgCnt", "id", "secMark", "transmission")]
    return f"""
        WITH records AS (SELECT line, {f"CASE WHEN json_valid(text) THEN {record} END" if checked else record} AS record
                         FROM lines),
        parts AS (SELECT line, record IS NULL AS unread, record.metadata AS meta, record.payload.data.bytes AS bytes,
                         coalesce(record.payload.data.coreData,
                                  record.payload.data.value.BasicSafetyMessage.coreData,
                                  record.payload.data.MessageFrame.value.BasicSafetyMessage.coreData) AS found
                  FROM records),
        messages AS (SELECT *, json_transform(found, '{json.dumps(CORE_DATA)}') AS core FROM parts)
        SELECT line, unread, core IS NULL AS no_core, coalesce(bytes, meta.asn1) AS hex,
               coalesce(nullif(meta.recordGeneratedAt, ''), meta.odeReceivedAt) AS time,
               meta.logFileName AS log_name, meta.originIp AS origin,
               coalesce(upper(meta.receivedMessageDetails.rxSource) = 'RSU', false) AS roadside,
               coalesce(upper(meta.bsmSource) = 'EV', false) OR coalesce(meta.recordType = 'bsmTx', false) AS sent,
               {", ".join(core)}
        FROM messages"""


UNCHECKED, CHECKED = _write_query(checked=False), _write_query(checked=True)


def recognise_pilot_json(head: bytes) -> bool:
    """Recognise a log by its first bytes: an object with `payload` and either core data or hex digits."""
    text = head.removeprefix(BOM).lstrip()[:65_536]
    return text.startswith(b"{") and b'"payload"' in text and re.search(rb'"(coreData|bytes|asn1)"', text) is not None


def read_pilot_json(file: RawFile) -> RawMessages:
    """Read a log of JSON lines, or of one object over several lines, whose message counts as line 1.

    Raises:
        SourceError: a compressed file is damaged.
    """
    with duckdb.connect(config=SERIAL) as connection:
        chunks = list(map_lines(file, partial(_read_chunk, connection), threads=PARSING_THREADS))
    return collect_messages(
        file,
        [frame for frame, _ in chunks],
        [lines.rejects for _, lines in chunks],
        sum(lines.rows_read for _, lines in chunks),
        synthetic=any((frame["log_name"] == SYNTHETIC_LOG_NAME).any() for frame, _ in chunks),
    )


def _read_chunk(
    connection: duckdb.DuckDBPyConnection, number: int, data: bytes, first_line: int
) -> tuple[pl.DataFrame, Lines]:
    if number == 0 and _is_spread(data):
        data = data.replace(b"\r", b" ").replace(b"\n", b" ")
    lines = screen_lines(data, first_line)
    kept, refused = _convert_records(connection, lines.usable)
    return kept, replace(lines, rejects=pl.concat([lines.rejects, refused]))


def decode_texts(texts: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Decode single messages (`line`, `text`), each a JSON object, or hex digits with or without a time before them.

    Returns:
        messages in MESSAGE_SCHEMA, and `line`, `reason`, `text` of the texts that are none.
    """
    is_json = pl.col("text").str.strip_chars_start().str.starts_with("{")
    with duckdb.connect(config=SERIAL) as connection:
        parts = [_convert_records(connection, texts.filter(is_json)), convert_hex_lines(texts.filter(~is_json))]
    kept, impossible, _ = split_impossible(
        pl.concat([frame for frame, _ in parts], how="diagonal").sort(LINE), lambda _numbers: texts.select(LINE, "text")
    )
    return kept, pl.concat([*(rejects for _, rejects in parts), impossible]).sort(LINE)


def _convert_records(connection: duckdb.DuckDBPyConnection, lines: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Convert lines of JSON (`line`, `text`) to messages, and to the rejects of the others."""
    rows = _parse_lines(connection, lines)
    messages = pl.concat([_convert_core(rows), _convert_hex(rows)], how="diagonal")
    other = rows.filter(pl.col("no_core") & pl.col("hex").is_null()).select(
        LINE, reason=pl.when("unread").then(pl.lit("no JSON object")).otherwise(pl.lit("no basic safety message"))
    )
    refused = pl.concat([messages.select(LINE, "reason"), other]).filter(pl.col("reason").is_not_null())
    kept = messages.filter(pl.col("reason").is_null()).drop("reason")
    return kept, refused.join(lines, on=LINE, how="left", maintain_order="left")


def _is_spread(data: bytes) -> bool:
    """Tell whether text is one object over several lines: the first does not end it, the second begins no other."""
    first, _, rest = data.removeprefix(BOM).strip().partition(b"\n")
    return bool(rest) and not first.rstrip().endswith(b"}") and not rest.lstrip().startswith(b"{")


def _parse_lines(connection: duckdb.DuckDBPyConnection, lines: pl.DataFrame) -> pl.DataFrame:
    """Parse lines of JSON to columns of text; `unread` marks those that are no JSON."""
    with connection.cursor() as cursor:
        cursor.register("lines", lines.to_arrow())
        try:
            table = cursor.execute(UNCHECKED).to_arrow_table()
        except duckdb.InvalidInputException:
            table = cursor.execute(CHECKED).to_arrow_table()
    return pl.DataFrame(pl.from_arrow(table))


def _describe_records(rows: pl.DataFrame) -> pl.DataFrame:
    """Return when and by whom each message was logged."""
    return rows.select(
        LINE,
        "log_name",
        read_times(rows["time"]).alias("received_us"),
        receiver=pl.when("roadside").then(pl.coalesce("origin", pl.lit("RSU"))),
        own=pl.col("sent") & ~pl.col("roadside"),
    )


def _convert_hex(rows: pl.DataFrame) -> pl.DataFrame:
    """Decode the messages of records with hex digits alone."""
    found = rows.filter(pl.col("no_core") & pl.col("hex").is_not_null())
    return _describe_records(found).hstack(decode_hex(found["hex"]))


def _convert_core(rows: pl.DataFrame) -> pl.DataFrame:
    """Convert core data of both dialects to the units of the columns."""
    found = rows.filter(~pl.col("no_core"))
    is_raw = pl.col("lat").is_not_null() & pl.col("position.latitude").is_null()
    cells = [
        *dict.fromkeys(key for decoded, raw, _ in QUANTITIES.values() for key in (decoded, raw)),
        "msgCnt",
        "secMark",
    ]
    numbers = found.select(
        is_raw.alias("is_raw"), *(pl.col(cell).cast(pl.Float64, strict=False).fill_nan(None) for cell in cells)
    )
    unread = [
        pl.when(
            found[cell].is_not_null() & numbers[cell].is_null() & ~found[cell].str.to_lowercase().is_in(UNKNOWN_WORDS)
        ).then(pl.lit(f"not a number: {cell}"))
        for cell in cells
        if found[cell].null_count() != numbers[cell].null_count()
    ]
    broken = pl.col("is_raw") & ((pl.col("lat") % 1 != 0) | (pl.col("long") % 1 != 0))
    values = numbers.select(
        *(
            pl.when("is_raw")
            .then((pl.col(raw) / J2735[name][0]).round(9))
            .otherwise(pl.col(decoded) * factor)
            .alias(name)
            for name, (decoded, raw, factor) in QUANTITIES.items()
        ),
        pl.col("msgCnt").cast(pl.Int64, strict=False).alias("message_count"),
        pl.col("secMark").cast(pl.Int64, strict=False).alias("second_mark_ms"),
        pl.coalesce(*unread, pl.when(broken).then(pl.lit("lat or long is no whole number"))).alias("reason"),
    )
    states = {state.lower(): state for state in TRANSMISSIONS}
    state = found["transmission"].str.extract(r"(\w+)").str.to_lowercase().replace_strict(states, default=None)
    ids = found["id"].str.to_uppercase().alias("temporary_id")
    return _describe_records(found).hstack(values).with_columns(ids, state.alias("transmission"))
